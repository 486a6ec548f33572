// How leaves made from other points (a thinned copy of the scan) fit these: the sums of G and G f^2 over the points of
// each ball that count (own 1), two floats a leaf. Sums over the parts of a scan add up.
#include "build/cover.clh"

__kernel void check_leaves(int count, __global const float *place, __global const float *record, int terms, int padded,
                           __global const float *sorted, __global const uchar *own, __global const float *boxes,
                           __global const int *node_offset, int top_level, __global float *sums) {
  int s = get_global_id(0);
  if (s >= count) return;
  __global const float *surfel = record + RECORD * (size_t)s;
  size_t n = padded / 16;
  float x = place[3 * s], y = place[3 * s + 1], z = place[3 * s + 2];
  float r2 = surfel[0] * surfel[0], inverse = 1.0f / r2;
  float3 u_axis, v_axis;
  frame_of_normal((float3)(surfel[1], surfel[2], surfel[3]), &u_axis, &v_axis);
  float16 weight = 0.0f, squares = 0.0f;
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, x, y, z, r2, list)) > 0)
    for (int b = 0; b < blocks; ++b) {
      __global const float16 *block = (__global const float16 *)sorted + list[b];
      float16 dx = block[0] - x, dy = block[n] - y, dz = block[2 * n] - z;
      float16 g = 1.0f - (dx * dx + dy * dy + dz * dz) * inverse;
      g = SEL(g, (float16)0.0f, g < 0.0f);
      g = g * g * g * TO_VF(convert_int16(((__global const uchar16 *)own)[list[b]]));
      float16 f = off_surfel(surfel, u_axis, v_axis, terms, dx, dy, dz);
      weight += g;
      squares += g * f * f;
    }
  union { float16 v; float s[16]; } a, b;
  a.v = weight, b.v = squares;
  float sum = 0.0f, sum2 = 0.0f;
  for (int j = 0; j < 16; ++j) sum += a.s[j], sum2 += b.s[j];
  sums[2 * s] = sum;
  sums[2 * s + 1] = sum2;
}
