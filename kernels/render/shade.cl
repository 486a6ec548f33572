// Shade the bins' planes and write the channels of the picture; bins that nothing touched get the background.
//
// Blinn-Phong in view space, linear light. One work-item per run of SPAN pixels in a row of bins (VW = 1: SPAN = 1, one
// pixel). Twin: tests/reference/render.py, shade.
#include "render/shade.clh"

#ifndef SPAN
#define SPAN 128
#endif
// A field of VW pixels in one row that starts at pixel (x, y); bins that nothing touched give `none`.
INLINE VF load_row(__global const float *planes, __global const int *touched, int bins_x, int x, int y, int field,
                   float none) {
  VF value = none;
  for (int i = 0; i < VW; i += (VW < BIN ? VW : BIN)) {
    int bin_x = (x + i) / BIN, bin = y / BIN * bins_x + bin_x;
    if (bin_x >= bins_x || touched[bin] < 0) continue;
    __global const float *row = planes + ((size_t)bin * FIELDS + field) * BIN_PIXELS + y % BIN * BIN + (x + i) % BIN;
#if VW == 16
    ((float8 *)&value)[i / 8] = *(__global const float8 *)row;
#else
    for (int j = 0; j < (VW < BIN ? VW : BIN); j++) ((float *)&value)[i + j] = row[j];
#endif
  }
  return value;
}

// Put the channels of curvature, as they come from the tile stages but for the axes of directions.
INLINE void put_differentials(__global const float *view, __global const float *planes, __global const int *touched,
                              int bins_x, size_t pixels, int width, int x, int y, int lanes, VF depth,
                              __global float *out) {
  VF none = NONE;
  VI hit = depth < EMPTY_DEPTH;
  size_t at = (size_t)y * width + x;
  for (int i = 0; i < DIFFERENTIAL_SCALARS; i++) {
    VF value = load_row(planes, touched, bins_x, x, y, FIELD_DIFFERENTIAL + i, 0.0f);
    put_values(out + i * pixels + at, SEL(none, value, hit), lanes);
  }
  for (int i = DIFFERENTIAL_SCALARS; i < DIFFERENTIAL_SCALARS + 3 * DIFFERENTIAL_VECTORS; i += 3) {
    VF vx = load_row(planes, touched, bins_x, x, y, FIELD_DIFFERENTIAL + i, 0.0f);
    VF vy = load_row(planes, touched, bins_x, x, y, FIELD_DIFFERENTIAL + i + 1, 0.0f);
    VF vz = load_row(planes, touched, bins_x, x, y, FIELD_DIFFERENTIAL + i + 2, 0.0f);
    put_triples(out + i * pixels + 3 * at, SEL(none, WORLD(0, vx, vy, vz), hit), SEL(none, WORLD(1, vx, vy, vz), hit),
                SEL(none, WORLD(2, vx, vy, vz), hit), lanes);
  }
}

INLINE void no_differentials(size_t pixels, int width, int x, int y, int count, __global float *out) {
  size_t at = (size_t)y * width + x;
  for (int i = 0; i < DIFFERENTIAL_SCALARS; i++) fill(out + i * pixels + at, count, NONE);
  for (int i = DIFFERENTIAL_SCALARS; i < DIFFERENTIAL_SCALARS + 3 * DIFFERENTIAL_VECTORS; i += 3)
    fill(out + i * pixels + 3 * at, 3 * count, NONE);
}

INLINE void shade_run(__global const float *view, __global const float *shading, __global const float *planes,
                      __global const int *touched, int bins_x, int width, int height, int x, int x_end, int y,
                      Channels out, __global float *differentials) {
  int lanes = x_end - x < VW ? x_end - x : VW;
  Shown s;
#define FIELD(field, none) load_row(planes, touched, bins_x, x, y, field, none)
  s.depth = FIELD(FIELD_DEPTH, EMPTY_DEPTH);
  s.nx = FIELD(FIELD_NORMAL, 0.0f); s.ny = FIELD(FIELD_NORMAL + 1, 0.0f); s.nz = FIELD(FIELD_NORMAL + 2, 1.0f);
#if FIELD_COLOR >= 0
  s.red = FIELD(FIELD_COLOR, 0.0f); s.green = FIELD(FIELD_COLOR + 1, 0.0f); s.blue = FIELD(FIELD_COLOR + 2, 0.0f);
#endif
#if FIELD_ID >= 0
  s.id = AS_VI(FIELD(FIELD_ID, 0.0f));
#endif
#if FIELD_COUNT >= 0
  s.count = AS_VI(FIELD(FIELD_COUNT, 0.0f));
#endif
#if FIELD_LEVEL >= 0
  s.level = AS_VI(FIELD(FIELD_LEVEL, 0.0f));
#endif
  shade_row(view, shading, &s, width, x, y, lanes, out);
  put_differentials(view, planes, touched, bins_x, (size_t)width * height, width, x, y, lanes, s.depth, differentials);
#if WRITE_COST
  for (int i = 0; i < lanes; i++) {
    int c = touched[y / BIN * bins_x + (x + i) / BIN];
    out.cost[(size_t)y * width + x + i] = c < 0 ? 0 : c;
  }
#endif
}

__kernel void shade(__global const float *view, __global const float *shading, __global const float *planes,
                    __global const int *touched, int bins_x, int width, int height,
                    __global float4 *color, __global float *depth, __global float *normal, __global float *position,
                    __global int *id, __global int *count, __global int *level, __global int *cost,
                    __global float *differentials /* a picture per channel: the scalars, then the vectors */) {
  Channels out = {color, depth, normal, position, id, count, level, cost};
#if VW == 1
  int x = get_global_id(0), y = get_global_id(1);
  if (x >= width || y >= height) return;
  if (touched[y / BIN * bins_x + x / BIN] < 0) {
    background_row(shading, width, x, y, 1, out);
    no_differentials((size_t)width * height, width, x, y, 1, differentials);
  } else shade_run(view, shading, planes, touched, bins_x, width, height, x, x + 1, y, out, differentials);
#else
  int x0 = get_global_id(0) * SPAN, y0 = get_global_id(1) * BIN;
  if (x0 >= width || y0 >= height) return;
  int x1 = x0 + SPAN < width ? x0 + SPAN : width, y1 = y0 + BIN < height ? y0 + BIN : height;
  __global const int *row = touched + y0 / BIN * bins_x;
  for (int x = x0; x < x1;) {
    int run = x;  // untouched bins from x on
    while (run < x1 && row[run / BIN] < 0) run = (run / BIN + 1) * BIN;
    run = run < x1 ? run : x1;
    for (int y = y0; y < y1 && run > x; y++) {
      background_row(shading, width, x, y, run - x, out);
      no_differentials((size_t)width * height, width, x, y, run - x, differentials);
    }
    x = run;
    if (x >= x1) return;
    // Lanes of 16 cover two bins; the second one may be untouched.
    for (int y = y0; y < y1; y++)
      for (int part = x; part < x + (VW > BIN ? VW : BIN) && part < x1; part += VW)
        shade_run(view, shading, planes, touched, bins_x, width, height, part, x1, y, out, differentials);
    x += VW > BIN ? VW : BIN;
  }
#endif
}
