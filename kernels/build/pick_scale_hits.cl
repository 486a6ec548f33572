// Sort the hits of every texel by distance (of equals the first triangle) and pick the layers. One work-item per texel.
// Twin: tests/reference/scale_map.py, pick_scale_hits.
#include "common/cube.clh"

#ifndef LAYERS
#define LAYERS 1
#endif
#ifndef OUTERMOST
#define OUTERMOST 1
#endif
#ifndef NORMALS
#define NORMALS 0  // 1: of the triangles' planes, 2: interpolated between the vertices' own
#endif

INLINE float side(const float *p, const float *q, float x, float y, float z) {  // of the ray (x, y, z), twice the area
  return x * (p[1] * q[2] - p[2] * q[1]) + y * (p[2] * q[0] - p[0] * q[2]) + z * (p[0] * q[1] - p[1] * q[0]);
}

// The unit normal, on the side of the ray (x, y, z).
INLINE void normal_at(__global const float *vertices, __global const int *corner, __global const float *own, float x,
                      float y, float z, float *out) {
  float p[3][3], n[3];
  for (int k = 0; k < 3; k++)
    for (int c = 0; c < 3; c++) p[k][c] = vertices[3 * (size_t)corner[k] + c];
  float e[3], f[3];
  for (int c = 0; c < 3; c++) { e[c] = p[1][c] - p[0][c]; f[c] = p[2][c] - p[0][c]; }
  n[0] = e[1] * f[2] - e[2] * f[1]; n[1] = e[2] * f[0] - e[0] * f[2]; n[2] = e[0] * f[1] - e[1] * f[0];
#if NORMALS == 2
  float a = side(p[1], p[2], x, y, z), b = side(p[2], p[0], x, y, z), c = side(p[0], p[1], x, y, z), all = a + b + c;
  if (all != 0.0f)
    for (int k = 0; k < 3; k++)
      n[k] = (a * own[3 * (size_t)corner[0] + k] + b * own[3 * (size_t)corner[1] + k]
              + c * own[3 * (size_t)corner[2] + k]) / all;
#endif
  float length = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), along = n[0] * x + n[1] * y + n[2] * z;
  for (int k = 0; k < 3; k++) out[k] = length > 0.0f ? (along < 0.0f ? -n[k] : n[k]) / length : (k ? k == 1 ? y : z : x);
}

__kernel void pick_scale_hits(int size, float farthest, __global const uint *begins, __global const uint *ends,
                              __global float *distances, __global int *triangles, __global const float *vertices,
                              __global const int *faces, __global const float *vertex_normals,
                              __global float *lambdas /* (LAYERS, texels); -1: a hole */,
                              __global int *counts, __global float *normals /* (LAYERS, texels, 3) */) {
  int texel = get_global_id(0), texels = 6 * size * size;
  if (texel >= texels) return;
  uint begin = begins[texel], end = ends[texel], kept = begin;
  for (uint k = begin; k < end; k++) {  // insertion: lists are short
    float d = distances[k];
    int triangle = triangles[k];
    if (!(d >= 0.0f && d <= farthest)) continue;
    uint at = kept++;
    for (; at > begin && (distances[at - 1] > d || (distances[at - 1] == d && triangles[at - 1] > triangle)); at--) {
      distances[at] = distances[at - 1];
      triangles[at] = triangles[at - 1];
    }
    distances[at] = d;
    triangles[at] = triangle;
  }
  counts[texel] = kept - begin;
  for (int layer = 0; layer < LAYERS; layer++) {
    size_t out = (size_t)layer * texels + texel;
    int hole = layer >= (int)(kept - begin);
    uint at = OUTERMOST ? kept - 1 - layer : begin + layer;
    lambdas[out] = hole ? -1.0f : distances[at];
#if NORMALS
    float x, y, z, a = (2 * (texel % size) + 1.0f) / size - 1.0f, b = (2 * (texel / size % size) + 1.0f) / size - 1.0f;
    int face = texel / (size * size), axis = face >> 1;
    float flip = face & 1 ? -1.0f : 1.0f, n[3];
    x = axis == 0 ? flip : face == 5 ? -a : a;
    y = axis == 1 ? flip : -b;
    z = axis == 2 ? flip : axis == 1 ? flip * b : -flip * a;
    float inverse = 1.0f / sqrt(x * x + y * y + z * z);
    if (hole) n[0] = n[1] = n[2] = 0.0f;
    else normal_at(vertices, faces + 3 * (size_t)triangles[at], vertex_normals, x * inverse, y * inverse, z * inverse, n);
    for (int k = 0; k < 3; k++) normals[3 * out + k] = n[k];
#endif
  }
}
