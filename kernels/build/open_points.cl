// Which points still need a surfel at this level: neither covered by leaves nor held by an internal surfel.
// One work-item per block of 16 points; `state` is 0 for an open point (choose_centers.cl). Padding is closed.
#include "common/lanes.clh"

__kernel void open_points(int count, int blocks, uint threshold, __global const uint *overlap,
                          __global const uchar *held, __global uchar *state) {
  int block = get_global_id(0);
  if (block >= blocks) return;
  uint16 covered = ((__global const uint16 *)overlap)[block];
  uchar16 holding = ((__global const uchar16 *)held)[block];
  int16 closed = (covered >= threshold) | (LANE_INDEX >= count - 16 * block);
#ifdef __clang__
  ((__global uchar16 *)state)[block] = (__builtin_convertvector(closed, uchar16) & (uchar)1) | holding;
#else
  ((__global uchar16 *)state)[block] = (convert_uchar16(closed) & (uchar)1) | holding;
#endif
}
