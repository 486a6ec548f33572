// Reduce a picture drawn FACTOR times as large each way: the colour is the mean of a pixel's samples (linear light,
// premultiplied alpha); every other channel comes whole from one sample, so that depth, normal and ids belong together:
// the sample at the pixel's centre, or, where FACTOR is even, the nearest to the eye of the four around the centre (the
// first of equals in reading order). One work-item per SPAN pixels of a row.
// Twin: tests/reference/render_patch_modes.py, average.
#ifndef FACTOR
#define FACTOR 2
#endif
#ifndef SPAN
#define SPAN 64
#endif
#ifndef WRITE_COLOR
#define WRITE_COLOR 1
#define WRITE_DEPTH 1
#define WRITE_NORMAL 1
#define WRITE_POSITION 0
#define WRITE_ID 0
#define WRITE_COUNT 0
#define WRITE_LEVEL 0
#define WRITE_COST 0
#endif
#ifndef DIFFERENTIAL_SCALARS
#define DIFFERENTIAL_SCALARS 0  // pictures of one value, then of three values per pixel
#define DIFFERENTIAL_VECTORS 0
#endif
#define OTHERS (DIFFERENTIAL_SCALARS || DIFFERENTIAL_VECTORS || WRITE_DEPTH || WRITE_NORMAL || WRITE_POSITION || WRITE_ID || WRITE_COUNT || WRITE_LEVEL || WRITE_COST)

// Index of the sample that speaks for a pixel whose first sample is `first`.
inline size_t chosen_sample(__global const float *depth, size_t first, int row) {
  size_t best = first + (size_t)((FACTOR - 1) / 2) * row + (FACTOR - 1) / 2;
#if FACTOR % 2 == 0
  // NaN, a sample that hits nothing, never compares as nearer.
  size_t around[3] = {best + 1, best + row, best + row + 1};
  for (int i = 0; i < 3; i++) {
    float was = depth[best], here = depth[around[i]];
    if (here < was || (was != was && here == here)) best = around[i];
  }
#endif
  return best;
}

__kernel void average(int width, int height, __global const float4 *fine_color, __global const float *fine_depth,
                      __global const float *fine_normal, __global const float *fine_position,
                      __global const int *fine_id, __global const int *fine_count, __global const int *fine_level,
                      __global const int *fine_cost, __global const float *fine_differentials, __global float4 *color, __global float *depth,
                      __global float *normal, __global float *position, __global int *id, __global int *count,
                      __global int *level, __global int *cost, __global float *differentials) {
  int x0 = get_global_id(0) * SPAN, y = get_global_id(1), row = width * FACTOR;
  if (x0 >= width || y >= height) return;
  for (int x = x0; x < (x0 + SPAN < width ? x0 + SPAN : width); x++) {
    size_t at = (size_t)y * width + x, first = (size_t)y * FACTOR * row + (size_t)x * FACTOR;
#if WRITE_COLOR
    float4 one = fine_color[first], sum = 0.0f;  // differences, so that the mean of equal colours is exactly that colour
    for (int j = 0; j < FACTOR; j++)
      for (int i = 0; i < FACTOR; i++) sum += fine_color[first + (size_t)j * row + i] - one;
    color[at] = one + sum * (1.0f / (FACTOR * FACTOR));
#endif
#if OTHERS
    size_t best = chosen_sample(fine_depth, first, row);
#endif
#if WRITE_DEPTH
    depth[at] = fine_depth[best];
#endif
#if WRITE_NORMAL
    for (int c = 0; c < 3; c++) normal[3 * at + c] = fine_normal[3 * best + c];
#endif
#if WRITE_POSITION
    for (int c = 0; c < 3; c++) position[3 * at + c] = fine_position[3 * best + c];
#endif
#if WRITE_ID
    id[at] = fine_id[best];
#endif
#if WRITE_COUNT
    count[at] = fine_count[best];
#endif
#if WRITE_LEVEL
    level[at] = fine_level[best];
#endif
#if WRITE_COST
    cost[at] = fine_cost[best];
#endif
#if DIFFERENTIAL_SCALARS || DIFFERENTIAL_VECTORS
    size_t pixels = (size_t)width * height, fine_pixels = pixels * FACTOR * FACTOR;
    for (int i = 0; i < DIFFERENTIAL_SCALARS; i++)
      differentials[i * pixels + at] = fine_differentials[i * fine_pixels + best];
    for (int i = DIFFERENTIAL_SCALARS; i < DIFFERENTIAL_SCALARS + 3 * DIFFERENTIAL_VECTORS; i += 3)
      for (int c = 0; c < 3; c++)
        differentials[i * pixels + 3 * at + c] = fine_differentials[i * fine_pixels + 3 * best + c];
#endif
  }
}
