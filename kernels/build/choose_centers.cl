// Centres that cover the open points: no two within `spacing`, every open point within `spacing` of one.
//
// One work-item per cell, one launch per colour (parity of the cell's three coordinates). Cells are at least `spacing`
// wide, so cells of one colour cannot see each other's centres: the launches together are a sequential greedy choice
// whose order is colour, then point. A launch takes `cells` cells from number `first` on.
#include "common/lanes.clh"
#include "build/point_tree.clh"

#define OPEN 0
#define TAKEN 1
#define CENTER 2

__kernel void choose_centers(int cells, int first, __global const int *cell_start, __global const int *cell_end,
                             float spacing,
                             int padded, __global const float *sorted, __global const float *boxes,
                             __global const int *node_offset, int top_level, __global uchar *state) {
  int cell = get_global_id(0);
  if (cell >= cells) return;
  __global const float *px = sorted, *py = sorted + padded, *pz = sorted + 2 * (size_t)padded;
  int start = cell_start[first + cell], end = cell_end[first + cell];
  float spacing2 = spacing * spacing;
  uint list[BLOCK_LIST];
  Traversal t;
  for (int i = start; i < end; ++i) {
    if (state[i] != OPEN) continue;
    float x = px[i], y = py[i], z = pz[i];
    traversal_start(&t, top_level);
    int count;
    while ((count = traversal_next(&t, boxes, node_offset, x, y, z, spacing2, list)) > 0)
      for (int b = 0; b < count; ++b) {
        size_t block = list[b];
        float16 dx = ((__global const float16 *)px)[block] - x, dy = ((__global const float16 *)py)[block] - y,
                dz = ((__global const float16 *)pz)[block] - z;
        union { int16 v; int s[16]; } hit;
        hit.v = dx * dx + dy * dy + dz * dz < spacing2;
        __global uchar *mark = state + 16 * block;
        for (int j = 0; j < 16; ++j)
          if (hit.s[j]) mark[j] = TAKEN;
      }
    state[i] = CENTER;
  }
}
