// Where the rays from a centre through the texels of a cube map meet triangles: every triangle is drawn onto the faces
// of the cube that it may touch. A first launch counts the hits of every texel, a second one (FILL) writes them into
// lists, in any order; pick_scale_hits sorts those. One work-item per triangle, the lanes are blocks of 4 x VW / 4 texels.
// Only rows from first_row to last_row of each face are drawn: drivers that end long loops get a launch for every few.
//
// The test of an edge is that of single rays (common/edge_side.clh): a closed mesh is met without leaks, and an odd
// number of times from inside. Twin: tests/reference/scale_map.py, scale_hits.
#include "common/edge_side.clh"
#include "common/cube.clh"

#ifndef FILL
#define FILL 0
#endif
#define COLUMNS (VW == 1 ? 1 : 4)
#define ROWS (VW == 1 ? 1 : VW / 4)

INLINE float least3(float a, float b, float c) { float m = a < b ? a : b; return m < c ? m : c; }
INLINE float most3(float a, float b, float c) { float m = a > b ? a : b; return m > c ? m : c; }

// First and last texel whose centre lies between the face's coordinates `low` and `high`, a little widened.
INLINE int first_texel(float low, int size) {
  float at = (low + 1.0f) * (0.5f * size) - 0.5f - 1e-3f;
  return at > 0.0f ? (at < size ? (int)ceil(at) : size) : 0;
}
INLINE int last_texel(float high, int size) {
  float at = (high + 1.0f) * (0.5f * size) - 0.5f + 1e-3f;
  return at < size - 1 ? (at >= 0.0f ? (int)at : -1) : size - 1;
}

__kernel void scale_hits(int count, __global const float *vertices /* relative to the centre, in radii */,
                         __global const int *faces, int size, int first_row, int last_row,
                         __global uint *places /* per texel: hits so far */,
                         __global const uint *ends, __global float *distances, __global int *triangles) {
  int triangle = get_global_id(0);
  if (triangle >= count) return;
  float x[3], y[3], z[3], w[3], s[3], t[3];
  for (int k = 0; k < 3; k++) {
    __global const float *v = vertices + 3 * (size_t)faces[3 * (size_t)triangle + k];
    x[k] = v[0]; y[k] = v[1]; z[k] = v[2];
  }
  for (int face = 0; face < 6; face++) {
    for (int k = 0; k < 3; k++) face_frame(face, x[k], y[k], z[k], w + k, s + k, t + k);
    // Wholly outside one of the four sides of the face's pyramid, or behind it; not finite coordinates fail too.
    if (!(most3(w[0] - s[0], w[1] - s[1], w[2] - s[2]) > 0.0f && most3(w[0] + s[0], w[1] + s[1], w[2] + s[2]) > 0.0f
          && most3(w[0] - t[0], w[1] - t[1], w[2] - t[2]) > 0.0f && most3(w[0] + t[0], w[1] + t[1], w[2] + t[2]) > 0.0f
          && most3(w[0], w[1], w[2]) > 0.0f)) continue;
    int j0 = 0, j1 = size - 1, i0 = 0, i1 = size - 1;
    if (least3(w[0], w[1], w[2]) > 1e-6f) {
      float a[3], b[3];
      for (int k = 0; k < 3; k++) { a[k] = s[k] / w[k]; b[k] = t[k] / w[k]; }
      j0 = first_texel(least3(a[0], a[1], a[2]), size); j1 = last_texel(most3(a[0], a[1], a[2]), size);
      i0 = first_texel(least3(b[0], b[1], b[2]), size); i1 = last_texel(most3(b[0], b[1], b[2]), size);
    }
    i0 = max(i0, first_row); i1 = min(i1, last_row);
    for (int i = i0; i <= i1; i += ROWS)
      for (int j = j0; j <= j1; j += COLUMNS) {
#if VW == 1
        VI column = j, row = i;
#else
        VI column = (LANE_INDEX & 3) + j, row = (LANE_INDEX >> 2) + i;
#endif
        VF a = TO_VF(column * 2 + 1) * (1.0f / size) - 1.0f, b = TO_VF(row * 2 + 1) * (1.0f / size) - 1.0f;
        VF ax = s[0] - a * w[0], ay = t[0] - b * w[0], bx = s[1] - a * w[1], by = t[1] - b * w[1];
        VF cx = s[2] - a * w[2], cy = t[2] - b * w[2];
        VF u = edge_side(bx, by, cx, cy), v = edge_side(cx, cy, ax, ay), o = edge_side(ax, ay, bx, by);
        VI in = (u == v) & (v == o) & (u != 0.0f) & (column <= j1) & (row <= i1);
        if (!any_lane(in)) continue;
        VF eu = cx * by - cy * bx, ev = ax * cy - ay * cx, eo = bx * ay - by * ax;
        VF depth = (eu * w[0] + ev * w[1] + eo * w[2]) / (eu + ev + eo);
        // A sliver's quotient may be anything; its hit lies between its corners.
        float near = least3(w[0], w[1], w[2]), far = most3(w[0], w[1], w[2]);
        depth = SEL((VF)(0.5f * (near + far)), depth, depth == depth);
        depth = VMIN(VMAX(depth, (VF)(near)), (VF)(far));
        in = in & (depth >= 0.0f);
        VF distance = depth * VSQRT(1.0f + a * a + b * b);
        for (int lane = 0; lane < VW; lane++) {
          if (!((const int *)&in)[lane]) continue;
          int texel = (face * size + ((const int *)&row)[lane]) * size + ((const int *)&column)[lane];
          uint at = atomic_inc(places + texel);
#if FILL
          if (at >= ends[texel]) continue;
          distances[at] = ((const float *)&distance)[lane];
          triangles[at] = triangle;
#endif
        }
      }
  }
}
