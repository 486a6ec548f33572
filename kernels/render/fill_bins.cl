// Write the pairs of every bin, one work-item per chunk of primitives, into the places that the scans found. The
// primitives come front to back, so the lists do. Twin: fill_bins.
#include "common/lanes.clh"
#include "common/bins.clh"

#define AHEAD 16  // primitives: they are scattered. Surfels of the dragon at 1024x1024, PoCL: 2.4 to 1.8 ms

__kernel void fill_bins(__global const uint *order, __global const uint *depth_offsets, __global const short4 *full,
                        __global const short4 *core, __global const uint *keys, int parts, int bins_x, int bin_count,
                        __global const int *touched, __global uint *counts, __global const uint *offsets, __global uint2 *pairs) {
  int part = get_global_id(0), count = depth_offsets[DEPTH_BUCKETS], chunk = (count + parts - 1) / parts;
  int begin = part * chunk, end = begin + chunk < count ? begin + chunk : count;
  __global uint *mine = counts + (size_t)part * bin_count;
  if (begin >= end) return;
  for (int i = 0; i < bin_count; i++) mine[i] += offsets[i];  // one scattered read a pair less
  for (int i = begin; i < end; i++) {
#ifdef HAS_PREFETCH
    uint ahead = order[i + AHEAD < end ? i + AHEAD : i];
    __builtin_prefetch((const void *)(size_t)(full + ahead));
    __builtin_prefetch((const void *)(size_t)(core + ahead));
    __builtin_prefetch((const void *)(size_t)(keys + ahead));
#endif
    uint index = order[i];
    short4 r = full[index], c = core[index];
    uint key = keys[index] & 0xffffff00u;
    index |= (keys[index] & 3u) << 30;
    for (int y = r.y >> 1; y <= r.w >> 1; y++) {
      uint row = rows_of(r.y, r.w, y), core_row = rows_of(c.y, c.w, y);
      for (int x = r.x >> 1; x <= r.z >> 1; x++) {
        if (!WANTED(y * bins_x + x)) continue;
        uint bits = (core_row & columns_of(c.x, c.z, x)) << 4 | (row & columns_of(r.x, r.z, x));
        pairs[mine[y * bins_x + x]++] = (uint2)(index, key | bits);
      }
    }
  }
}
