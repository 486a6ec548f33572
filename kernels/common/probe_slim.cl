// Probe for tests: the polynomial along a ray and its root, one ray of VW equal lanes per work-item.
#include "common/slim.clh"

__kernel void probe_slim(__global const float *records, __global const float *start, __global const float *direction,
                         __global const float *side, int count, __global float *out) {
  int i = get_global_id(0);
  if (i >= count) return;
  VF s, slope, u = start[3 * i], v = start[3 * i + 1], w = start[3 * i + 2];
  RayPoly p = ray_poly(records + i * RECORD_FLOATS, u, v, w, direction[3 * i], direction[3 * i + 1],
                       direction[3 * i + 2]);
  VI good = ray_root(p, (VF)(side[i]), &s, &slope);
  VF found[6] = {p.a, p.b, p.c, p.d, s, slope};
  for (int j = 0; j < 6; j++) out[7 * i + j] = ((float *)&found[j])[VW - 1];
  out[7 * i + 6] = all_lanes(good) ? 1.0f : 0.0f;
}
