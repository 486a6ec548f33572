// Quadratic surfels fitted to points with normals: weights fall with the distance from the centre and with the angle
// between a point's normal and the centre's, so that a fit does not reach over an edge.
//
// A work-item makes VW surfels: for one after the other the points are its lanes, then all are solved at once, a surfel
// per lane. With the surfels as lanes throughout, four of five lanes waited: centres stand half a radius apart.
#define DEGREE 2
#include "analysis/guided.clh"
#include "build/polynomial_fit.clh"

// Effective points below which a surfel makes do with a plane, and with a constant.
#ifndef FEW_FOR_QUADRIC
#define FEW_FOR_QUADRIC 8.0f
#define FEW_FOR_PLANE 3.5f
#endif

inline float added_lanes(VF a) {
#if VW == 16
  float8 b = a.lo + a.hi;
  float4 c = b.lo + b.hi;
  return (c.x + c.z) + (c.y + c.w);
#else
  return a;
#endif
}

typedef struct {
  float x, y, z, radius;
  float3 normal;
} Center;

typedef struct {
  Lanes moment[MOMENTS], right[TERMS], squares, weights2; // a surfel per lane
} Sums;

// Sums over the points around one centre, for lane `lane` of `sums`.
inline void add_points(Sums *sums, int lane, Center c, float eighth_sharp, size_t padded, __global const float *sorted,
                       __global const float *boxes, __global const int *node_offset, int top_level) {
  float3 eu, ev, en = c.normal;
  frame_of_normal(en, &eu, &ev);
  float inverse = 1.0f / c.radius, inverse2 = inverse * inverse;
  VF m0 = 0.0f, m1 = 0.0f, m2 = 0.0f, m3 = 0.0f, m4 = 0.0f, m5 = 0.0f, m6 = 0.0f, m7 = 0.0f, m8 = 0.0f, m9 = 0.0f,
     m10 = 0.0f, m11 = 0.0f, m12 = 0.0f, m13 = 0.0f, m14 = 0.0f, r0 = 0.0f, r1 = 0.0f, r2 = 0.0f, r3 = 0.0f, r4 = 0.0f,
     r5 = 0.0f, squares = 0.0f, weights2 = 0.0f;
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, c.x, c.y, c.z, c.radius * c.radius, list)) > 0)
    for (int k = 0; k < blocks; ++k)
      for (int j = 0; j < 16; j += VW) {
        __global const VF *p = (__global const VF *)(sorted + 16 * (size_t)list[k] + j);
        size_t n = padded / VW;
        VF dx = p[0] - c.x, dy = p[n] - c.y, dz = p[2 * n] - c.z;
        VF turn = 1.0f - (en.x * p[3 * n] + en.y * p[4 * n] + en.z * p[5 * n]);
        VF g = guided_weight((dx * dx + dy * dy + dz * dz) * inverse2, turn, eighth_sharp) * p[6 * n];
        dx *= inverse, dy *= inverse, dz *= inverse;
        VF u = eu.x * dx + eu.y * dy + eu.z * dz, v = ev.x * dx + ev.y * dy + ev.z * dz;
        VF w = en.x * dx + en.y * dy + en.z * dz;
        VF uu = u * u, uv = u * v, vv = v * v, guu = g * uu, gvv = g * vv, guv = g * uv, gw = g * w;
        m0 += g, m1 += g * u, m2 += g * v, m3 += guu, m4 += guv, m5 += gvv;
        m6 += guu * u, m7 += guu * v, m8 += gvv * u, m9 += gvv * v;
        m10 += guu * uu, m11 += guu * uv, m12 += guu * vv, m13 += guv * vv, m14 += gvv * vv;
        r0 += gw, r1 += gw * u, r2 += gw * v, r3 += gw * uu, r4 += gw * uv, r5 += gw * vv;
        squares += gw * w, weights2 += g * g;
      }
  VF moment[MOMENTS] = {m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10, m11, m12, m13, m14};
  VF right[TERMS] = {r0, r1, r2, r3, r4, r5};
  for (int k = 0; k < MOMENTS; ++k) sums->moment[k].s[lane] = added_lanes(moment[k]);
  for (int k = 0; k < TERMS; ++k) sums->right[k].s[lane] = added_lanes(right[k]);
  sums->squares.s[lane] = added_lanes(squares);
  sums->weights2.s[lane] = added_lanes(weights2);
}

// center: indices of sorted points; sorted: centroid or point, normal, weight (7, padded).
__kernel void guided_fits(int count, __global const int *center, __global const float *radii, float eighth_sharp,
                          int padded, __global const float *sorted, __global const float *boxes,
                          __global const int *node_offset, int top_level, __global float *out) {
  int packet = get_global_id(0);
  if (VW * packet >= count) return;
  size_t n = padded;
  Sums sums;
  Lanes radius;
  int last = count - VW * packet < VW ? count - VW * packet : VW;
  for (int j = 0; j < VW; ++j) {
    int i = VW * packet + (j < last ? j : 0);
    __global const float *p = sorted + center[i];
    Center c = {p[0], p[n], p[2 * n], radii[i], (float3)(p[3 * n], p[4 * n], p[5 * n])};
    radius.s[j] = c.radius;
    if (j < last) {
      add_points(&sums, j, c, eighth_sharp, n, sorted, boxes, node_offset, top_level);
      __global float *o = out + GUIDED_SURFEL * (size_t)i;
      o[0] = c.x, o[1] = c.y, o[2] = c.z, o[3] = c.radius, o[4] = c.normal.x, o[5] = c.normal.y, o[6] = c.normal.z;
      continue;
    }
    // The last packet's empty lanes repeat its first surfel.
    for (int k = 0; k < MOMENTS; ++k) sums.moment[k].s[j] = sums.moment[k].s[0];
    for (int k = 0; k < TERMS; ++k) sums.right[k].s[j] = sums.right[k].s[0];
    sums.squares.s[j] = sums.squares.s[0], sums.weights2.s[j] = sums.weights2.s[0];
  }
  VF moment[MOMENTS], right[TERMS], quadric[TERMS], plane[TERMS];
  for (int k = 0; k < MOMENTS; ++k) moment[k] = sums.moment[k].v;
  for (int k = 0; k < TERMS; ++k) right[k] = sums.right[k].v;
  VF total = moment[0] + 1e-30f, level = right[0] / total;
  Lanes c[TERMS], residual, points;
  points.v = total * total / (sums.weights2.v + 1e-30f);
  solve_terms(moment, right, quadric, TERMS);
  solve_terms(moment, right, plane, 3);
  residual.v = sums.squares.v;
  for (int k = 0; k < TERMS; ++k) {
    VF few = k < 3 ? SEL(k == 0 ? level : (VF)0.0f, plane[k], points.v >= FEW_FOR_PLANE) : (VF)0.0f;
    c[k].v = SEL(few, quadric[k], points.v >= FEW_FOR_QUADRIC);
    c[k].v = SEL((VF)0.0f, c[k].v, (c[k].v > -1e3f) & (c[k].v < 1e3f));
    residual.v -= c[k].v * right[k];
  }
  residual.v = residual.v / total * radius.v * radius.v;
  for (int j = 0; j < last; ++j) {
    __global float *o = out + GUIDED_SURFEL * (VW * (size_t)packet + j);
    float r = radius.s[j], k = 1.0f / r;
    o[7] = c[0].s[j] * r, o[8] = c[1].s[j], o[9] = c[2].s[j];
    o[10] = c[3].s[j] * k, o[11] = c[4].s[j] * k, o[12] = c[5].s[j] * k;
    o[13] = points.s[j], o[14] = residual.s[j] > 0.0f ? residual.s[j] : 0.0f, o[15] = 0.0f;
  }
}
