// The paper's buffer of normals (section 3): a table of 512 KB that patches of equal axis ratios share. One work-item per
// run of patches, with a table of its own that is emptied whenever the group of ratios changes (PRECOMPUTED: one table for
// all, filled beforehand). The normals are handed on as slopes, displacement steps per node, which the tile stages read.
// Twins: clsurf.render.normal_table.normal_statistics counts, tests/reference/render_patch_modes.py, table_normals.
#include "common/patch.clh"

#ifndef PRECOMPUTED
#define PRECOMPUTED 0
#endif
#define SIDE 256        // entries each way: |h_x|, |h_y| in half steps per node
#define UNIT 32767.0f   // of an entry's components
#define LAST_RUN 65535  // an entry knows the run that it was made in by 16 bits

__kernel void table_normals(__global const int4 *rectangles, __global const int *sizes, __global const uint *offsets,
                            int count, __global const int *order, __global const int *groups,
                            __global const float2 *ratios, int chunk, __global const height_t *heights,
                            __global const uchar *colors, __global const uint4 *nodes, __global ushort4 *tables,
                            __global uint4 *found, __global uint2 *counts /* normals wanted, computed */) {
  int part = get_global_id(0), begin = part * chunk, end = begin + chunk < count ? begin + chunk : count;
  if (begin >= count) return;
  __global ushort4 *table = tables + (PRECOMPUTED ? 0 : (size_t)part * SIDE * SIDE);
  int now = -1;
  uint run = PRECOMPUTED, wanted = 0, computed = 0;
  for (int q = begin; q < end; q++) {
    int k = order[q];
    if (rectangles[k].x > rectangles[k].z) continue;
    if (!PRECOMPUTED && groups[k] != now) {
      if (++run > LAST_RUN) {
        for (int i = 0; i < SIDE * SIDE; i++) table[i] = (ushort4)(0);
        run = 1;
      }
      now = groups[k];
    }
    float2 r = ratios[groups[k]];
    uint first = offsets[k], last = first + (uint)sizes[2 * k] * sizes[2 * k + 1];
    for (uint at = first; at < last; at++) {
      uint4 node = nodes[at];
      found[at] = node;
      if (!opaque(colors, heights, at)) continue;
      wanted++;
      int gx = as_int(node.w << 16) >> 16, gy = as_int(node.w) >> 16, hx = abs(gx), hy = abs(gy);  // half steps
      if (hx >= SIDE || hy >= SIDE) { computed++; continue; }
      int entry = hx * SIDE + hy;
      ushort4 n = table[entry];
      if (n.w != (ushort)run) {
        float x = 0.5f * hx * r.x, y = 0.5f * hy * r.y, unit = UNIT / sqrt(1.0f + x * x + y * y);
        n = (ushort4)((ushort)(x * unit + 0.5f), (ushort)(y * unit + 0.5f), (ushort)(unit + 0.5f), (ushort)run);
        table[entry] = n;
        computed++;
      }
      float z = n.z > 0 ? n.z : 0.5f;
      int x = (int)(2.0f * n.x / (z * r.x) + 0.5f), y = (int)(2.0f * n.y / (z * r.y) + 0.5f);
      found[at].w = ((uint)(gx < 0 ? -x : x) & 0xffffu) | (uint)(gy < 0 ? -y : y) << 16;
    }
  }
  counts[part] = (uint2)(wanted, computed);
}
