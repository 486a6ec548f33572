// Curvature of blended local surfaces at points, 16 neighbouring points at a time as lanes.
//
// First STEPS Newton steps onto the blend, f = sum G f_i / sum G, along its gradient; then gradient g and Hessian M as the
// same means of the local surfaces' own derivatives: the left side of equation 8 of paper 003. The curvature is that of the
// form M / |g| on the plane across g.
#include "common/frame.clh"
#include "common/lanes.clh"
#include "build/point_tree.clh"

#ifndef DEGREE
#define DEGREE 4
#endif
#ifndef SURFEL
#define SURFEL 32 // floats a surfel: centre, radius, normal, u, v, coefficients from 13
#endif
#ifndef RADIUS_UNITS
#define RADIUS_UNITS 1 // 1: coefficients are over the surfel's radius, 0: over the tree's unit
#endif
#ifndef STEPS
#define STEPS 1
#endif
#define OUT 16 // floats a point: position, normal, mean, Gaussian, k1, k2, direction1, direction2

typedef struct {
  VF x, y, z;
} Vectors;

typedef struct {
  VF weight, f, gx, gy, gz, xx, yy, zz, xy, xz, yz, radius;
} Blend;

inline float highest(VF a) {
  union { VF v; float s[16]; } lanes;
  lanes.v = a;
  float m = lanes.s[0];
  for (int j = 1; j < 16; ++j) m = lanes.s[j] > m ? lanes.s[j] : m;
  return m;
}

// Height and its derivatives, in the coefficients' units.
INLINE void heights(__global const float *k, VF u, VF v, VF *h, VF *hu, VF *hv, VF *huu, VF *huv, VF *hvv) {
  *h = k[0], *hu = 0.0f, *hv = 0.0f, *huu = 0.0f, *huv = 0.0f, *hvv = 0.0f;
#if DEGREE >= 2
  *h += u * (k[1] + k[3] * u + k[4] * v) + v * (k[2] + k[5] * v);
  *hu += k[1] + 2.0f * k[3] * u + k[4] * v;
  *hv += k[2] + 2.0f * k[5] * v + k[4] * u;
  *huu += 2.0f * k[3];
  *huv += k[4];
  *hvv += 2.0f * k[5];
#endif
#if DEGREE >= 3
  VF uu = u * u, vv = v * v, uv = u * v;
  *h += uu * (k[6] * u + k[7] * v) + vv * (k[8] * u + k[9] * v);
  *hu += 3.0f * k[6] * uu + 2.0f * k[7] * uv + k[8] * vv;
  *hv += 3.0f * k[9] * vv + 2.0f * k[8] * uv + k[7] * uu;
  *huu += 6.0f * k[6] * u + 2.0f * k[7] * v;
  *huv += 2.0f * (k[7] * u + k[8] * v);
  *hvv += 6.0f * k[9] * v + 2.0f * k[8] * u;
#endif
#if DEGREE >= 4
  *h += uu * (k[10] * uu + k[11] * uv + k[12] * vv) + vv * (k[13] * uv + k[14] * vv);
  *hu += uu * (4.0f * k[10] * u + 3.0f * k[11] * v) + vv * (2.0f * k[12] * u + k[13] * v);
  *hv += vv * (4.0f * k[14] * v + 3.0f * k[13] * u) + uu * (2.0f * k[12] * v + k[11] * u);
  *huu += 12.0f * k[10] * uu + 6.0f * k[11] * uv + 2.0f * k[12] * vv;
  *huv += 3.0f * (k[11] * uu + k[13] * vv) + 4.0f * k[12] * uv;
  *hvv += 12.0f * k[14] * vv + 6.0f * k[13] * uv + 2.0f * k[12] * uu;
#endif
}

// Sums of G and of G times f, its gradient and its Hessian over the surfels around q, as far as they face `n`.
inline Blend blend_at(Vectors q, Vectors n, __global const float *surfels, size_t padded, __global const float *balls,
                      __global const float *boxes, __global const int *node_offset, int top_level) {
  float mx = 0.5f * (highest(q.x) - highest(-q.x)), my = 0.5f * (highest(q.y) - highest(-q.y)),
        mz = 0.5f * (highest(q.z) - highest(-q.z));
  VF ex = q.x - mx, ey = q.y - my, ez = q.z - mz;
  float extent = sqrt(highest(ex * ex + ey * ey + ez * ez)) * 1.00001f + 1e-7f;
  Blend s = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, mx, my, mz, extent * extent, list)) > 0)
    for (int b = 0; b < blocks; ++b) {
      size_t block = list[b];
      VF bx = ((__global const VF *)balls)[block] - mx, by = ((__global const VF *)(balls + padded))[block] - my,
         bz = ((__global const VF *)(balls + 2 * padded))[block] - mz, br = ((__global const VF *)(balls + 3 * padded))[block];
      union { VI v; int s[16]; } near;
      near.v = (bx * bx + by * by + bz * bz <= (br + extent) * (br + extent)) & (br > 0.0f);
      for (int j = 0; j < 16; ++j) {
        if (!near.s[j]) continue;
        __global const float *o = surfels + SURFEL * (16 * block + j);
        float inverse = 1.0f / o[3], unit = RADIUS_UNITS ? inverse : 1.0f, back = RADIUS_UNITS ? o[3] : 1.0f;
        VF dx = q.x - o[0], dy = q.y - o[1], dz = q.z - o[2];
        VF g = 1.0f - (dx * dx + dy * dy + dz * dz) * (inverse * inverse);
        VF cosine = n.x * o[4] + n.y * o[5] + n.z * o[6];
        g = SEL((VF)0.0f, g * g * g * cosine * cosine, (g > 0.0f) & (cosine > 0.0f)); // gradually: no jumps at creases
        VF u = (o[7] * dx + o[8] * dy + o[9] * dz) * unit, v = (o[10] * dx + o[11] * dy + o[12] * dz) * unit;
        VF h, hu, hv, huu, huv, hvv;
        heights(o + 13, u, v, &h, &hu, &hv, &huu, &huv, &hvv);
        s.weight += g;
        s.radius += g * o[3];
        s.f += g * (o[4] * dx + o[5] * dy + o[6] * dz - h * back);
        s.gx += g * (o[4] - hu * o[7] - hv * o[10]);
        s.gy += g * (o[5] - hu * o[8] - hv * o[11]);
        s.gz += g * (o[6] - hu * o[9] - hv * o[12]);
        VF gh = g * -unit;
        VF ax = gh * (huu * o[7] + huv * o[10]), bx = gh * (huv * o[7] + hvv * o[10]);
        VF ay = gh * (huu * o[8] + huv * o[11]), by = gh * (huv * o[8] + hvv * o[11]);
        VF az = gh * (huu * o[9] + huv * o[12]), bz = gh * (huv * o[9] + hvv * o[12]);
        s.xx += ax * o[7] + bx * o[10];
        s.yy += ay * o[8] + by * o[11];
        s.zz += az * o[9] + bz * o[12];
        s.xy += ax * o[8] + bx * o[11];
        s.xz += ax * o[9] + bx * o[12];
        s.yz += ay * o[9] + by * o[12];
      }
    }
  return s;
}

// Frames of the normals n in lanes (common/frame.clh).
inline void frames_of(Vectors n, Vectors *u, Vectors *v) {
  VF s = SEL((VF)1.0f, (VF)-1.0f, n.z < 0.0f), a = -1.0f / (s + n.z), b = n.x * n.y * a;
  u->x = 1.0f + s * n.x * n.x * a, u->y = s * b, u->z = -s * n.x;
  v->x = b, v->y = s + n.y * n.y * a, v->z = -n.y;
}

inline VF form(Blend s, Vectors a, Vectors b) {
  return a.x * (s.xx * b.x + s.xy * b.y + s.xz * b.z) + a.y * (s.xy * b.x + s.yy * b.y + s.yz * b.z) +
         a.z * (s.xz * b.x + s.yz * b.y + s.zz * b.z);
}

// queries: (6, stride), positions and the normals they belong to. `count` of them, from the packet `first_packet` on, are
// written to the rows `order` of out; NaN where no surfel reaches.
__kernel void point_curvature(int count, int first_packet, int stride, __global const float *queries,
                              __global const int *order, __global const float *surfels, int padded,
                              __global const float *balls, __global const float *boxes,
                              __global const int *node_offset, int top_level, __global float *out) {
  int packet = get_global_id(0);
  if (16 * packet >= count) return;
  size_t n16 = stride / 16, asked = first_packet + packet, first = 16 * asked;
  VI spare = LANE_INDEX >= (VI)(count - 16 * packet); // the last packet's empty lanes repeat its first query
  VF own[6];
  for (int k = 0; k < 6; ++k)
    own[k] = SEL(((__global const VF *)queries)[k * n16 + asked], (VF)queries[k * (size_t)stride + first], spare);
  Vectors q = {own[0], own[1], own[2]}, n = {own[3], own[4], own[5]};
  Blend s;
  for (int step = 0; step <= STEPS; ++step) {
    s = blend_at(q, n, surfels, padded, balls, boxes, node_offset, top_level);
    if (step == STEPS) break;
    VF length2 = s.gx * s.gx + s.gy * s.gy + s.gz * s.gz;
    VI known = length2 > 1e-12f * s.weight * s.weight;
    VF k = SEL((VF)0.0f, 1.0f / (length2 + 1e-30f), known), down = s.f * k, most = s.radius / (s.weight + 1e-30f);
    VF far2 = down * down * length2;
    down = SEL(down, down * most / VSQRT(far2 + 1e-30f), far2 > most * most);
    VF turn = VSQRT(k);
    n.x = SEL(n.x, s.gx * turn, known);
    n.y = SEL(n.y, s.gy * turn, known);
    n.z = SEL(n.z, s.gz * turn, known);
    q.x -= down * s.gx;
    q.y -= down * s.gy;
    q.z -= down * s.gz;
  }
  VF length = VSQRT(s.gx * s.gx + s.gy * s.gy + s.gz * s.gz), k = 1.0f / length;
  Vectors m = {s.gx * k, s.gy * k, s.gz * k}, u, v;
  frames_of(m, &u, &v);
  VF a = form(s, u, u) * k, b = form(s, u, v) * k, c = form(s, v, v) * k;
  VF mean = 0.5f * (a + c), tilt = 0.5f * (a - c), apart = VSQRT(tilt * tilt + b * b);
  // The eigenvector of k1 in its form without cancellation.
  VI wide = tilt > 0.0f;
  VF du = SEL(b, tilt + apart, wide), dv = SEL(apart - tilt, b, wide), d2 = du * du + dv * dv;
  VI umbilic = NOT(d2 > 1e-30f);
  VF scale = 1.0f / VSQRT(SEL(d2, (VF)1.0f, umbilic));
  du = SEL(du * scale, (VF)1.0f, umbilic);
  dv = SEL(dv * scale, (VF)0.0f, umbilic);
  VF values[OUT] = {q.x, q.y, q.z, m.x, m.y, m.z, mean, a * c - b * b, mean + apart, mean - apart,
                    du * u.x + dv * v.x, du * u.y + dv * v.y, du * u.z + dv * v.z,
                    du * v.x - dv * u.x, du * v.y - dv * u.y, du * v.z - dv * u.z};
  VI known = (s.weight > 1e-9f) & (length > 1e-6f * s.weight);
  int here = count - 16 * packet < 16 ? count - 16 * packet : 16;
  for (int i = 0; i < OUT; ++i) values[i] = SEL((VF)NAN, values[i], known);
  for (int j = 0; j < here; ++j) {
    __global float *o = out + OUT * (size_t)order[16 * (size_t)packet + j];
    for (int i = 0; i < OUT; ++i) o[i] = ((float *)&values[i])[j];
  }
}
