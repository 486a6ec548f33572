// Where a leaf's own points end: support of the points in 8 directions of its (u, v) plane, over its radius.
//
// Own points lie in the ball, face the surfel's way and stand near its patch, its own error allowed for; MARGIN point
// spacings are added. Only
// border surfels, whose points end before LIMITED in some direction, are limited: the trimmed ball ends there anyway
// (23 % of the bunny's leaves, 10 % of the dragon's). Cosine 0, 0.3 of the radius and 0.25 spacings drew 372 pixels a
// view outside the bunny's silhouette and 3,383 outside fandisk's; these figures 232 and 1,021, without a hole in the
// bunny or the dragon (fandisk, sparse at its edges: 121 pixels, 118 before). No margin at all draws 197 and 678, but
// lets fragments appear at fandisk's edges. Without NOISE a noisy cloud loses the points that end its surfels, and has
// specks of holes: a jittered box corner with noise of 0.4 spacings 959 pixels in 4 views, 148 with it; the lion's
// plinth 329 and 275 (217 without any footprint); fandisk's outside grows from 414 to 862 a view of 768x768, bunny
// and dragon stay. Wider margins in proportion to the error: 61 and 222, but 1,614 outside fandisk.
#include "common/frame.clh"
#include "common/lanes.clh"
#include "build/point_tree.clh"
#include "build/gather_ball.clh"

#ifndef LIMITED
#define LIMITED 0.7f
#endif
#define RECORD 16 // see fit_surfels.cl
#define HALF_ROOT 0.70710678f
#define OWN_COSINE 0.3f   // between the normals of point and surfel
#define NEAR_PATCH 0.15f  // of the radius; other sheets of the scan are further off
#define NOISE 4.0f        // of the surfel's error, where that is more
#define MARGIN 0.08f      // point spacings

__kernel void surfel_footprints(int surfels, __global const int *center, __global const float *record, int terms,
                                int padded, __global const float *sorted, __global const float *boxes,
                                __global const int *node_offset, int top_level, __global uchar *footprint) {
  int s = get_global_id(0);
  if (s >= surfels) return;
  __global const float *surfel = record + RECORD * (size_t)s, *k = surfel + 6;
  __global uchar *out = footprint + 8 * (size_t)s;
  for (int i = 0; i < 8; ++i) out[i] = 255;
  if (surfel[5] == 0.0f) return;
  size_t n = padded / 16;
  float x = sorted[center[s]], y = sorted[16 * n + center[s]], z = sorted[32 * n + center[s]];
  float radius = surfel[0], r2 = radius * radius;
  float near = NEAR_PATCH * radius;
  near = near > NOISE * surfel[4] ? near : NOISE * surfel[4];
  float3 w_axis = (float3)(surfel[1], surfel[2], surfel[3]), u_axis, v_axis;
  frame_of_normal(w_axis, &u_axis, &v_axis);
  VF count = 0.0f, reach[8];
  for (int i = 0; i < 8; ++i) reach[i] = -1e30f;
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, x, y, z, r2, list)) > 0)
    for (int b = 0; b < blocks; ++b) {
      __global const float16 *block = (__global const float16 *)sorted + list[b];
      VF dx = block[0] - x, dy = block[n] - y, dz = block[2 * n] - z;
      VF cosine = block[3 * n] * w_axis.x + block[4 * n] * w_axis.y + block[5 * n] * w_axis.z;
      VF u = u_axis.x * dx + u_axis.y * dy + u_axis.z * dz, v = v_axis.x * dx + v_axis.y * dy + v_axis.z * dz;
      VF f = w_axis.x * dx + w_axis.y * dy + w_axis.z * dz - k[0];
      if (terms >= 6) f -= k[1] * u + k[2] * v + u * (k[3] * u + k[4] * v) + k[5] * v * v;
      if (terms >= 10) f -= u * u * (k[6] * u + k[7] * v) + v * v * (k[8] * u + k[9] * v);
      VI own = (dx * dx + dy * dy + dz * dz < r2) & (cosine > OWN_COSINE);
      own &= (f < near) & (f > -near);
      count += SEL((VF)0.0f, (VF)1.0f, own);
      VF along[4] = {u, HALF_ROOT * (u + v), v, HALF_ROOT * (v - u)};
      for (int i = 0; i < 4; ++i) {
        VF ahead = SEL((VF)-1e30f, along[i], own), behind = SEL((VF)-1e30f, -along[i], own);
        reach[i] = VMAX(reach[i], ahead);
        reach[i + 4] = VMAX(reach[i + 4], behind);
      }
    }
  float points = sum_lanes(count);
  if (points < 1.0f) return;
  float margin = MARGIN * sqrt(3.14159265f / points); // spacing over radius: a disc of `points` points
  float share[8], least = 1.0f;
  for (int i = 0; i < 8; ++i) {
    union { VF v; float s[16]; } lanes;
    lanes.v = reach[i];
    float most = lanes.s[0];
    for (int j = 1; j < 16; ++j) most = lanes.s[j] > most ? lanes.s[j] : most;
    share[i] = most / radius + margin;
    least = share[i] < least ? share[i] : least;
  }
  if (least >= LIMITED) return;
  for (int i = 0; i < 8; ++i) out[i] = share[i] >= 1.0f ? 255 : share[i] > 0.0f ? (uchar)ceil(255.0f * share[i]) : 0;
}
