// Where a field changes its sign between two neighbouring pixels and the strength there is at least `least`: a byte per
// pixel, EDGE_RIGHT for the edge to the pixel on the right, EDGE_DOWN for the one to the pixel below. The bytes are 0
// before.
//
// AXIS 1: the field is a derivative along the direction t, whose sign means nothing: t of the second pixel is turned to
// that of the first. Zeros count where the curvature that it is the derivative of has a maximum (EXTREMUM 1: the field
// falls along t) or a minimum (-1), and changes at all: where it is constant, as on cylinders and tori, its derivative
// is rounding. Its second derivative must be FLATTEST times its cube. `values` are the planes of `line_values`. One
// work-item per VW pixels. Twin: tests/reference/lines.py.
#include "analysis/line_planes.clh"
#ifndef AXIS
#define AXIS 0
#endif
#ifndef EXTREMUM
#define EXTREMUM 1
#endif
#ifndef FLATTEST
#define FLATTEST 0.02f
#endif
enum { EDGE_RIGHT = 1, EDGE_DOWN = 2 };

// Place of pixels at a depth, relative to the eye.
INLINE void place(__global const float *camera, VF x, VF y, VF depth, VF *p) {
  for (int c = 0; c < 3; c++) {
    VF ray = camera[G0 + c] + x * camera[GX + c] + y * camera[GY + c];
    p[c] = camera[IN_PERSPECTIVE] > 0.0f ? depth * ray : ray + depth * camera[FORWARD + c];
  }
}

// The edges from the pixels at `at`, column px and row py, to those at `at + step`, `dx` columns and `dy` rows on.
INLINE VI edges(__global const float *camera, __global const float *depths, __global const float *field,
                __global const float *strength, __global const float *values, int plane, size_t at, int step, VF px,
                VF py, float dx, float dy, float least) {
  VF a = LOAD(field + at), b = LOAD(field + at + step);
  VI good = (a == a) & (b == b);
#if AXIS
  VF t[3], u[3], dot = 0.0f;
  for (int c = 0; c < 3; c++) {
    t[c] = LOAD(values + (size_t)(4 + c) * plane + at);
    u[c] = LOAD(values + (size_t)(4 + c) * plane + at + step);
    dot += t[c] * u[c];
  }
  VF sign = SEL((VF)(-1.0f), (VF)(1.0f), dot > 0.0f);
  b *= sign;
  good &= (a > 0.0f) != (b > 0.0f);
  if (!any_lane(good)) return good;
  VF p[3], q[3], along = 0.0f;
  place(camera, px, py, LOAD(depths + at), p);
  place(camera, px + dx, py + dy, LOAD(depths + at + step), q);
  for (int c = 0; c < 3; c++) along += (t[c] + sign * u[c]) * (q[c] - p[c]);
  good &= (b - a) * along * (float)EXTREMUM < 0.0f;
  VF k = 0.5f * ABS(LOAD(strength + at) + LOAD(strength + at + step));
  good &= ABS(b - a) >= FLATTEST * k * k * k * ABS(0.5f * along);
#else
  good &= (a > 0.0f) != (b > 0.0f);
#endif
  if (!any_lane(good)) return good;
  VF s = LOAD(strength + at), r = LOAD(strength + at + step);
  return good & (s + (r - s) * (a / (a - b)) >= least);
}

__kernel void line_edges(int width, int height, int stride, int plane, float least, __global const float *camera,
                         __global const float *depths, __global const float *field, __global const float *strength,
                         __global const float *values, __global uchar *codes) {
  int x = get_global_id(0) * VW, y = get_global_id(1);
  if (x >= width || y >= height) return;
  size_t at = PLANE_AT(x, y);
  VF own = LOAD(field + at);
  if (!any_lane(own == own)) return;
  VF px = TO_VF(x + LANE_INDEX), py = (VF)((float)y);
  VI right = edges(camera, depths, field, strength, values, plane, at, 1, px, py, 1.0f, 0.0f, least), down = (VI)(0);
  if (y + 1 < height)
    down = edges(camera, depths, field, strength, values, plane, at, stride, px, py, 0.0f, 1.0f, least);
  if (!any_lane(right | down)) return;
  VI code = SEL((VI)(0), (VI)(EDGE_RIGHT), right) | SEL((VI)(0), (VI)(EDGE_DOWN), down);
  __global uchar *to = codes + (size_t)y * (stride - 2 * MARGIN_X) + x;
#if VW == 1
  *to = (uchar)code;
#else
  for (int i = 0; i < VW; i++) to[i] = (uchar)((int *)&code)[i];
#endif
}
