// Once per upload, one work-item per patch: which cells are drawn, how far every node is from the border of what is
// drawn, and the slopes of the surface at the nodes. Twin: tests/reference/render_patches.py, prepare_patches.
#include "common/patch.clh"

// Slope at a node along one direction: central where both neighbours show, else one-sided.
inline float slope(int before, int after, float low, float here, float high) {
  if (before && after) return 0.5f * (high - low);
  return before ? here - low : after ? high - here : 0.0f;
}

__kernel void prepare_patches(__global const float *frames, __global const int *sizes, __global const uint *offsets,
                              int count, __global const uchar *colors, __global const height_t *heights,
                              __global uchar *cells, __global float *borders, __global float2 *slopes) {
  int k = get_global_id(0);
  if (k >= count) return;
  int m = sizes[2 * k], n = sizes[2 * k + 1];
  uint first = offsets[k];
  __global const float *f = frames + (size_t)k * FRAME_FLOATS;
  float dx = sqrt(f[AXIS_X] * f[AXIS_X] + f[AXIS_X + 1] * f[AXIS_X + 1] + f[AXIS_X + 2] * f[AXIS_X + 2]);
  float dy = sqrt(f[AXIS_Y] * f[AXIS_Y] + f[AXIS_Y + 1] * f[AXIS_Y + 1] + f[AXIS_Y + 2] * f[AXIS_Y + 2]);
  float diagonal = sqrt(dx * dx + dy * dy);
  for (int j = 0; j < n; j++)
    for (int i = 0; i < m; i++) {
      uint at = first + (uint)j * m + i;
      int here = opaque(colors, heights, at);
      int left = i > 0 && opaque(colors, heights, at - 1), right = i < m - 1 && opaque(colors, heights, at + 1);
      int below = j > 0 && opaque(colors, heights, at - m), above = j < n - 1 && opaque(colors, heights, at + m);
      cells[at] = here && right && above && opaque(colors, heights, at + m + 1);
      float d = heights[at];
      slopes[at] = (float2)(slope(left, right, left ? heights[at - 1] : 0.0f, d, right ? heights[at + 1] : 0.0f),
                            slope(below, above, below ? heights[at - m] : 0.0f, d, above ? heights[at + m] : 0.0f));
    }
  // Distances along the eight directions, by one sweep each way; nodes that not all four cells around are drawn of: 0.
  for (int j = 0; j < n; j++)
    for (int i = 0; i < m; i++) {
      uint at = first + (uint)j * m + i;
      float b = 0.0f;
      if (i > 0 && j > 0 && i < m - 1 && j < n - 1 && cells[at] && cells[at - 1] && cells[at - m] && cells[at - m - 1]) {
        b = borders[at - 1] + dx;
        b = fmin(b, borders[at - m] + dy);
        b = fmin(b, fmin(borders[at - m - 1], borders[at - m + 1]) + diagonal);
      }
      borders[at] = b;
    }
  for (int j = n - 2; j > 0; j--)
    for (int i = m - 2; i > 0; i--) {
      uint at = first + (uint)j * m + i;
      float b = borders[at];
      b = fmin(b, fmin(borders[at + 1] + dx, borders[at + m] + dy));
      borders[at] = fmin(b, fmin(borders[at + m + 1], borders[at + m - 1]) + diagonal);
    }
}
