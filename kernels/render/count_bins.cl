// Count the pairs of every bin, for each chunk of primitives apart: the counts of one chunk are written by one work-item,
// so that lists have the order of the primitives whatever the order of execution. Twin: count_bins.
#include "common/bins.clh"

__kernel void count_bins(__global const short4 *full, __global const uint *keys, int count, int chunk,
                         int bins_x, int bin_count, __global uint *counts) {
  int part = get_global_id(0);
  int begin = part * chunk, end = begin + chunk < count ? begin + chunk : count;
  if (begin >= count) return;
  __global uint *mine = counts + (size_t)part * bin_count;
  for (int i = 0; i < bin_count; i++) mine[i] = 0;
  for (int i = begin; i < end; i++) {
    short4 r = full[i];
    if (r.x > r.z) continue;
    uint sides = keys[i] & 3u;
    sides = (sides & 1u) + (sides >> 1);
    for (int y = r.y >> 1; y <= r.w >> 1; y++)
      for (int x = r.x >> 1; x <= r.z >> 1; x++) mine[y * bins_x + x] += sides;
  }
}
