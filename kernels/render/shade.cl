// Shade the bins' planes and write the channels of the picture; bins that nothing touched get the background.
//
// Blinn-Phong in view space, linear light. One work-item per run of SPAN pixels in a row of bins (VW = 1: SPAN = 1, one
// pixel). Twin: tests/reference/render.py, shade.
#include "common/view.clh"
#include "common/planes.clh"

#ifndef SPAN
#define SPAN 128
#endif
#ifndef WRITE_COLOR
#define WRITE_COLOR 1
#define WRITE_DEPTH 1
#define WRITE_NORMAL 1
#define WRITE_POSITION 0
#define WRITE_COST 0
#endif
#ifndef LIT
#define LIT 1
#endif

// The shading buffer, floats; written by clsurf.render.shade.
enum { BASE = 0, AMBIENT = 3, DIFFUSE, SPECULAR, SHININESS, BACKGROUND = 8, LIGHT_COUNT = 12, LIGHTS = 16 };
enum { LIGHT_KIND, LIGHT_X, LIGHT_Y, LIGHT_Z, LIGHT_R, LIGHT_G, LIGHT_B, LIGHT_FLOATS = 8 };
enum { HEADLIGHT, DIRECTIONAL, POINT };

#define NONE as_float(0x7fc00000)

// Fill `count` floats with one value.
inline void fill(__global float *out, int count, float value) {
  int i = 0;
  float4 four = value;
  for (; i < count && ((size_t)(out + i) & 15); i++) out[i] = value;
  for (; i + 4 <= count; i += 4) STREAM((__global float4 *)(out + i), four);
  for (; i < count; i++) out[i] = value;
}

// x^n for a whole n; native_powr is a call per lane on PoCL.
inline VF whole_power(VF x, int n) {
  VF y = 1.0f;
  for (; n; n >>= 1, x *= x)
    if (n & 1) y *= x;
  return y;
}

// Light of one pixel's surface: `reflected` multiplies the base colour, `gloss` is added. p, n, eye in view space.
inline void light(__global const float *shading, VF X, VF Y, VF Z, VF nx, VF ny, VF nz, VF ex, VF ey, VF ez,
                  VF *reflected, VF *gloss) {
  int count = (int)shading[LIGHT_COUNT];
  for (int c = 0; c < 3; c++) { reflected[c] = shading[AMBIENT]; gloss[c] = 0.0f; }
  for (int i = 0; i < count; i++) {
    __global const float *lamp = shading + LIGHTS + i * LIGHT_FLOATS;
    int kind = (int)lamp[LIGHT_KIND];
    VF lx = ex, ly = ey, lz = ez;
    if (kind == DIRECTIONAL) { lx = lamp[LIGHT_X]; ly = lamp[LIGHT_Y]; lz = lamp[LIGHT_Z]; }
    if (kind == POINT) {
      lx = lamp[LIGHT_X] - X; ly = lamp[LIGHT_Y] - Y; lz = lamp[LIGHT_Z] - Z;
      VF inv = 1.0f / VSQRT(lx * lx + ly * ly + lz * lz + 1e-30f);
      lx *= inv; ly *= inv; lz *= inv;
    }
    VF toward = nx * lx + ny * ly + nz * lz;
    VI lit = toward > 0.0f;
    VF hx = lx + ex, hy = ly + ey, hz = lz + ez;
    VF h2 = hx * hx + hy * hy + hz * hz + 1e-30f;
    VF shine = (nx * hx + ny * hy + nz * hz) / VSQRT(h2);
    shine = whole_power(VMAX(shine, (VF)(0.0f)), (int)shading[SHININESS]) * shading[SPECULAR];
    toward *= shading[DIFFUSE];
    for (int c = 0; c < 3; c++) {
      reflected[c] += SEL((VF)(0.0f), toward * lamp[LIGHT_R + c], lit);
      gloss[c] += SEL((VF)(0.0f), shine * lamp[LIGHT_R + c], lit);
    }
  }
}

// A field of VW pixels in one row that starts at pixel (x, y); bins that nothing touched give `none`.
inline VF load_row(__global const float *planes, __global const int *touched, int bins_x, int x, int y, int field,
                   float none) {
  VF value = none;
  for (int i = 0; i < VW; i += (VW < BIN ? VW : BIN)) {
    int bin_x = (x + i) / BIN, bin = y / BIN * bins_x + bin_x;
    if (bin_x >= bins_x || touched[bin] < 0) continue;
    __global const float *row = planes + ((size_t)bin * FIELDS + field) * BIN_PIXELS + y % BIN * BIN + (x + i) % BIN;
    for (int j = 0; j < (VW < BIN ? VW : BIN); j++) ((float *)&value)[i + j] = row[j];
  }
  return value;
}

inline void shade_run(__global const float *view, __global const float *shading, __global const float *planes,
                      __global const int *touched, int bins_x, int width, int x, int x_end, int y,
                      __global float4 *color, __global float *depth, __global float *normal, __global float *position,
                      __global int *id, __global int *count, __global int *level, __global int *cost) {
  int lanes = x_end - x < VW ? x_end - x : VW;
  size_t at = (size_t)y * width + x;
  VF t = load_row(planes, touched, bins_x, x, y, FIELD_DEPTH, EMPTY_DEPTH), none = NONE;
  VI hit = t < EMPTY_DEPTH;
#if WRITE_DEPTH
  VF shown = SEL(none, t, hit);
  for (int i = 0; i < lanes; i++) depth[at + i] = ((float *)&shown)[i];
#endif
#define WRITE_INT(field, out) { VF v = load_row(planes, touched, bins_x, x, y, field, 0.0f); \
    VI w = SEL((VI)(-1), AS_VI(v), hit); for (int i = 0; i < lanes; i++) out[at + i] = ((int *)&w)[i]; }
#if FIELD_ID >= 0
  WRITE_INT(FIELD_ID, id)
#endif
#if FIELD_COUNT >= 0
  WRITE_INT(FIELD_COUNT, count)
#endif
#if FIELD_LEVEL >= 0
  WRITE_INT(FIELD_LEVEL, level)
#endif
#if WRITE_COST
  for (int i = 0; i < lanes; i++) {
    int c = touched[y / BIN * bins_x + (x + i) / BIN];
    cost[at + i] = c < 0 ? 0 : c;
  }
#endif
#if WRITE_COLOR || WRITE_NORMAL || WRITE_POSITION
  VF px = TO_VF((VI)(x) + LANE_INDEX) + 0.5f;
  VF across = (px - view[CX]) * (1.0f / view[FX]), up = (view[CY] - (y + 0.5f)) / view[FY];
  VF X = across, Y = up, Z = -t, ex = 0.0f, ey = 0.0f, ez = 1.0f;  // position; unit direction to the eye
  if (view[PERSPECTIVE] > 0.0f) {
    X *= t; Y *= t;
    ez = 1.0f / VSQRT(1.0f + across * across + up * up);
    ex = -across * ez; ey = -up * ez;
  }
#endif
#if WRITE_POSITION
  // view[ROTATION] is world to view here and view[OFFSET] the eye relative to the frame's origin.
  for (int c = 0; c < 3; c++) {
    VF p = view[c] * X + view[3 + c] * Y + view[6 + c] * Z + view[OFFSET + c];
    p = SEL(none, p, hit);
    for (int i = 0; i < lanes; i++) position[3 * (at + i) + c] = ((float *)&p)[i];
  }
#endif
#if WRITE_COLOR || WRITE_NORMAL
  VF nx = load_row(planes, touched, bins_x, x, y, FIELD_NORMAL, 0.0f);
  VF ny = load_row(planes, touched, bins_x, x, y, FIELD_NORMAL + 1, 0.0f);
  VF nz = load_row(planes, touched, bins_x, x, y, FIELD_NORMAL + 2, 1.0f);
  VF inv = 1.0f / VSQRT(nx * nx + ny * ny + nz * nz + 1e-30f);
  nx *= inv; ny *= inv; nz *= inv;
#endif
#if WRITE_NORMAL
  for (int c = 0; c < 3; c++) {
    VF n = view[c] * nx + view[3 + c] * ny + view[6 + c] * nz;
    n = SEL(none, n, hit);
    for (int i = 0; i < lanes; i++) normal[3 * (at + i) + c] = ((float *)&n)[i];
  }
#endif
#if WRITE_COLOR
  VF rgb[3];
  for (int c = 0; c < 3; c++) {
#if FIELD_COLOR >= 0
    rgb[c] = load_row(planes, touched, bins_x, x, y, FIELD_COLOR + c, 0.0f);
#else
    rgb[c] = shading[BASE + c];
#endif
  }
#if LIT
  VF reflected[3], gloss[3];
  light(shading, X, Y, Z, nx, ny, nz, ex, ey, ez, reflected, gloss);
  for (int c = 0; c < 3; c++) rgb[c] = rgb[c] * reflected[c] + gloss[c];
#endif
  for (int c = 0; c < 3; c++) rgb[c] = SEL((VF)(shading[BACKGROUND + c]), rgb[c], hit);
  VF alpha = SEL((VF)(shading[BACKGROUND + 3]), (VF)(1.0f), hit);
  for (int i = 0; i < lanes; i++)
    STREAM(color + at + i, (float4)(((float *)&rgb[0])[i], ((float *)&rgb[1])[i], ((float *)&rgb[2])[i],
                                    ((float *)&alpha)[i]));
#endif
}

// Rows of `pixels` pixels that nothing touched.
inline void background_run(__global const float *shading, int width, int x, int y, int pixels,
                           __global float4 *color, __global float *depth, __global float *normal,
                           __global float *position, __global int *id, __global int *count, __global int *level,
                           __global int *cost) {
  size_t at = (size_t)y * width + x;
#if WRITE_COLOR
  float4 back = (float4)(shading[BACKGROUND], shading[BACKGROUND + 1], shading[BACKGROUND + 2], shading[BACKGROUND + 3]);
  for (int i = 0; i < pixels; i++) STREAM(color + at + i, back);
#endif
#if WRITE_DEPTH
  fill(depth + at, pixels, NONE);
#endif
#if WRITE_NORMAL
  fill(normal + 3 * at, 3 * pixels, NONE);
#endif
#if WRITE_POSITION
  fill(position + 3 * at, 3 * pixels, NONE);
#endif
#if FIELD_ID >= 0
  for (int i = 0; i < pixels; i++) id[at + i] = -1;
#endif
#if FIELD_COUNT >= 0
  for (int i = 0; i < pixels; i++) count[at + i] = -1;
#endif
#if FIELD_LEVEL >= 0
  for (int i = 0; i < pixels; i++) level[at + i] = -1;
#endif
#if WRITE_COST
  for (int i = 0; i < pixels; i++) cost[at + i] = 0;
#endif
}

__kernel void shade(__global const float *view, __global const float *shading, __global const float *planes,
                    __global const int *touched, int bins_x, int width, int height,
                    __global float4 *color, __global float *depth, __global float *normal, __global float *position,
                    __global int *id, __global int *count, __global int *level, __global int *cost) {
#define OUTPUTS color, depth, normal, position, id, count, level, cost
#if VW == 1
  int x = get_global_id(0), y = get_global_id(1);
  if (x >= width || y >= height) return;
  if (touched[y / BIN * bins_x + x / BIN] < 0) background_run(shading, width, x, y, 1, OUTPUTS);
  else shade_run(view, shading, planes, touched, bins_x, width, x, x + 1, y, OUTPUTS);
#else
  int x0 = get_global_id(0) * SPAN, y0 = get_global_id(1) * BIN;
  if (x0 >= width || y0 >= height) return;
  int x1 = x0 + SPAN < width ? x0 + SPAN : width, y1 = y0 + BIN < height ? y0 + BIN : height;
  __global const int *row = touched + y0 / BIN * bins_x;
  for (int x = x0; x < x1;) {
    int run = x;  // untouched bins from x on
    while (run < x1 && row[run / BIN] < 0) run = (run / BIN + 1) * BIN;
    run = run < x1 ? run : x1;
    for (int y = y0; y < y1 && run > x; y++) background_run(shading, width, x, y, run - x, OUTPUTS);
    x = run;
    if (x >= x1) return;
    // Lanes of 16 cover two bins; the second one may be untouched.
    for (int y = y0; y < y1; y++)
      for (int part = x; part < x + (VW > BIN ? VW : BIN) && part < x1; part += VW)
        shade_run(view, shading, planes, touched, bins_x, width, part, x1, y, OUTPUTS);
    x += VW > BIN ? VW : BIN;
  }
#endif
}
