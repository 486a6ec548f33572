// Light the bins' planes where rays have found which lamps every point sees: the colour planes get the light, stored as
// LIT_COLORS says (kernels/common/planes.clh), so that the stage `shade` passes it on.
//
// One work-item per bin (VW = 1: per pixel). Twin: tests/reference/trace.py, light_bins.
#include "render/shade.clh"

#ifndef OCCLUSION
#define OCCLUSION 0  // directions of ambient occlusion, a multiple of 32; 0: none
#endif
#ifndef SHADOWS
#define SHADOWS 1
#endif

// The part of the ambient light that reaches a point: the directions that it sees, weighed by their cosine.
INLINE VF openness(__global const float *directions, __global const uint *hidden, int at, VF nx, VF ny, VF nz) {
  VF sum = 0.0f, open = 0.0f, none = 0.0f;
  for (int word = 0; word < OCCLUSION / 32; word++) {
    VI bits = AS_VI(load_plane((__global const float *)hidden, word, at));
    for (int i = 0; i < 32; i++) {
      __global const float *d = directions + (word * 32 + i) * LIGHT_FLOATS;
      VF weight = nx * d[LIGHT_X] + ny * d[LIGHT_Y] + nz * d[LIGHT_Z];
      weight = VMAX(weight, none);
      sum += weight;
      open += SEL(weight, none, (bits >> i & 1) != 0);
    }
  }
  return open / VMAX(sum, (VF)(1e-6f));
}

INLINE void light_block(__global const float *view, __global const float *shading, __global const uint *shadows,
                        __global const float *directions, __global const uint *hidden, VI lane_x, VI lane_y, int bin_x,
                        int bin_y, int at, __global float *planes) {
  VF t = load_plane(planes, FIELD_DEPTH, at);
  VI hit = t < EMPTY_DEPTH;
  VF red = load_plane(planes, FIELD_COLOR, at);
  hit = hit & (AS_VI(red) >= 0);  // not lit yet
  if (!any_lane(hit)) return;
  VF px = TO_VF(lane_x) + (bin_x * BIN + 0.5f), py = TO_VF(lane_y) + (bin_y * BIN + 0.5f);
  VF across = (px - view[CX]) * (1.0f / view[FX]), up = (view[CY] - py) * (1.0f / view[FY]);
  VF X = across, Y = up, Z = -t, ex = 0.0f, ey = 0.0f, ez = 1.0f;  // position; unit direction to the eye
  if (view[PERSPECTIVE] > 0.0f) {
    X *= t; Y *= t;
    ez = 1.0f / VSQRT(1.0f + across * across + up * up);
    ex = -across * ez; ey = -up * ez;
  }
  VF nx = load_plane(planes, FIELD_NORMAL, at), ny = load_plane(planes, FIELD_NORMAL + 1, at);
  VF nz = load_plane(planes, FIELD_NORMAL + 2, at);
  VF inv = 1.0f / VSQRT(nx * nx + ny * ny + nz * nz + 1e-30f);
  nx *= inv; ny *= inv; nz *= inv;
  VF ambient = shading[AMBIENT], zero = 0.0f, reflected[3], gloss[3];
#if OCCLUSION
  ambient *= openness(directions, hidden, at, nx, ny, nz);
#endif
  for (int c = 0; c < 3; c++) { reflected[c] = ambient; gloss[c] = zero; }
#if SHADOWS
  VI dark = AS_VI(load_plane((__global const float *)shadows, 0, at));
#endif
  int count = (int)shading[LIGHT_COUNT];
  for (int i = 0; i < count; i++) {
    __global const float *lamp = shading + LIGHTS + i * LIGHT_FLOATS;
    VF r[3] = {zero, zero, zero}, g[3] = {zero, zero, zero};
    add_lamp(shading, lamp, lamp[LIGHT_X], lamp[LIGHT_Y], lamp[LIGHT_Z], X, Y, Z, nx, ny, nz, ex, ey, ez, r, g);
    VI unseen = 0;
#if SHADOWS
    unseen = (dark >> i & 1) != 0;
#endif
    for (int c = 0; c < 3; c++) { reflected[c] += SEL(r[c], zero, unseen); gloss[c] += SEL(g[c], zero, unseen); }
  }
  for (int c = 0; c < 3; c++) {
    VF base = c ? load_plane(planes, FIELD_COLOR + c, at) : red;
    merge_plane(planes, FIELD_COLOR + c, at, -(base * reflected[c] + gloss[c]), hit);
  }
}

// `shadows`: a word of lamps' bits per pixel of a bin; `hidden`: OCCLUSION / 32 words of bits of `directions`.
__kernel void light_bins(__global const float *view, __global const float *shading, __global const uint *shadows,
                         __global const float *directions, __global const uint *hidden, int bins_x, int bins,
                         __global const int *touched, __global float *all_planes) {
#if VW == 1
  int bin = get_global_id(0) / BIN_PIXELS, pixel = get_global_id(0) % BIN_PIXELS;
  if (bin >= bins || touched[bin] < 0) return;
  light_block(view, shading, shadows + (size_t)bin * BIN_PIXELS, directions,
              hidden + (size_t)bin * BIN_PIXELS * (OCCLUSION / 32), pixel % BIN, pixel / BIN, bin % bins_x, bin / bins_x,
              pixel, all_planes + (size_t)bin * BIN_PIXELS * FIELDS);
#else
  int bin = get_global_id(0);
  if (bin >= bins || touched[bin] < 0) return;
  for (int b = 0; b < BIN_PIXELS / VW; b++) {
    int quarter = b / (16 / VW), part = b % (16 / VW), x = (quarter & 1) * 4, y = (quarter >> 1) * 4 + part * (VW / 4);
    light_block(view, shading, shadows + (size_t)bin * BIN_PIXELS, directions,
                hidden + (size_t)bin * BIN_PIXELS * (OCCLUSION / 32), (LANE_INDEX & 3) + x, (LANE_INDEX >> 2) + y,
                bin % bins_x, bin / bins_x, y * BIN + x, all_planes + (size_t)bin * BIN_PIXELS * FIELDS);
  }
#endif
}
