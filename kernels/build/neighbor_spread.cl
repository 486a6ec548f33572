// Smallest eigenvalue of the covariance of a point and its NEIGHBORS nearest neighbours; one work-item per block of 16
// points, one query per lane, exact; and the squared distance of the furthest of them. The mean eigenvalue over many
// points is the lambda of paper 003, equation 3.
#include "common/lanes.clh"
#include "build/point_tree.clh"

#ifndef NEIGHBORS
#define NEIGHBORS 10
#endif

// Blocks near the box of the lanes' queries: `list`, at most BLOCK_LIST at a time.
#define BROADCAST_BLOCKS(body)                                                                                  \
  traversal_start(&t, top_level);                                                                               \
  while ((blocks = traversal_next(&t, boxes, node_offset, mid_x, mid_y, mid_z, reach * reach, list)) > 0)       \
    for (int b = 0; b < blocks; ++b)                                                                            \
      for (size_t j = 16 * (size_t)list[b]; j < 16 * (size_t)list[b] + 16; ++j) {                               \
        VF dx = px[j] - x, dy = py[j] - y, dz = pz[j] - z, d2 = dx * dx + dy * dy + dz * dz;                    \
        body                                                                                                    \
      }

// Smallest eigenvalue of a symmetric 3x3 matrix by the closed form, of its trace-free part scaled to unit size.
inline float smallest_eigenvalue(float xx, float yy, float zz, float xy, float xz, float yz) {
  float mean = (xx + yy + zz) / 3.0f;
  float a = xx - mean, b = yy - mean, c = zz - mean;
  float p2 = (a * a + b * b + c * c + 2.0f * (xy * xy + xz * xz + yz * yz)) / 6.0f;
  if (!(p2 > 1e-30f)) return mean;
  float p = sqrt(p2), k = 1.0f / p;
  a *= k, b *= k, c *= k, xy *= k, xz *= k, yz *= k;
  float half_det = 0.5f * (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz));
  half_det = half_det < -1.0f ? -1.0f : half_det > 1.0f ? 1.0f : half_det;
  float smallest = mean + 2.0f * p * cos(acos(half_det) / 3.0f + 2.0943951024f);
  return smallest > 0.0f ? smallest : 0.0f;
}

__kernel void neighbor_spread(int queries, __global const int *block, int padded, __global const float *sorted,
                              __global const float *boxes, __global const int *node_offset, int top_level,
                              float start_reach, __global float *spread, __global float *furthest2) {
  int q = get_global_id(0);
  if (q >= queries) return;
  __global const float *px = sorted, *py = sorted + padded, *pz = sorted + 2 * (size_t)padded;
  size_t own = block[q];
  VF x = ((__global const VF *)px)[own], y = ((__global const VF *)py)[own], z = ((__global const VF *)pz)[own];
  VI real = x < 1e5f; // lanes that pad the last block stay out
  float low[3], high[3];
  for (int a = 0; a < 3; ++a) {
    __global const float *p = sorted + (size_t)a * padded + 16 * own;
    low[a] = high[a] = p[0];
    for (int j = 1; j < 16; ++j)
      if (px[16 * own + j] < 1e5f) {
        low[a] = p[j] < low[a] ? p[j] : low[a];
        high[a] = p[j] > high[a] ? p[j] : high[a];
      }
  }
  float mid_x = 0.5f * (low[0] + high[0]), mid_y = 0.5f * (low[1] + high[1]), mid_z = 0.5f * (low[2] + high[2]);
  float ex = high[0] - mid_x, ey = high[1] - mid_y, ez = high[2] - mid_z;
  float extent = sqrt(ex * ex + ey * ey + ez * ez);
  uint list[BLOCK_LIST];
  Traversal t;
  int blocks;
  VF best[NEIGHBORS + 1]; // squared distances, ascending; the point itself is one of them
  float margin = start_reach, reach;
  for (int round = 0; round < 64; ++round) {
    for (int k = 0; k <= NEIGHBORS; ++k) best[k] = 1e30f;
    reach = extent + margin;
    BROADCAST_BLOCKS(VF d = d2; for (int k = 0; k <= NEIGHBORS; ++k) {
      VF near = VMIN(d, best[k]);
      d = VMAX(d, best[k]);
      best[k] = near;
    })
    union { VF v; float s[16]; } far;
    far.v = SEL((VF)0.0f, best[NEIGHBORS], real);
    float worst = 0.0f;
    for (int j = 0; j < 16; ++j) worst = far.s[j] > worst ? far.s[j] : worst;
    if (worst <= margin * margin || margin > 4.0f) break; // every lane's ball lies inside what was searched
    margin = worst < 1e9f ? sqrt(worst) * 1.0001f : 2.0f * margin;
  }
  VF n = 0.0f, sx = 0.0f, sy = 0.0f, sz = 0.0f, xx = 0.0f, yy = 0.0f, zz = 0.0f, xy = 0.0f, xz = 0.0f, yz = 0.0f;
  ((__global VF *)furthest2)[q] = best[NEIGHBORS];
  VF kth = best[NEIGHBORS] * 1.00001f;
  BROADCAST_BLOCKS(VF in = SEL((VF)0.0f, (VF)1.0f, d2 <= kth); n += in; dx *= in; dy *= in; dz *= in; sx += dx; sy += dy;
                   sz += dz; xx += dx * dx; yy += dy * dy; zz += dz * dz; xy += dx * dy; xz += dx * dz; yz += dy * dz;)
  VF k = 1.0f / (n + 1e-30f);
  sx *= k, sy *= k, sz *= k;
  union { VF v; float s[16]; } cxx, cyy, czz, cxy, cxz, cyz;
  cxx.v = xx * k - sx * sx, cyy.v = yy * k - sy * sy, czz.v = zz * k - sz * sz;
  cxy.v = xy * k - sx * sy, cxz.v = xz * k - sx * sz, cyz.v = yz * k - sy * sz;
  union { VI v; int s[16]; } is_real;
  is_real.v = real;
  for (int j = 0; j < 16; ++j)
    spread[16 * (size_t)q + j] =
        is_real.s[j] ? smallest_eigenvalue(cxx.s[j], cyy.s[j], czz.s[j], cxy.s[j], cxz.s[j], cyz.s[j]) : -1.0f;
}
