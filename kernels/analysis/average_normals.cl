// Normals averaged over the points within `reach`, 16 points at a time as lanes; positions are copied.
//
// Where the normals around a point agree as a whole (their mean is longer than COHERENT), all count: noise turns single
// normals over. Elsewhere two sheets meet, and those of the other hemisphere count nothing.
#include "common/lanes.clh"
#include "build/point_tree.clh"

#ifndef COHERENT
#define COHERENT 0.5f
#endif

__kernel void average_normals(int padded, __global const float *sorted, __global const float *boxes,
                              __global const int *node_offset, int top_level, float reach, __global float *out) {
  int b = get_global_id(0);
  size_t n16 = padded / 16;
  if (b >= n16) return;
  __global const float16 *own = (__global const float16 *)sorted + b;
  float16 x = own[0], y = own[n16], z = own[2 * n16], nx = own[3 * n16], ny = own[4 * n16], nz = own[5 * n16];
  float16 sx = 0.0f, sy = 0.0f, sz = 0.0f, ox = 0.0f, oy = 0.0f, oz = 0.0f, weight = 0.0f;
  float low[3], high[3];
  for (int a = 0; a < 3; ++a) {
    __global const float *p = sorted + (size_t)a * padded + 16 * (size_t)b;
    low[a] = high[a] = p[0];
    for (int j = 1; j < 16; ++j) {
      float q = sorted[16 * (size_t)b + j] < 1e5f ? p[j] : p[0]; // what pads the last block stays out
      low[a] = q < low[a] ? q : low[a];
      high[a] = q > high[a] ? q : high[a];
    }
  }
  float mx = 0.5f * (low[0] + high[0]), my = 0.5f * (low[1] + high[1]), mz = 0.5f * (low[2] + high[2]);
  float ex = high[0] - mx, ey = high[1] - my, ez = high[2] - mz;
  float far = sqrt(ex * ex + ey * ey + ez * ez) * 1.0001f + reach, inverse = 1.0f / (reach * reach);
  uint list[BLOCK_LIST];
  Traversal t;
  int blocks;
  traversal_start(&t, top_level);
  while ((blocks = traversal_next(&t, boxes, node_offset, mx, my, mz, far * far, list)) > 0)
    for (int k = 0; k < blocks; ++k)
      for (size_t j = 16 * (size_t)list[k]; j < 16 * (size_t)list[k] + 16; ++j) {
        __global const float *p = sorted + j;
        float16 dx = p[0] - x, dy = p[padded] - y, dz = p[2 * (size_t)padded] - z;
        float px = p[3 * (size_t)padded], py = p[4 * (size_t)padded], pz = p[5 * (size_t)padded];
        float16 g = 1.0f - (dx * dx + dy * dy + dz * dz) * inverse;
        g = SEL((float16)0.0f, g, g > 0.0f);
        weight += g;
        float16 own_side = SEL((float16)0.0f, g, nx * px + ny * py + nz * pz > 0.0f);
        g -= own_side;
        sx += own_side * px;
        sy += own_side * py;
        sz += own_side * pz;
        ox += g * px;
        oy += g * py;
        oz += g * pz;
      }
  float16 ax = sx + ox, ay = sy + oy, az = sz + oz, least = COHERENT * weight;
  int16 agree = ax * ax + ay * ay + az * az > least * least;
  sx = SEL(sx, ax, agree);
  sy = SEL(sy, ay, agree);
  sz = SEL(sz, az, agree);
  float16 length2 = sx * sx + sy * sy + sz * sz;
  int16 good = length2 > 1e-12f;
  float16 k = 1.0f / VSQRT(SEL((float16)1.0f, length2, good));
  __global float16 *o = (__global float16 *)out + b;
  o[0] = x;
  o[n16] = y;
  o[2 * n16] = z;
  o[3 * n16] = SEL(nx, sx * k, good);
  o[4 * n16] = SEL(ny, sy * k, good);
  o[5 * n16] = SEL(nz, sz * k, good);
}
