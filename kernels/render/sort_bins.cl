// Put the pairs of every bin in order from front to back. The rank of a pair is the number of pairs before it, found by
// comparing VW pairs with one at a time; lists are short (about 20). Lists longer than LONGEST stay as they are: order
// only lets the tile kernels stop early. Twin: sort_bins.
#include "common/lanes.clh"
#include "common/bins.clh"

#ifndef LONGEST
#define LONGEST 4096
#endif

__kernel void sort_bins(__global const uint2 *pairs, __global const uint *offsets, int bin_count,
                        __global uint2 *sorted) {
  int bin = get_global_id(0);
  if (bin >= bin_count) return;
  int begin = offsets[bin], end = offsets[bin + 1], n = end - begin;
  if (n == 0) return;
  __global const uint2 *in = pairs + begin;
  __global uint2 *out = sorted + begin;
  if (n == 1 || n > LONGEST) {
    for (int i = 0; i < n; i++) out[i] = in[i];
    return;
  }
  for (int first = 0; first < n; first += VW) {
    VU key, rank = 0, number = AS_VU((VI)(first) + LANE_INDEX);
    uint *keys = (uint *)&key, *ranks = (uint *)&rank;
    int lanes = n - first < VW ? n - first : VW;
    for (int i = 0; i < VW; i++) keys[i] = in[first + (i < lanes ? i : 0)].y;
    for (int j = 0; j < n; j++) {
      uint other = in[j].y;
      // Equal keys keep the order of the primitives.
      rank += SEL((VU)(0u), (VU)(1u), (other < key) | ((other == key) & ((uint)j < number)));
    }
    for (int i = 0; i < lanes; i++) out[ranks[i]] = in[first + i];
  }
}
