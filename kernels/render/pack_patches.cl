// Once per upload, one work-item per patch, after prepare_patches: the nodes as the tile stage reads them. Twin:
// tests/reference/render_patches.py, pack_patches.
#include "common/patch.clh"

inline uint pair16(float low, float high) {
  int a = (int)floor(low + 0.5f), b = (int)floor(high + 0.5f);
  return ((uint)a & 0xffffu) | (uint)b << 16;
}

__kernel void pack_patches(__global float *frames, __global const int *sizes, __global const uint *offsets, int count,
                           __global const uchar *colors, __global const float *linear, __global const height_t *heights,
                           __global const uchar *cells, __global const float *borders, __global const float2 *slopes,
                           float border_scale, __global float *steps, __global ushort *rims, __global uint4 *nodes) {
  int k = get_global_id(0);
  if (k >= count) return;
  int m = sizes[2 * k], n = sizes[2 * k + 1];
  uint first = offsets[k];
  float steepest = 0.0f, largest = 0.0f;
  for (int j = 0; j < n; j++)
    for (int i = 0; i < m; i++) {
      uint at = first + (uint)j * m + i;
      steepest = fmax(steepest, fmax(fabs(slopes[at].x), fabs(slopes[at].y)));
      if (!cells[at]) continue;
      float d = heights[at], right = heights[at + 1], above = heights[at + m], across = heights[at + m + 1];
      largest = fmax(fmax(largest, fabs(d - right)), fmax(fabs(d - above), fmax(fabs(across - right), fabs(across - above))));
    }
  // Slopes of 8-bit displacements are whole halves of a step.
  float scale = PRECISE ? fmax(steepest, 1e-30f) / 32767.0f : 0.5f;
  frames[(size_t)k * FRAME_FLOATS + SCALE_OF_SLOPES] = scale;
  frames[(size_t)k * FRAME_FLOATS + LARGEST_STEP] = largest;
  for (int j = 0; j < n; j++)
    for (int i = 0; i < m; i++) {
      uint at = first + (uint)j * m + i;
      int shown = cells[at] || (i > 0 && cells[at - 1]) || (j > 0 && (cells[at - m] || (i > 0 && cells[at - m - 1])));
      float d = heights[at];
      steps[at] = d;
      rims[at] = (ushort)((uint)fmin(borders[at] * border_scale, (float)RIM_BORDER) | (shown ? RIM_SHOWN : 0)
                          | (cells[at] ? RIM_DRAWN : 0));
      float red = 0.0f, green = 0.0f, blue = 0.0f;
#if CHANNELS
      __global const uchar *c = colors + (size_t)CHANNELS * at;
      red = linear[c[0]] * 65535.0f; green = linear[c[1]] * 65535.0f; blue = linear[c[2]] * 65535.0f;
#endif
      nodes[at] = (uint4)(as_uint(d), pair16(red, green), pair16(blue, 0.0f),
                          pair16(slopes[at].x / scale, slopes[at].y / scale));
    }
}
