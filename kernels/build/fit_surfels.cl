// One surfel per work-item: all radii of its golden-ratio segment at once, a radius per vector lane.
//
// Lane i has the radius r_r g^(2 (14 - i) / 14), g the golden ratio: lane 0 is r_l, 7 is r_m, 14 is r_r (paper 003,
// equations 3-5); lane 15 repeats 14. Three passes over the ball's points: mean normal, moments, residuals (e^2 by
// subtraction loses it to rounding). The radius of least E is taken among lanes with at least NEED points.
#include "common/frame.clh"
#include "build/gather_ball.clh"
#include "build/polynomial_fit.clh"

#ifndef NEED
#define NEED (2 * TERMS + 2) // fewer over-fit and leave specks
#endif
#define SEGMENT 0 // minimise E over the segment
#define FORCED 1  // the same, but always a leaf
#define FIXED 2   // always a leaf, with radius r_r
#define CUBIC_LIMIT 1.0f // |c r^2| of a cubic term; beyond it the cubic terms of a lane are dropped
#define RECORD 16 // floats out: radius, normal, e, leaf, coefficients from 6

inline VF weight_of(float d2, VF inverse_r2) {
  VF g = 1.0f - d2 * inverse_r2;
  g = SEL(g, (VF)0.0f, g < 0.0f);
  return g * g * g;
}

// Normalised mean of the normals in each lane's ball, nudged off the frame's seam z = 0; count: points in the ball.
inline void mean_normals(const Ball *ball, VF inverse_r2, VF *mean, VI *count) {
  VF x = 0.0f, y = 0.0f, z = 0.0f;
  VI n = 0;
  for (int i = 0; i < ball->count; ++i) {
    float d2 = ball->x[i] * ball->x[i] + ball->y[i] * ball->y[i] + ball->z[i] * ball->z[i];
    VF w = weight_of(d2, inverse_r2);
    x += w * ball->nx[i];
    y += w * ball->ny[i];
    z += w * ball->nz[i];
    n -= w > 0.0f;
  }
  mean[0] = x;
  mean[1] = y;
  mean[2] = z;
  *count = n;
}

// Scale to unit length; where the sum vanishes (two sheets), `own` is taken. A stored normal decodes to within
// rounding, which must not carry it over z = 0, where the frame jumps.
inline void unit_normals(VF *n, float own_x, float own_y, float own_z) {
  VF s = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
  VI lost = s < 1e-12f;
  VF k = 1.0f / VSQRT(SEL(s, (VF)1.0f, lost));
  VF z = SEL(n[2] * k, (VF)own_z, lost);
  z = SEL(z, SEL((VF)1e-5f, (VF)-1e-5f, z < 0.0f), (z < 1e-5f) & (z > -1e-5f));
  n[0] = SEL(n[0] * k, (VF)own_x, lost);
  n[1] = SEL(n[1] * k, (VF)own_y, lost);
  n[2] = z;
}

// Rows of the lanes' frames: axis[0..2] = u, [3..5] = v, [6..8] = n, divided by the lane's radius (see common/frame.clh).
inline void frames_of(const VF *n, VF inverse_r, VF *axis) {
  VF s = SEL((VF)1.0f, (VF)-1.0f, n[2] < 0.0f);
  VF a = -1.0f / (s + n[2]);
  VF b = n[0] * n[1] * a;
  axis[0] = (1.0f + s * n[0] * n[0] * a) * inverse_r;
  axis[1] = s * b * inverse_r;
  axis[2] = -s * n[0] * inverse_r;
  axis[3] = b * inverse_r;
  axis[4] = (s + n[1] * n[1] * a) * inverse_r;
  axis[5] = -n[1] * inverse_r;
  axis[6] = n[0] * inverse_r;
  axis[7] = n[1] * inverse_r;
  axis[8] = n[2] * inverse_r;
}

#define LOCAL_COORDINATES(i)                                                                   \
  float x = ball->x[i], y = ball->y[i], z = ball->z[i];                                        \
  VF weight = weight_of(x * x + y * y + z * z, inverse_r2);                                    \
  VF u = axis[0] * x + axis[1] * y + axis[2] * z, v = axis[3] * x + axis[4] * y + axis[5] * z, \
     w = axis[6] * x + axis[7] * y + axis[8] * z;

inline void sum_moments(const Ball *ball, VF inverse_r2, const VF *axis, VF *moment, VF *right) {
  for (int k = 0; k < MOMENTS; ++k) moment[k] = 0.0f;
  for (int k = 0; k < TERMS; ++k) right[k] = 0.0f;
  for (int i = 0; i < ball->count; ++i) {
    LOCAL_COORDINATES(i)
    VF wu = weight * u, wv = weight * v;
    moment[0] += weight;
    moment[1] += wu;
    moment[2] += wv;
    right[0] += weight * w;
    right[1] += wu * w;
    right[2] += wv * w;
    VF uu = wu * u, uv = wu * v, vv = wv * v;
    moment[3] += uu;
    moment[4] += uv;
    moment[5] += vv;
#if DEGREE >= 2
    right[3] += uu * w;
    right[4] += uv * w;
    right[5] += vv * w;
    VF u2 = u * u, v2 = v * v;
    VF uuu = uu * u, uuv = uu * v, uvv = vv * u, vvv = vv * v;
    moment[6] += uuu;
    moment[7] += uuv;
    moment[8] += uvv;
    moment[9] += vvv;
    VF u4 = uu * u2, u3v = uuu * v, u2v2 = uu * v2, uv3 = vvv * u, v4 = vv * v2;
    moment[10] += u4;
    moment[11] += u3v;
    moment[12] += u2v2;
    moment[13] += uv3;
    moment[14] += v4;
#endif
#if DEGREE >= 3
    right[6] += uuu * w;
    right[7] += uuv * w;
    right[8] += uvv * w;
    right[9] += vvv * w;
    moment[15] += u4 * u;
    moment[16] += u4 * v;
    moment[17] += u3v * v;
    moment[18] += uv3 * u;
    moment[19] += v4 * u;
    moment[20] += v4 * v;
    moment[21] += u4 * u2;
    moment[22] += u4 * u * v;
    moment[23] += u4 * v2;
    moment[24] += u3v * v2;
    moment[25] += u2 * v4;
    moment[26] += v4 * u * v;
    moment[27] += v4 * v2;
#endif
  }
}

// Weighted mean of squared residuals, in units of the lane's radius squared.
inline VF mean_residual2(const Ball *ball, VF inverse_r2, const VF *axis, const VF *c) {
  VF sum = 0.0f, total = 1e-30f;
  for (int i = 0; i < ball->count; ++i) {
    LOCAL_COORDINATES(i)
    VF f = w - height_at(c, u, v);
    sum += weight * f * f;
    total += weight;
  }
  return sum / total;
}

#if DEGREE == 3
// Lanes with wild cubic terms keep the quadratic fit.
inline void tame_cubic(const VF *moment, const VF *right, VF *c) {
  VF square[TERMS];
  for (int k = 6; k < 10; ++k) square[k] = 0.0f;
  solve_terms(moment, right, square, 6);
  VI wild = c[6] != c[6];
  for (int k = 6; k < 10; ++k) wild |= (c[k] > CUBIC_LIMIT) | (c[k] < -CUBIC_LIMIT);
  for (int k = 0; k < 10; ++k) c[k] = SEL(c[k], square[k], wild);
}
#endif

#if DEGREE == 1
// The frame turns to the fitted plane; c[0] becomes the plane's distance, the slopes vanish.
inline VF turn_to_plane(VF *normal, const VF *axis, VF r, VF *c) {
  VF k = 1.0f / VSQRT(1.0f + c[1] * c[1] + c[2] * c[2]);
  for (int a = 0; a < 3; ++a) normal[a] = (axis[6 + a] - c[1] * axis[a] - c[2] * axis[3 + a]) * (r * k);
  c[0] *= k;
  c[1] = c[2] = 0.0f;
  return k;
}
#endif

// The lane to take: a leaf's, or 14 for an internal surfel.
inline int choose_lane(const float *energy, const float *e2, const int *count, int need, int mode, int *leaf) {
  int lowest = 14;
  while (lowest > 0 && count[lowest - 1] >= need) --lowest;
  int best = 14;
  for (int i = 13; i >= lowest; --i)
    if (energy[i] < energy[best]) best = i;
  if (mode == FIXED) best = 14;
  // A leaf: an interior minimum with e rising (condition 4), E still falling at r_r, or no smaller radius to try.
  int middle = lowest > 7 ? lowest : 7;
  int rising = e2[lowest] <= e2[middle] && e2[middle] <= e2[14];
  *leaf = mode != SEGMENT || best == 14 || (best > lowest && rising) || (best == lowest && lowest > 0);
  return *leaf ? best : 14;
}

__kernel void fit_surfels(int surfels, __global const int *center, float r_r, float lambda_t2, int need, int mode,
                          int padded, __global const float *sorted, __global const float *boxes,
                          __global const int *node_offset, int top_level, __global float *out) {
  int s = get_global_id(0);
  if (s >= surfels) return;
  int own = center[s];
  float x = sorted[own], y = sorted[padded + (size_t)own], z = sorted[2 * (size_t)padded + own];
  Ball ball;
  float radius = r_r;
  gather_ball(&ball, padded, sorted, boxes, node_offset, top_level, x, y, z, radius);
  while (ball.count < need && radius < 8.0f) { // too sparse here: the ball grows until it has enough
    radius *= 1.25f;
    mode = mode == SEGMENT ? FORCED : mode;
    gather_ball(&ball, padded, sorted, boxes, node_offset, top_level, x, y, z, radius);
  }
  // g^(2 (14 - i) / 14)
  VF r = radius * (VF)(0.381966011f, 0.409151886f, 0.438272665f, 0.469466063f, 0.502879599f, 0.538671289f, 0.577010394f,
                       0.618033989f, 0.662021714f, 0.709140230f, 0.759612349f, 0.813676760f, 0.871589122f, 0.933623281f,
                       1.0f, 1.0f);
  VF inverse_r = 1.0f / r, inverse_r2 = inverse_r * inverse_r;
  VF normal[3], axis[9], moment[MOMENTS], right[TERMS], c[TERMS];
  union { VI v; int s[16]; } count;
  mean_normals(&ball, inverse_r2, normal, &count.v);
  unit_normals(normal, sorted[3 * (size_t)padded + own], sorted[4 * (size_t)padded + own],
               sorted[5 * (size_t)padded + own]);
  frames_of(normal, inverse_r, axis);
  sum_moments(&ball, inverse_r2, axis, moment, right);
  solve_terms(moment, right, c, TERMS);
#if DEGREE == 3
  tame_cubic(moment, right, c);
#endif
  for (int k = 0; k < TERMS; ++k) c[k] = SEL((VF)0.0f, c[k], (c[k] > -1e6f) & (c[k] < 1e6f)); // also NaN
  union { VF v; float s[16]; } e2, energy;
  e2.v = mean_residual2(&ball, inverse_r2, axis, c) * r * r;
#if DEGREE == 1
  VF k = turn_to_plane(normal, axis, r, c);
  e2.v *= k * k;
#endif
  energy.v = e2.v + lambda_t2 * inverse_r2;
  int leaf, lane = choose_lane(energy.s, e2.s, count.s, need, mode, &leaf);
  __global float *o = out + RECORD * (size_t)s;
  float chosen = ((float *)&r)[lane];
  o[0] = chosen;
  for (int a = 0; a < 3; ++a) o[1 + a] = ((float *)&normal[a])[lane];
  o[4] = sqrt(e2.s[lane]);
  o[5] = leaf;
  float scale[4] = {chosen, 1.0f, 1.0f / chosen, 1.0f / (chosen * chosen)}; // out of the units of the radius
  for (int k = 0; k < (DEGREE == 1 ? 1 : TERMS); ++k)
    o[6 + k] = ((float *)&c[k])[lane] * scale[TERM_U[k] + TERM_V[k]];
}
