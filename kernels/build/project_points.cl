// Nearest point of a blended SLIM surface for 16 queries at a time, one query per lane.
//
// First the leaf whose alpha-trimmed patch comes nearest (reach grown until that is certain), then ROUNDS steps onto the
// blend of the leaves that face its way: along the blended gradient by f / |grad f| (paper 003, equations 6 and 7,
// averaged at a point instead of along a ray), and along the tangent plane towards the query.
#include "common/lanes.clh"
#include "build/point_tree.clh"
#include "build/packet.clh"
#include "build/polynomial_fit.clh"

#ifndef ALPHA
#define ALPHA (2.0f / 3.0f)
#endif
#ifndef ROUNDS
#define ROUNDS 5
#endif
#define LEAF 24 // floats a leaf: centre, radius, normal, u, v, coefficients from 13

inline VF height_of(__global const float *k, VF u, VF v) {
  VF h = k[0];
#if DEGREE >= 2
  h += k[1] * u + k[2] * v + u * (k[3] * u + k[4] * v) + k[5] * v * v;
#endif
#if DEGREE >= 3
  h += u * u * (k[6] * u + k[7] * v) + v * v * (k[8] * u + k[9] * v);
#endif
  return h;
}

// Foot of p on a leaf's patch, trimmed to a disc of ALPHA r, in the leaf's frame; returns the squared distance.
inline VF foot_on_leaf(__global const float *leaf, Vectors p, VF *foot_u, VF *foot_v, VF *foot_w) {
  VF dx = p.x - leaf[0], dy = p.y - leaf[1], dz = p.z - leaf[2];
  float r = leaf[3], rim = ALPHA * r;
  VF u = leaf[7] * dx + leaf[8] * dy + leaf[9] * dz, v = leaf[10] * dx + leaf[11] * dy + leaf[12] * dz,
     w = leaf[4] * dx + leaf[5] * dy + leaf[6] * dz;
  VF rho2 = u * u + v * v;
  VF k = SEL((VF)1.0f, rim / VSQRT(rho2 + 1e-30f), rho2 > rim * rim);
  VF a = u * k, b = v * k, h = height_of(leaf + 13, a, b);
  h = SEL(h, (VF)r, h > r);
  h = SEL(h, (VF)-r, h < -r);
  *foot_u = a, *foot_v = b, *foot_w = h;
  return (u - a) * (u - a) + (v - b) * (v - b) + (w - h) * (w - h);
}

// The leaf nearest to each query.
inline VI nearest_leaves(Vectors p, __global const float *leaves, size_t padded, __global const float *balls,
                         __global const float *boxes, __global const int *node_offset, int top_level, float margin) {
  Sphere s = sphere_around(p);
  uint list[BLOCK_LIST];
  Traversal t;
  VI nearest = 0;
  for (int round = 0; round < 200; ++round) {
    VF best = 1e30f, u, v, w;
    float reach = s.extent + margin;
    traversal_start(&t, top_level);
    int blocks;
    while ((blocks = traversal_next(&t, boxes, node_offset, s.x, s.y, s.z, reach * reach, list)) > 0)
      for (int b = 0; b < blocks; ++b) {
        union { int16 v; int s[16]; } near;
        near.v = near_balls(balls, padded, list[b], s, reach);
        for (int j = 0; j < 16; ++j) {
          if (!near.s[j]) continue;
          int i = 16 * list[b] + j;
          VF d2 = foot_on_leaf(leaves + LEAF * (size_t)i, p, &u, &v, &w);
          VI better = d2 < best;
          best = SEL(best, d2, better);
          nearest = SEL(nearest, (VI)i, better);
        }
      }
    float worst = highest(best);
    if (worst <= margin * margin) break; // every nearer patch lies inside what was searched
    margin = worst < 1e29f ? sqrt(worst) * 1.0001f : 2.0f * margin;
  }
  return nearest;
}

// Feet of the queries on their nearest leaves, and those leaves' normals and radii.
inline void start_on_leaves(Vectors p, VI nearest, __global const float *leaves, Vectors *q, Vectors *facing, VF *radius) {
  union { VI v; int s[16]; } index;
  union { VF v; float s[16]; } x, y, z, nx, ny, nz, r;
  index.v = nearest;
  for (int j = 0; j < 16; ++j) {
    __global const float *leaf = leaves + LEAF * (size_t)index.s[j];
    VF u, v, w;
    foot_on_leaf(leaf, p, &u, &v, &w);
    float a = ((float *)&u)[j], b = ((float *)&v)[j], h = ((float *)&w)[j];
    x.s[j] = leaf[0] + a * leaf[7] + b * leaf[10] + h * leaf[4];
    y.s[j] = leaf[1] + a * leaf[8] + b * leaf[11] + h * leaf[5];
    z.s[j] = leaf[2] + a * leaf[9] + b * leaf[12] + h * leaf[6];
    nx.s[j] = leaf[4], ny.s[j] = leaf[5], nz.s[j] = leaf[6];
    r.s[j] = leaf[3];
  }
  q->x = x.v, q->y = y.v, q->z = z.v;
  facing->x = nx.v, facing->y = ny.v, facing->z = nz.v;
  *radius = r.v;
}

// Sums of G, G f and G grad f over the leaves around q that face `facing`.
inline void blend_at(Vectors q, Vectors facing, __global const float *leaves, size_t padded, __global const float *balls,
                     __global const float *boxes, __global const int *node_offset, int top_level, VF *sum_g, VF *sum_f,
                     Vectors *sum_n) {
  Sphere s = sphere_around(q);
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  VF total = 0.0f, f = 0.0f, gx = 0.0f, gy = 0.0f, gz = 0.0f;
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, s.x, s.y, s.z, s.extent * s.extent, list)) > 0)
    for (int b = 0; b < blocks; ++b) {
      union { int16 v; int s[16]; } near;
      near.v = near_balls(balls, padded, list[b], s, s.extent);
      for (int j = 0; j < 16; ++j) {
        if (!near.s[j]) continue;
        __global const float *leaf = leaves + LEAF * (size_t)(16 * list[b] + j), *k = leaf + 13;
        VF dx = q.x - leaf[0], dy = q.y - leaf[1], dz = q.z - leaf[2];
        VF g = 1.0f - (dx * dx + dy * dy + dz * dz) * (1.0f / (leaf[3] * leaf[3]));
        VF cosine = facing.x * leaf[4] + facing.y * leaf[5] + facing.z * leaf[6];
        g = SEL(g, (VF)0.0f, (g < 0.0f) | (cosine <= 0.0f));
        g = g * g * g;
        VF u = leaf[7] * dx + leaf[8] * dy + leaf[9] * dz, v = leaf[10] * dx + leaf[11] * dy + leaf[12] * dz,
           w = leaf[4] * dx + leaf[5] * dy + leaf[6] * dz;
        VF hu = 0.0f, hv = 0.0f;
#if DEGREE >= 2
        hu += k[1] + 2.0f * k[3] * u + k[4] * v;
        hv += k[2] + 2.0f * k[5] * v + k[4] * u;
#endif
#if DEGREE >= 3
        hu += 3.0f * k[6] * u * u + 2.0f * k[7] * u * v + k[8] * v * v;
        hv += k[7] * u * u + 2.0f * k[8] * u * v + 3.0f * k[9] * v * v;
#endif
        total += g;
        f += g * (w - height_of(k, u, v));
        gx += g * (leaf[4] - hu * leaf[7] - hv * leaf[10]);
        gy += g * (leaf[5] - hu * leaf[8] - hv * leaf[11]);
        gz += g * (leaf[6] - hu * leaf[9] - hv * leaf[12]);
      }
    }
  *sum_g = total;
  *sum_f = f;
  sum_n->x = gx, sum_n->y = gy, sum_n->z = gz;
}

__kernel void project_points(int count, int query_stride, __global const float *queries, __global const float *leaves,
                             int padded, __global const float *balls, __global const float *boxes,
                             __global const int *node_offset, int top_level, float margin, __global float *out) {
  int packet = get_global_id(0);
  if (16 * packet >= count) return;
  size_t stride = query_stride, first = 16 * (size_t)packet;
  VI spare = LANE_INDEX >= (VI)(count - 16 * packet); // the last packet's empty lanes repeat its first query
  Vectors p, q, facing, n, slope;
  p.x = SEL(((__global const VF *)queries)[packet], (VF)queries[first], spare);
  p.y = SEL(((__global const VF *)(queries + stride))[packet], (VF)queries[stride + first], spare);
  p.z = SEL(((__global const VF *)(queries + 2 * stride))[packet], (VF)queries[2 * stride + first], spare);
  VI nearest = nearest_leaves(p, leaves, padded, balls, boxes, node_offset, top_level, margin);
  VF radius, total, f;
  start_on_leaves(p, nearest, leaves, &q, &facing, &radius);
  n = facing;
  for (int round = 0; round < ROUNDS; ++round) {
    blend_at(q, facing, leaves, padded, balls, boxes, node_offset, top_level, &total, &f, &slope);
    VF length2 = slope.x * slope.x + slope.y * slope.y + slope.z * slope.z;
    VI supported = (total > 1e-9f) & (length2 > 1e-12f * total * total);
    VF k = 1.0f / VSQRT(SEL((VF)1.0f, length2, supported));
    n.x = SEL(n.x, slope.x * k, supported);
    n.y = SEL(n.y, slope.y * k, supported);
    n.z = SEL(n.z, slope.z * k, supported);
    VF down = SEL((VF)0.0f, f * k, supported);
    down = SEL(down, radius, down > radius);
    down = SEL(down, -radius, down < -radius);
    VF dx = p.x - q.x, dy = p.y - q.y, dz = p.z - q.z, along = dx * n.x + dy * n.y + dz * n.z;
    VF tx = dx - along * n.x, ty = dy - along * n.y, tz = dz - along * n.z;
    VF t2 = tx * tx + ty * ty + tz * tz, most = 0.25f * radius;
    VF slide = SEL((VF)1.0f, most / VSQRT(t2 + 1e-30f), t2 > most * most);
    slide = SEL((VF)0.0f, slide, supported & (VI)(round + 1 < ROUNDS ? -1 : 0)); // the last step only lands
    q.x += slide * tx - down * n.x;
    q.y += slide * ty - down * n.y;
    q.z += slide * tz - down * n.z;
  }
  VF dx = p.x - q.x, dy = p.y - q.y, dz = p.z - q.z;
  VF distance = VSQRT(dx * dx + dy * dy + dz * dz);
  VF result[7] = {q.x, q.y, q.z, n.x, n.y, n.z, SEL(distance, -distance, dx * n.x + dy * n.y + dz * n.z < 0.0f)};
  for (int k = 0; k < 7; ++k) ((__global VF *)(out + k * stride))[packet] = result[k];
}
