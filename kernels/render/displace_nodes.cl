// Displace the nodes of a geosphere by a scale map (Reiter, "Spherical Scale Mapping", listing 2), and give each its
// normal, interpolated between the texels' own. VW nodes a work-item. Twin: tests/reference/scale_map.py, displace_nodes.
#include "render/scale_sample.clh"

__kernel void displace_nodes(int count, int size, __global const float *rho /* (6, size + 2, size + 2); -1: hole */,
                             __global const float4 *normals /* the same nodes */,
                             __global const float *directions /* (count, 3) unit */, int stride,
                             __global float *positions /* 3 planes of stride; NaN in holes */,
                             __global float4 *nodes /* (count): normal, rho */) {
  int first = get_global_id(0) * VW;
  if (first >= count) return;
  VI at = LANE_INDEX + first;
  at = SEL(at, (VI)(count - 1), at >= count);
  VF x = take(directions, 3 * at), y = take(directions, 3 * at + 1), z = take(directions, 3 * at + 2);
  VF value = sample_scale(rho, size, x, y, z), n[3], zero = 0.0f, one = 1.0f;
  Net net = net_of(size, x, y, z);
  for (int c = 0; c < 3; c++) n[c] = zero;
  for (int k = 0; k < 4; k++) {
    VI node = net.node + ((k >> 1) * (size + 2) + (k & 1));
    VF w = (k & 1 ? net.u : one - net.u) * (k >> 1 ? net.v : one - net.v);
    w = SEL(zero, w, take(rho, node) >= 0.0f);
    for (int c = 0; c < 3; c++) n[c] += w * take((__global const float *)normals, 4 * node + c);
  }
  VF length = VSQRT(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), inverse = one / VMAX(length, (VF)(1e-20f));
  VI hole = value < 0.0f, none = length < 1e-10f;
  VF nothing = as_float(0x7fc00000);
  VF px = SEL(value * x, nothing, hole), py = SEL(value * y, nothing, hole), pz = SEL(value * z, nothing, hole);
  n[0] = SEL(n[0] * inverse, x, none); n[1] = SEL(n[1] * inverse, y, none); n[2] = SEL(n[2] * inverse, z, none);
  for (int lane = 0; lane < VW && first + lane < count; lane++) {
    int to = first + lane;
    positions[to] = ((float *)&px)[lane]; positions[stride + to] = ((float *)&py)[lane];
    positions[2 * stride + to] = ((float *)&pz)[lane];
    nodes[to] = (float4)(((float *)&n[0])[lane], ((float *)&n[1])[lane], ((float *)&n[2])[lane], ((float *)&value)[lane]);
  }
}
