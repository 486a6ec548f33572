// Probe of lanes.clh for the tests: minimum, maximum, square root of a square, selection, reductions.
#include "common/lanes.clh"

__kernel void probe_lanes(__global const float *a, __global const float *b, __global float *low, __global float *high,
                          __global float *root, __global float *chosen, __global int *flags) {
  int i = get_global_id(0);
  VF x = ((__global const VF *)a)[i], y = ((__global const VF *)b)[i];
  ((__global VF *)low)[i] = VMIN(x, y);
  ((__global VF *)high)[i] = VMAX(x, y);
  ((__global VF *)root)[i] = VSQRT(x * x);
  ((__global VF *)chosen)[i] = TO_VF(TO_VI(SEL((VF)(7.0f), x, x > y)));
  flags[2 * i] = any_lane(x > y);
  flags[2 * i + 1] = all_lanes(x > y);
}
