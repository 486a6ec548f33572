// The coverage of these points by leaves made from others (a thinned copy of the scan): cover_points for given places.
#include "build/cover.clh"

__kernel void cover_leaves(int count, __global const float *place, __global const float *record, float tolerance,
                           int terms, int padded, __global const float *sorted, __global const float *boxes,
                           __global const int *node_offset, int top_level, __global uint *overlap,
                           __global uchar *held) {
  int s = get_global_id(0);
  if (s >= count) return;
  cover_ball(place[3 * s], place[3 * s + 1], place[3 * s + 2], record + RECORD * (size_t)s, tolerance, terms, padded,
             sorted, boxes, node_offset, top_level, overlap, held);
}
