// Write the pairs of every bin, one work-item per chunk of primitives, into the places that scan_bins found.
// Twin: fill_bins.
#include "common/bins.clh"

__kernel void fill_bins(__global const short4 *full, __global const short4 *core, __global const uint *keys,
                        int count, int chunk, int bins_x, int bin_count,
                        __global uint *counts, __global const uint *offsets, __global uint2 *pairs) {
  int part = get_global_id(0);
  int begin = part * chunk, end = begin + chunk < count ? begin + chunk : count;
  if (begin >= count) return;
  __global uint *mine = counts + (size_t)part * bin_count;
  for (int i = begin; i < end; i++) {
    short4 r = full[i], c = core[i];
    if (r.x > r.z) continue;
    uint key = keys[i] & 0xffffff00u, sides = keys[i] & 3u;
    for (int y = r.y >> 1; y <= r.w >> 1; y++)
      for (int x = r.x >> 1; x <= r.z >> 1; x++) {
        int bin = y * bins_x + x;
        uint at = offsets[bin] + mine[bin];
        uint bits = key | block_bits(c, x, y) << 4 | block_bits(r, x, y);
        if (sides & 1u) pairs[at++] = (uint2)((uint)i, bits);
        if (sides & 2u) pairs[at++] = (uint2)((uint)i | FROM_BEHIND, bits);
        mine[bin] = at - offsets[bin];
      }
  }
}
