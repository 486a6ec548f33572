// The depths of the bins as a picture with a rim of `rim` pixels, all of it INFINITY where nothing is. One work-item per
// row of pixels of a bin. Twin: tests/reference/render_points.py, gather_depths.
#include "common/planes.clh"

__kernel void gather_depths(__global const float *planes, __global const int *touched, int bins_x, int rows, int rim,
                            int pitch, __global float *depths) {
  int bin_x = get_global_id(0), y = get_global_id(1);
  if (bin_x >= bins_x || y >= rows) return;
  int bin = y / BIN * bins_x + bin_x;
  __global const float *from = planes + ((size_t)bin * FIELDS + FIELD_DEPTH) * BIN_PIXELS + y % BIN * BIN;
  __global float *to = depths + (size_t)(y + rim) * pitch + bin_x * BIN + rim;
  for (int i = 0; i < BIN; i++) to[i] = touched[bin] < 0 ? EMPTY_DEPTH : from[i];
}
