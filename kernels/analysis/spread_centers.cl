// Centres that cover the points: every point lies within its block's spacing of a centre whose normal is compatible.
//
// As build/choose_centers.cl, with a spacing per block of 16 points instead of one for all: cells are at least as wide as the
// widest spacing, one launch per colour, so that the launches together are a sequential greedy choice. A centre may lie
// within the wider spacing of another one and stays a centre: what is covered and what is a centre stand apart, so that
// work-items of one launch only ever write the same value to a byte that they share.
#include "common/lanes.clh"
#include "build/point_tree.clh"

#ifndef SHEET_COSINE
#define SHEET_COSINE 0.2f // see quartic.clh: a sheet's centres do not cover the sheet behind it
#endif

__kernel void spread_centers(int cells, int first, __global const int *cell_start, __global const int *cell_end,
                             __global const float *spacing, int padded, __global const float *sorted,
                             __global const float *boxes, __global const int *node_offset, int top_level,
                             __global uchar *covered, __global uchar *chosen) {
  int cell = get_global_id(0);
  if (cell >= cells) return;
  size_t n = padded, n16 = padded / 16;
  int start = cell_start[first + cell], end = cell_end[first + cell];
  uint list[BLOCK_LIST];
  Traversal t;
  for (int i = start; i < end; ++i) {
    if (covered[i]) continue;
    __global const float *own = sorted + i;
    float x = own[0], y = own[n], z = own[2 * n], nx = own[3 * n], ny = own[4 * n], nz = own[5 * n];
    float reach = spacing[i / 16], reach2 = reach * reach;
    traversal_start(&t, top_level);
    int count;
    while ((count = traversal_next(&t, boxes, node_offset, x, y, z, reach2, list)) > 0)
      for (int b = 0; b < count; ++b) {
        __global const float16 *block = (__global const float16 *)sorted + list[b];
        float16 dx = block[0] - x, dy = block[n16] - y, dz = block[2 * n16] - z;
        union { int16 v; int s[16]; } hit;
        hit.v = (dx * dx + dy * dy + dz * dz < reach2) &
                (nx * block[3 * n16] + ny * block[4 * n16] + nz * block[5 * n16] >= SHEET_COSINE);
        __global uchar *mark = covered + 16 * (size_t)list[b];
        for (int j = 0; j < 16; ++j)
          if (hit.s[j]) mark[j] = 1;
      }
    covered[i] = chosen[i] = 1;
  }
}
