// What a kind of line is found in, as planes: a field whose zeros are the lines, and a strength.
//
// AXIS 0: field and strength are scalars, both times the squared sine between normal and ray where SINES is 1: the
// radial curvature has no value where the eye looks along the normal, its product with that factor is smooth there. The
// strength is `sign` times a channel, or its size where `sign` is 0; OTHER 1: 0 where another channel is larger in
// size. AXIS 1: the derivative of a curvature along its principal direction t changes its sign with that of t, which
// means nothing; the vector derivative * t does not. Planes: that vector (3), the strength, and t (3). One work-item
// per VW pixels of the padded planes. Twin: tests/reference/lines.py.
#include "analysis/line_planes.clh"
#ifndef AXIS
#define AXIS 0
#endif
#ifndef SINES
#define SINES 0
#endif
#ifndef OTHER
#define OTHER 0
#endif

INLINE VF finite_or_0(VF v) { return SEL((VF)(0.0f), v, ABS(v) < 1e30f); }

__kernel void line_values(int width, int height, int stride, int plane, float sign,
                          __global const int *links, __global const float *sine2, __global const float *field,
                          __global const float *strength, __global const float *other, __global const float *axis,
                          __global float *values) {
  int x = get_global_id(0) * VW - MARGIN_X, y = get_global_id(1) - MARGIN_Y;
  if (x >= stride - MARGIN_X || y >= height + MARGIN_Y) return;
  size_t to = PLANE_AT(x, y), at = (size_t)y * width + x;
  int lanes = x < 0 || y < 0 || y >= height ? 0 : width - x < VW ? width - x : VW;
  VI hit = (LOAD_INT(links + to) & HIT) != 0;
  VF f = (VF)(0.0f), s = f;
  if (any_lane(hit)) {
    f = finite_or_0(load_channel(field, at, lanes));
    s = finite_or_0(load_channel(strength, at, lanes));
#if OTHER
    VF o = finite_or_0(load_channel(other, at, lanes));
    s = SEL(s, (VF)(0.0f), ABS(o) > ABS(s));
#endif
    s = sign == 0.0f ? ABS(s) : sign * s;
  }
#if SINES
  VF factor = SEL((VF)(0.0f), LOAD(sine2 + to), hit);
  f *= factor; s *= factor;
#endif
#if AXIS
  VF axes[3] = {(VF)(0.0f), (VF)(0.0f), (VF)(0.0f)};
  if (any_lane(hit)) load_vectors(axis, at, lanes, axes);
  for (int c = 0; c < 3; c++) {
    VF t = finite_or_0(axes[c]);
    STORE(values + (size_t)c * plane + to, SEL((VF)(0.0f), f * t, hit));
    STORE(values + (size_t)(4 + c) * plane + to, t);
  }
  STORE(values + (size_t)3 * plane + to, SEL((VF)(0.0f), s, hit));
#else
  STORE(values + to, SEL((VF)(0.0f), f, hit));
  STORE(values + (size_t)plane + to, SEL((VF)(0.0f), s, hit));
#endif
}
