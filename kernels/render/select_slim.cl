// Level of detail, one level of the hierarchy: mark the children of the visited internal surfels that appear too large.
// Launched level by level, coarse to fine; one work-item handles VW surfels. A surfel has several parents, so marks are
// idempotent. Twin: tests/reference/render.py, select_slim.
#include "common/select_slim.clh"

__kernel void select_slim(__global const float *view, __global const float *surfels, int stride,
                          __global const uchar *flags, __global const int *child_offset, __global const int *children,
                          __global uchar *visited, int begin, int end, int visited_end) {
  int first = begin / VW * VW + get_global_id(0) * VW;
  if (first >= end) return;
  __global const VF *plane = (__global const VF *)(surfels + first);
  int step = stride / VW;
  VF depth = depth_of(view, plane[0], plane[step], plane[2 * step]);
  VI small = is_small(view, depth, plane[SIZE_RADIUS * step]);
  if (all_lanes(small)) return;
  const int *is_small_lane = (const int *)&small;
  for (int lane = 0; lane < VW; lane++) {
    int i = first + lane;
    if (i < begin || i >= end || is_small_lane[lane] || (flags[i] & IS_LEAF)) continue;
    if (!(i < visited_end || (flags[i] & IS_ROOT) || visited[i])) continue;
    for (int c = child_offset[i]; c < child_offset[i + 1]; c++) visited[children[c]] = 1;
  }
}
