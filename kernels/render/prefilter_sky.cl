// The light of a sky as surfaces see it: an octahedral map (kernels/render/texels.clh) of what comes back from a surface that
// faces each direction, mirrored by GGX microfacets (eye and normal in one, Karis 2013), or matte.
//
// The sky is a quadtree: octahedral squares of 2^k x 2^k cells with their mean light and solid angle, level after level. A
// cell is opened where it is wide beside its distance from the lobe's middle and the lobe's width, so that a small sun is
// summed as such by every lobe, near and far, without noise. Lanes are texels in a row; they share the walk.
// Twin: tests/reference/light.py, prefilter_sky.
#include "common/lanes.clh"

#ifndef FIRST
#define FIRST 4      // level whose cells are all visited: 16 x 16
#endif
#ifndef MATTE
#define MATTE 0
#endif
#define WIDEST (MATTE ? 0.06f : 0.12f)  // of a cell in parts of its distance

// The direction of the place (u, v) of the square, from -1 to 1.
INLINE void fold(float u, float v, float *d) {
  float au = fabs(u), av = fabs(v), y = 1.0f - au - av;
  d[0] = y < 0.0f ? (u < 0.0f ? av - 1.0f : 1.0f - av) : u;
  d[1] = y;
  d[2] = y < 0.0f ? (v < 0.0f ? au - 1.0f : 1.0f - au) : v;
  float inv = 1.0f / sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  for (int i = 0; i < 3; i++) d[i] *= inv;
}

__kernel void prefilter_sky(__global const float4 *tree, int last_level, float alpha, int cells, __global float4 *out) {
  int n = cells + 1, first = get_global_id(0) * VW;
  if (first >= n * n) return;
  VF x, y, z;
  for (int i = 0; i < VW; i++) {
    int at = first + i < n * n ? first + i : n * n - 1;
    float d[3];
    fold(2.0f * (at % n) / cells - 1.0f, 2.0f * (at / n) / cells - 1.0f, d);
    ((float *)&x)[i] = d[0]; ((float *)&y)[i] = d[1]; ((float *)&z)[i] = d[2];
  }
  VF red = 0.0f, green = 0.0f, blue = 0.0f, sum = 0.0f;
  float a2 = alpha * alpha, width = MATTE ? 1.0f : 2.0f * alpha;
  int levels[40], places[40];
  for (int root = 0; root < 1 << 2 * FIRST; root++) {
    int waiting = 1;
    levels[0] = FIRST; places[0] = (root >> FIRST) << 16 | (root & ((1 << FIRST) - 1));
    while (waiting > 0) {
      waiting--;
      int level = levels[waiting], row = places[waiting] >> 16, column = places[waiting] & 0xffff, size = 1 << level;
      // Levels before this one have (4^level - 4^FIRST) / 3 cells.
      float4 cell = tree[((1 << 2 * level) - (1 << 2 * FIRST)) / 3 + row * size + column];
      float d[3], radius = 0.75f * sqrt(cell.w);
      fold((2.0f * column + 1.0f) / size - 1.0f, (2.0f * row + 1.0f) / size - 1.0f, d);
      VF dx = x - d[0], dy = y - d[1], dz = z - d[2], far = 0.25f * (dx * dx + dy * dy + dz * dz);  // (1 - cosine) / 2
      VF cosine = 1.0f - 2.0f * far;
      if (!any_lane(cosine > -2.0f * radius)) continue;
      VF away = 2.0f * VSQRT(far) - radius;
      away = VMAX(away, (VF)(0.0f)) + width;
      if (level < last_level && any_lane(radius > WIDEST * away)) {
        for (int i = 0; i < 4; i++) {
          levels[waiting] = level + 1;
          places[waiting++] = (2 * row + (i >> 1)) << 16 | (2 * column + (i & 1));
        }
        continue;
      }
      VF weight = VMAX(cosine, (VF)(0.0f)) * cell.w;
      if (!MATTE) {
        VF d2 = far + a2 * (1.0f - far);
        weight *= a2 / (d2 * d2);
      }
      red += weight * cell.x; green += weight * cell.y; blue += weight * cell.z; sum += weight;
    }
  }
  VF inv = 1.0f / sum;
  red *= inv; green *= inv; blue *= inv;
  for (int i = 0; i < VW && first + i < n * n; i++)
    out[first + i] = (float4)(((float *)&red)[i], ((float *)&green)[i], ((float *)&blue)[i], 0.0f);
}
