// Count the pairs of every bin, for each chunk of primitives apart: the counts of one chunk are written by one work-item,
// so that lists have the order of the primitives whatever the order of execution. Twin: count_bins.
#include "common/lanes.clh"
#include "common/bins.clh"

#define AHEAD 16  // primitives: they are scattered

__kernel void count_bins(__global const uint *order, __global const uint *depth_offsets, __global const short4 *full,
                         int parts, int bins_x, int bin_count, __global const int *touched, __global uint *counts) {
  int part = get_global_id(0), count = depth_offsets[DEPTH_BUCKETS], chunk = (count + parts - 1) / parts;
  int begin = part * chunk, end = begin + chunk < count ? begin + chunk : count;
  __global uint *mine = counts + (size_t)part * bin_count;
  for (int i = 0; i < bin_count; i++) mine[i] = 0;
  for (int i = begin; i < end; i++) {
#ifdef HAS_PREFETCH
    __builtin_prefetch((const void *)(size_t)(full + order[i + AHEAD < end ? i + AHEAD : i]));
#endif
    short4 r = full[order[i]];
    for (int y = r.y >> 1; y <= r.w >> 1; y++)
      for (int x = r.x >> 1; x <= r.z >> 1; x++) mine[y * bins_x + x] += WANTED(y * bins_x + x);
  }
}
