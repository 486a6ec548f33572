// Colours of surfels: mean over the points that face their way, weighted by G(d / r), of four values a point.
#include "common/lanes.clh"
#include "build/point_tree.clh"
#include "build/gather_ball.clh"

#define RECORD 16 // see fit_surfels.cl

__kernel void surfel_colors(int surfels, __global const int *center, __global const float *record,
                            __global const float *color, int padded, __global const float *sorted,
                            __global const float *boxes, __global const int *node_offset, int top_level,
                            __global float *out) {
  int s = get_global_id(0);
  if (s >= surfels) return;
  __global const float *surfel = record + RECORD * (size_t)s;
  size_t n = padded / 16;
  int c = center[s];
  float x = sorted[c], y = sorted[16 * n + c], z = sorted[32 * n + c];
  float r2 = surfel[0] * surfel[0], inverse = 1.0f / r2;
  VF total = 0.0f, sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, x, y, z, r2, list)) > 0)
    for (int b = 0; b < blocks; ++b) {
      __global const float16 *block = (__global const float16 *)sorted + list[b];
      VF dx = block[0] - x, dy = block[n] - y, dz = block[2 * n] - z;
      VF cosine = block[3 * n] * surfel[1] + block[4 * n] * surfel[2] + block[5 * n] * surfel[3];
      VF g = 1.0f - (dx * dx + dy * dy + dz * dz) * inverse;
      g = SEL(g, (VF)0.0f, (g < 0.0f) | (cosine <= 0.0f));
      g = g * g * g;
      total += g;
      for (int i = 0; i < 4; ++i) sum[i] += g * ((__global const float16 *)color)[i * n + list[b]];
    }
  float weight = sum_lanes(total);
  for (int i = 0; i < 4; ++i)
    out[4 * (size_t)s + i] = weight > 0.0f ? sum_lanes(sum[i]) / weight : color[16 * n * i + c];
}
