// The blend of guided surfels at points with normals, a point per lane: signed offset from the blended surface along its
// gradient (paper 003, equations 6 and 7, averaged at a point), unit normal, effective points of the surfels.
#include "analysis/guided.clh"

__kernel void guided_blend(int count, int stride, __global const float *queries, float eighth_sharp,
                           __global const float *surfels, int padded, __global const float *balls,
                           __global const float *boxes, __global const int *node_offset, int top_level, int out_stride,
                           __global float *out) {
  int packet = get_global_id(0);
  if (VW * packet >= count) return;
  Lanes q[6];
  for (int k = 0; k < 6; ++k)
    for (int j = 0; j < VW; ++j) { // the last packet's empty lanes repeat its first query
      int i = VW * packet + j < count ? VW * packet + j : VW * packet;
      q[k].s[j] = queries[k * (size_t)stride + i];
    }
  VF x = q[0].v, y = q[1].v, z = q[2].v, nx = q[3].v, ny = q[4].v, nz = q[5].v;
  Sphere s = sphere_of_lanes(x, y, z);
  VF total = 0.0f, f = 0.0f, gx = 0.0f, gy = 0.0f, gz = 0.0f, points = 0.0f;
  size_t n = padded;
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, s.x, s.y, s.z, s.extent * s.extent, list)) > 0)
    for (int k = 0; k < blocks; ++k)
      for (int j = 0; j < 16; ++j) {
        size_t i = 16 * (size_t)list[k] + j;
        float r = balls[3 * n + i], cx = balls[i] - s.x, cy = balls[n + i] - s.y, cz = balls[2 * n + i] - s.z;
        // What pads the last block has no radius.
        if (!(r > 0.0f) || cx * cx + cy * cy + cz * cz > (r + s.extent) * (r + s.extent)) continue;
        __global const float *o = surfels + GUIDED_SURFEL * i;
        float3 u3, v3, n3 = (float3)(o[4], o[5], o[6]);
        frame_of_normal(n3, &u3, &v3);
        VF dx = x - o[0], dy = y - o[1], dz = z - o[2], turn = 1.0f - (nx * n3.x + ny * n3.y + nz * n3.z);
        VF g = guided_weight((dx * dx + dy * dy + dz * dz) * (1.0f / (r * r)), turn, eighth_sharp) * o[13];
        VF u = u3.x * dx + u3.y * dy + u3.z * dz, v = v3.x * dx + v3.y * dy + v3.z * dz,
           w = n3.x * dx + n3.y * dy + n3.z * dz;
        VF h = o[7] + u * (o[8] + o[10] * u + o[11] * v) + v * (o[9] + o[12] * v);
        VF hu = o[8] + 2.0f * o[10] * u + o[11] * v, hv = o[9] + o[11] * u + 2.0f * o[12] * v;
        total += g, f += g * (w - h), points += g * o[13];
        gx += g * (n3.x - hu * u3.x - hv * v3.x);
        gy += g * (n3.y - hu * u3.y - hv * v3.y);
        gz += g * (n3.z - hu * u3.z - hv * v3.z);
      }
  VF length2 = gx * gx + gy * gy + gz * gz;
  VI blended = (total > 1e-20f) & (length2 > 1e-12f * total * total);
  VF k = 1.0f / VSQRT(SEL((VF)1.0f, length2, blended));
  Lanes result[5];
  result[0].v = SEL((VF)0.0f, f * k, blended);
  result[1].v = SEL(nx, gx * k, blended);
  result[2].v = SEL(ny, gy * k, blended);
  result[3].v = SEL(nz, gz * k, blended);
  result[4].v = SEL((VF)0.0f, points / total, blended);
  for (int m = 0; m < 5; ++m)
    for (int j = 0; j < VW && VW * packet + j < count; ++j)
      out[m * (size_t)out_stride + VW * (size_t)packet + j] = result[m].s[j];
}
