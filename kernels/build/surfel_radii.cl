// Radii of base surfels: how far from a point, in its plane, the places reach that are nearer to it than to any of its
// neighbours (its Voronoi cell), in 16 directions. Discs of that radius leave no hole between the points.
// Twin: tests/reference/surfels.py, surfel_radii.
#include "common/frame.clh"

#ifndef K
#define K 24
#endif
#define RIM 0.6f      // spacings, where no neighbour lies within 60 degrees of a direction: the rim of an open surface
#define LARGEST 2.0f  // spacings
#define LEAST 0.55f

// Of `count` points, the first of which is number `first`.
__kernel void surfel_radii(int count, int first, __global const float *points, __global const float *normals,
                           __global const int *neighbours /* (count, K), the first is the point */, float overlap,
                           __global float *radii, __global float *spacings) {
  int at = get_global_id(0), i = first + at;
  if (at >= count) return;
  float3 p = vload3(i, points), n = vload3(i, normals), u, v;
  frame_of_normal(n, &u, &v);
  const float cosines[16] = {1.0f, 0.92387953f, 0.70710678f, 0.38268343f, 0.0f, -0.38268343f, -0.70710678f,
                             -0.92387953f, -1.0f, -0.92387953f, -0.70710678f, -0.38268343f, 0.0f, 0.38268343f,
                             0.70710678f, 0.92387953f};
  float x[K], y[K], d2[K];
  int found = 0;
  for (int j = 0; j < K; j++) {
    int other = neighbours[(size_t)at * K + j];
    if (other < 0 || other == i) continue;
    float3 d = vload3(other, points) - p, m = vload3(other, normals);
    float a = dot(d, u), b = dot(d, v), r2 = a * a + b * b;
    if (dot(m, n) <= 0.0f || r2 <= 0.01f * dot(d, d)) continue;  // of another sheet, or right above
    x[found] = a; y[found] = b; d2[found] = r2; found++;
  }
  // d2 ascends almost; the k-th neighbour lies sqrt(k / pi) spacings away.
  float far2 = 0.0f;
  for (int j = 0; j < found && j < 12; j++) far2 = d2[j] > far2 ? d2[j] : far2;
  int within = found < 12 ? found : 12;
  float spacing = within ? sqrt(far2 * 3.14159265f / (within + 0.5f)) : 0.0f;
  float reach = 0.0f;
  for (int a = 0; a < 16; a++) {
    float c = cosines[a], s = cosines[(a + 12) & 15], nearest = INFINITY;
    int open = 1;
    for (int j = 0; j < found; j++) {
      float along = c * x[j] + s * y[j];
      float t = along > 0.0f ? 0.5f * d2[j] / along : INFINITY;
      nearest = t < nearest ? t : nearest;
      open &= !(along > 0.0f && along * along > 0.25f * d2[j]);
    }
    float most = (open ? RIM : LARGEST) * spacing;
    nearest = nearest < most ? nearest : most;
    reach = nearest > reach ? nearest : reach;
  }
  reach = reach > LEAST * spacing ? reach : LEAST * spacing;
  radii[at] = overlap * reach;
  spacings[at] = spacing;
}
