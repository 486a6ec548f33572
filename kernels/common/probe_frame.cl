// Probe of frame.clh for the tests: normals (n, 3) to frames (n, 6).
#include "common/frame.clh"

__kernel void probe_frame(__global const float *normals, __global float *frames) {
  int i = get_global_id(0);
  float3 u, v;
  frame_of_normal(vload3(i, normals), &u, &v);
  vstore3(u, 2 * i, frames);
  vstore3(v, 2 * i + 1, frames);
}
