// Give the pixels that hold an edge the mean of their 4 x 4 samples: lit colours in the planes of a picture drawn 4 times as
// large, whose blocks of 4x4 samples are pixels; samples that hit nothing have the background's colour.
//
// One work-item per SPAN pixels of a row. Twin: tests/reference/light.py, cover_edges.
#include "common/bins.clh"
#include "common/planes.clh"

#ifndef SPAN
#define SPAN 64
#endif

__kernel void cover_edges(__global const uchar *edges, __global const int *touched, __global const float *all_planes,
                          __global const float *background, int bins_x, int width, int height, __global float4 *color) {
  int x0 = get_global_id(0) * SPAN, y = get_global_id(1);
  if (x0 >= width || y >= height) return;
  float4 back = (float4)(background[0], background[1], background[2], background[3]);
  for (int x = x0; x < (x0 + SPAN < width ? x0 + SPAN : width); x++) {
    if (!edges[(size_t)y * width + x]) continue;
    int bin = y / 2 * bins_x + x / 2;
    float4 sum = 0.0f;  // of differences from the background, so that what is all background stays exactly that
    if (touched[bin] >= 0) {
      __global const float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS;
      int first = (y & 1) * 4 * BIN + (x & 1) * 4;
      for (int s = 0; s < 16; s++) {
        int at = first + (s >> 2) * BIN + (s & 3);
        if (!(planes[FIELD_DEPTH * BIN_PIXELS + at] < EMPTY_DEPTH)) continue;
        sum += (float4)(-planes[FIELD_COLOR * BIN_PIXELS + at], -planes[(FIELD_COLOR + 1) * BIN_PIXELS + at],
                        -planes[(FIELD_COLOR + 2) * BIN_PIXELS + at], 1.0f) - back;
      }
    }
    color[(size_t)y * width + x] = back + sum * (1.0f / 16.0f);
  }
}
