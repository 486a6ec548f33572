// Squared distance to the NEIGHBOUR-th nearest other place, for the first 16 points of each run; candidates are the points
// of the run and of the runs before and after it. One work-item per run (VW = 1: per point).
// Twin: tests/reference/render_points.py, point_spacing.
#include "common/lanes.clh"
#include "render/points.clh"

#define NEIGHBOUR 6
#define ASKED 16

__kernel void point_spacing(__global const float *points, int stride, int runs, __global float *spacing) {
  int run = (int)get_global_id(0) * VW / ASKED, part = get_global_id(0) * VW % ASKED;
  if (run >= runs) return;
  __global const float *own = points + (size_t)run * POINT_RUN + part;
  VF x = *(__global const VF *)own, y = *(__global const VF *)(own + stride), z = *(__global const VF *)(own + 2 * (size_t)stride);
  VF nearest[NEIGHBOUR], far = INFINITY;
  for (int k = 0; k < NEIGHBOUR; k++) nearest[k] = far;
  int begin = (run > 0 ? run - 1 : 0) * POINT_RUN, end = (run + 2 < runs ? run + 2 : runs) * POINT_RUN;
  for (int i = begin; i < end; i++) {
    VF dx = x - points[i], dy = y - points[stride + (size_t)i], dz = z - points[2 * (size_t)stride + i];
    VF d = dx * dx + dy * dy + dz * dz;
    d = SEL(far, d, d > 0.0f);  // neither the point itself nor another at its place, nor one that is not there
    for (int k = 0; k < NEIGHBOUR; k++) {
      VF low = VMIN(d, nearest[k]);
      d = VMAX(d, nearest[k]);
      nearest[k] = low;
    }
  }
  *(__global VF *)(spacing + (size_t)run * ASKED + part) = nearest[NEIGHBOUR - 1];
}
