// What new surfels do to the points: a leaf adds its weight G(d / R), R = ALPHA r, to the overlap of the points it
// represents; an internal surfel marks the points of its ball as held at this level.
//
// Overlap is fixed point (2^20 is 1, rounded down), because integer sums do not depend on the order of atomics.
#include "common/lanes.clh"
#include "build/point_tree.clh"

#ifndef ALPHA
#define ALPHA (2.0f / 3.0f)
#endif
#ifndef COVER_COSINE
#define COVER_COSINE 0.2f // a leaf represents points whose normals are within about 78 degrees of its own
#endif
#define ONE 1048576.0f
#define RECORD 16 // see fit_surfels.cl

__kernel void cover_points(int count, __global const int *center, __global const float *record,
                           int padded,
                           __global const float *sorted, __global const float *boxes, __global const int *node_offset,
                           int top_level, __global uint *overlap, __global uchar *held) {
  int s = get_global_id(0);
  if (s >= count) return;
  size_t n = padded;
  __global const float *px = sorted, *py = sorted + n, *pz = sorted + 2 * n;
  __global const float *nx = sorted + 3 * n, *ny = sorted + 4 * n, *nz = sorted + 5 * n;
  __global const float *surfel = record + RECORD * (size_t)s;
  int c = center[s], is_leaf = surfel[5] > 0.0f;
  float x = px[c], y = py[c], z = pz[c], r = is_leaf ? ALPHA * surfel[0] : surfel[0];
  float ux = surfel[1], uy = surfel[2], uz = surfel[3];
  float r2 = r * r, inverse = 1.0f / r2;
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, x, y, z, r2, list)) > 0)
    for (int b = 0; b < blocks; ++b) {
      size_t block = list[b];
      float16 dx = ((__global const float16 *)px)[block] - x, dy = ((__global const float16 *)py)[block] - y,
              dz = ((__global const float16 *)pz)[block] - z;
      float16 d2 = dx * dx + dy * dy + dz * dz;
      if (is_leaf) {
        float16 g = 1.0f - d2 * inverse;
        float16 cosine = ((__global const float16 *)nx)[block] * ux + ((__global const float16 *)ny)[block] * uy +
                         ((__global const float16 *)nz)[block] * uz;
        g = SEL(g, (float16)0.0f, (g < 0.0f) | (cosine < COVER_COSINE));
        union { int16 v; int s[16]; } add;
        add.v = TO_VI(g * g * g * ONE);
        for (int j = 0; j < 16; ++j)
          if (add.s[j]) atomic_add(overlap + 16 * block + j, (uint)add.s[j]);
      } else {
        union { int16 v; int s[16]; } hit;
        hit.v = d2 < r2;
        for (int j = 0; j < 16; ++j)
          if (hit.s[j]) held[16 * block + j] = 1;
      }
    }
  // A centre is always represented by its own leaf, whatever its normal.
  if (is_leaf) atomic_add(overlap + c, (uint)ONE);
}
