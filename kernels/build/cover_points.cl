// What new surfels do to the points: a leaf adds its weight G(d / R), R = ALPHA r, to the overlap of the points it
// represents; an internal surfel marks the points of its ball as held at this level.
//
// A leaf represents points that face its way and that it comes within `tolerance` of (infinite: all). Overlap is fixed
// point (2^20 is 1, rounded down), because integer sums do not depend on the order of atomics.
#include "build/cover.clh"

__kernel void cover_points(int count, __global const int *center, __global const float *record, float tolerance,
                           int terms, int padded, __global const float *sorted, __global const float *boxes,
                           __global const int *node_offset, int top_level, __global uint *overlap,
                           __global uchar *held) {
  int s = get_global_id(0);
  if (s >= count) return;
  __global const float *surfel = record + RECORD * (size_t)s, *at = sorted + center[s];
  size_t n = padded;
  cover_ball(at[0], at[n], at[2 * n], surfel, tolerance, terms, padded, sorted, boxes, node_offset, top_level, overlap,
             held);
  // A centre is always represented by its own leaf, whatever its normal.
  if (surfel[5] > 0.0f) atomic_add(overlap + center[s], (uint)ONE);
}
