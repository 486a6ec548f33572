// Quadratic surfels fitted to points with normals, a surfel per lane: weights fall with the distance from the centre and
// with the angle between a point's normal and the centre's, so that a fit does not reach over an edge.
#define DEGREE 2
#include "analysis/guided.clh"
#include "build/polynomial_fit.clh"

// Effective points below which a surfel makes do with a plane, and with a constant.
#ifndef FEW_FOR_QUADRIC
#define FEW_FOR_QUADRIC 8.0f
#define FEW_FOR_PLANE 3.5f
#endif

inline VF gathered(__global const float *values, const int *index) {
  Lanes l;
  for (int j = 0; j < VW; ++j) l.s[j] = values[index[j]];
  return l.v;
}

typedef struct {
  VF moment[MOMENTS], right[TERMS], squares, weights2;
} Sums;

inline void add_points(Sums *sums, VF x, VF y, VF z, VF nx, VF ny, VF nz, VF radius, float eighth_sharp, size_t padded,
                       __global const float *sorted, __global const float *boxes, __global const int *node_offset,
                       int top_level) {
  // The frame of frame_of_normal (common/frame.clh), in lanes.
  VF sign = SEL((VF)1.0f, (VF)-1.0f, nz < 0.0f), a = -1.0f / (sign + nz), b = nx * ny * a;
  VF ux = 1.0f + sign * nx * nx * a, uy = sign * b, uz = -sign * nx, vx = b, vy = sign + ny * ny * a, vz = -ny;
  VF inverse = 1.0f / radius, inverse2 = inverse * inverse;
  VF m0 = 0.0f, m1 = 0.0f, m2 = 0.0f, m3 = 0.0f, m4 = 0.0f, m5 = 0.0f, m6 = 0.0f, m7 = 0.0f, m8 = 0.0f, m9 = 0.0f,
     m10 = 0.0f, m11 = 0.0f, m12 = 0.0f, m13 = 0.0f, m14 = 0.0f, r0 = 0.0f, r1 = 0.0f, r2 = 0.0f, r3 = 0.0f, r4 = 0.0f,
     r5 = 0.0f, squares = 0.0f, weights2 = 0.0f;
  Sphere s = sphere_of_lanes(x, y, z);
  float reach = s.extent + highest_lane(radius);
  uint list[BLOCK_LIST];
  Traversal t;
  traversal_start(&t, top_level);
  int blocks;
  while ((blocks = traversal_next(&t, boxes, node_offset, s.x, s.y, s.z, reach * reach, list)) > 0)
    for (int k = 0; k < blocks; ++k)
      for (int j = 0; j < 16; ++j) {
        __global const float *p = sorted + 16 * (size_t)list[k] + j;
        VF dx = p[0] - x, dy = p[padded] - y, dz = p[2 * padded] - z;
        VF turn = 1.0f - (nx * p[3 * padded] + ny * p[4 * padded] + nz * p[5 * padded]);
        VF g = guided_weight((dx * dx + dy * dy + dz * dz) * inverse2, turn, eighth_sharp) * p[6 * padded];
        VF u = (ux * dx + uy * dy + uz * dz) * inverse, v = (vx * dx + vy * dy + vz * dz) * inverse;
        VF w = (nx * dx + ny * dy + nz * dz) * inverse;
        VF uu = u * u, uv = u * v, vv = v * v, guu = g * uu, gvv = g * vv, guv = g * uv, gw = g * w;
        m0 += g, m1 += g * u, m2 += g * v, m3 += guu, m4 += guv, m5 += gvv;
        m6 += guu * u, m7 += guu * v, m8 += gvv * u, m9 += gvv * v;
        m10 += guu * uu, m11 += guu * uv, m12 += guu * vv, m13 += guv * vv, m14 += gvv * vv;
        r0 += gw, r1 += gw * u, r2 += gw * v, r3 += gw * uu, r4 += gw * uv, r5 += gw * vv;
        squares += gw * w, weights2 += g * g;
      }
  VF moment[MOMENTS] = {m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10, m11, m12, m13, m14}, right[TERMS] = {r0, r1, r2, r3, r4, r5};
  for (int k = 0; k < MOMENTS; ++k) sums->moment[k] = moment[k];
  for (int k = 0; k < TERMS; ++k) sums->right[k] = right[k];
  sums->squares = squares;
  sums->weights2 = weights2;
}

// center: indices of sorted points; sorted: centroid or point, normal, weight (7, padded).
__kernel void guided_fits(int count, __global const int *center, __global const float *radii, float eighth_sharp,
                          int padded, __global const float *sorted, __global const float *boxes,
                          __global const int *node_offset, int top_level, __global float *out) {
  int packet = get_global_id(0);
  if (VW * packet >= count) return;
  size_t n = padded;
  int index[VW];
  Lanes radius;
  for (int j = 0; j < VW; ++j) { // the last packet's empty lanes repeat its first surfel
    int i = VW * packet + j < count ? VW * packet + j : VW * packet;
    index[j] = center[i];
    radius.s[j] = radii[i];
  }
  Lanes x[6];
  for (int k = 0; k < 6; ++k) x[k].v = gathered(sorted + k * n, index);
  Sums sums;
  add_points(&sums, x[0].v, x[1].v, x[2].v, x[3].v, x[4].v, x[5].v, radius.v, eighth_sharp, n, sorted, boxes,
             node_offset, top_level);
  VF quadric[TERMS], plane[TERMS], points = sums.moment[0] * sums.moment[0] / (sums.weights2 + 1e-30f);
  solve_terms(sums.moment, sums.right, quadric, TERMS);
  solve_terms(sums.moment, sums.right, plane, 3);
  VF level = sums.right[0] / (sums.moment[0] + 1e-30f);
  Lanes c[TERMS], residual, effective;
  residual.v = sums.squares;
  for (int k = 0; k < TERMS; ++k) {
    VF few = k < 3 ? SEL(k == 0 ? level : (VF)0.0f, plane[k], points >= FEW_FOR_PLANE) : (VF)0.0f;
    c[k].v = SEL(few, quadric[k], points >= FEW_FOR_QUADRIC);
    c[k].v = SEL((VF)0.0f, c[k].v, (c[k].v > -1e3f) & (c[k].v < 1e3f));
    residual.v -= c[k].v * sums.right[k];
  }
  residual.v = residual.v / (sums.moment[0] + 1e-30f) * radius.v * radius.v;
  effective.v = points;
  for (int j = 0; j < VW && VW * packet + j < count; ++j) {
    __global float *o = out + GUIDED_SURFEL * (VW * (size_t)packet + j);
    float r = radius.s[j], k = 1.0f / r;
    o[0] = x[0].s[j], o[1] = x[1].s[j], o[2] = x[2].s[j], o[3] = r;
    o[4] = x[3].s[j], o[5] = x[4].s[j], o[6] = x[5].s[j];
    o[7] = c[0].s[j] * r, o[8] = c[1].s[j], o[9] = c[2].s[j];
    o[10] = c[3].s[j] * k, o[11] = c[4].s[j] * k, o[12] = c[5].s[j] * k;
    o[13] = effective.s[j], o[14] = residual.s[j] > 0.0f ? residual.s[j] : 0.0f, o[15] = 0.0f;
  }
}
