// Distance from 16 queries at a time, one per lane, to the nearest of a mesh's triangles, and its number.
//
// Triangles stand behind their balls (centroid and furthest corner) in blocks of 16 under the tree of point_tree.clh.
// The reach grows until the nearest triangle of every lane lies inside what was searched.
#include "common/lanes.clh"
#include "build/point_tree.clh"
#include "build/packet.clh"

#define TRIANGLE 12 // floats a triangle: a corner, the two edges from it

// Squared distance from d, relative to the first corner, to the point v, w along the edges.
inline VF gap2(Vectors d, VF v, VF w, __global const float *t) {
  VF x = d.x - v * t[3] - w * t[6], y = d.y - v * t[4] - w * t[7], z = d.z - v * t[5] - w * t[8];
  return x * x + y * y + z * z;
}

inline VF clamped(VF s) {
  s = SEL(s, (VF)0.0f, s < 0.0f);
  return SEL(s, (VF)1.0f, s > 1.0f);
}

inline float inverse_of(float s) { return s > 1e-30f ? 1.0f / s : 0.0f; }

// The least of the distances to the three edges and, where the foot lies inside, to the plane.
inline VF triangle_gap2(__global const float *t, Vectors p) {
  Vectors d = {p.x - t[0], p.y - t[1], p.z - t[2]};
  float bb = t[3] * t[3] + t[4] * t[4] + t[5] * t[5], cc = t[6] * t[6] + t[7] * t[7] + t[8] * t[8],
        bc = t[3] * t[6] + t[4] * t[7] + t[5] * t[8];
  VF db = d.x * t[3] + d.y * t[4] + d.z * t[5], dc = d.x * t[6] + d.y * t[7] + d.z * t[8];
  VF best = gap2(d, clamped(db * inverse_of(bb)), (VF)0.0f, t);
  VF other = gap2(d, (VF)0.0f, clamped(dc * inverse_of(cc)), t);
  best = SEL(best, other, other < best);
  VF s = clamped((dc - db + bb - bc) * inverse_of(bb + cc - 2.0f * bc));
  other = gap2(d, 1.0f - s, s, t);
  best = SEL(best, other, other < best);
  float determinant = bb * cc - bc * bc, inverse = determinant > 1e-6f * bb * cc ? 1.0f / determinant : 0.0f;
  VF v = (cc * db - bc * dc) * inverse, w = (bb * dc - bc * db) * inverse;
  other = gap2(d, v, w, t);
  return SEL(best, other, (other < best) & (v >= 0.0f) & (w >= 0.0f) & (v + w <= 1.0f));
}

__kernel void triangle_distances(int count, int query_stride, __global const float *queries,
                                 __global const float *triangles, int padded, __global const float *balls,
                                 __global const float *boxes, __global const int *node_offset, int top_level,
                                 float margin, __global float *out, __global int *nearest) {
  int packet = get_global_id(0);
  if (16 * packet >= count) return;
  size_t stride = query_stride, first = 16 * (size_t)packet;
  VI spare = LANE_INDEX >= (VI)(count - 16 * packet); // the last packet's empty lanes repeat its first query
  Vectors p;
  p.x = SEL(((__global const VF *)queries)[packet], (VF)queries[first], spare);
  p.y = SEL(((__global const VF *)(queries + stride))[packet], (VF)queries[stride + first], spare);
  p.z = SEL(((__global const VF *)(queries + 2 * stride))[packet], (VF)queries[2 * stride + first], spare);
  Sphere s = sphere_around(p);
  uint list[BLOCK_LIST];
  Traversal t;
  VF best = 1e30f;
  VI found = 0;
  for (int round = 0; round < 200; ++round) {
    float reach = s.extent + margin;
    best = 1e30f;
    found = 0;
    traversal_start(&t, top_level);
    int blocks;
    while ((blocks = traversal_next(&t, boxes, node_offset, s.x, s.y, s.z, reach * reach, list)) > 0)
      for (int b = 0; b < blocks; ++b) {
        union { int16 v; int s[16]; } near;
        near.v = near_balls(balls, padded, list[b], s, reach);
        for (int j = 0; j < 16; ++j) {
          if (!near.s[j]) continue;
          VF d2 = triangle_gap2(triangles + TRIANGLE * (16 * (size_t)list[b] + j), p);
          found = SEL(found, (VI)((int)(16 * list[b] + j)), d2 < best);
          best = SEL(best, d2, d2 < best);
        }
      }
    float worst = highest(best);
    if (worst <= margin * margin) break;
    margin = worst < 1e29f ? sqrt(worst) * 1.0001f + 1e-9f : 2.0f * margin;
  }
  ((__global VF *)out)[packet] = VSQRT(best);
  ((__global VI *)nearest)[packet] = found;
}
