// Light the bins' planes where more than plain lamps decides: materials, the sky's light, and what rays have found of the
// lamps and directions that every point sees. The colour planes get the light, stored as LIT_COLORS says
// (kernels/common/planes.clh), so that the stage `shade` passes it on.
//
// One work-item per bin (VW = 1: per pixel). Twins: tests/reference/trace.py, light_bins; tests/reference/light.py.
#include "render/materials.clh"

#ifndef OCCLUSION
#define OCCLUSION 0  // directions of ambient occlusion, a multiple of 32; 0: none
#endif
#ifndef SHADOWS
#define SHADOWS 1
#endif
#ifndef MATERIALS
#define MATERIALS 1  // of the scene; more than one: the plane of surface numbers is there
#endif
enum { DIRECTION_X = 1, DIRECTION_Y, DIRECTION_Z, DIRECTION_R, DIRECTION_FLOATS = 8 };

#if OCCLUSION
// The part of the ambient light that reaches a point: the directions that it sees, weighed by their cosine; of the sky's
// light: weighed by what it sends from there, too.
INLINE void openness(__global const float *directions, __global const uint *hidden, int at, Point *p) {
  VF sum[4], open[4], none = 0.0f;
  for (int c = 0; c < 4; c++) { sum[c] = 0.0f; open[c] = 0.0f; }
  for (int word = 0; word < OCCLUSION / 32; word++) {
    VI bits = AS_VI(load_plane((__global const float *)hidden, word, at));
    for (int i = 0; i < 32; i++) {
      __global const float *d = directions + (word * 32 + i) * DIRECTION_FLOATS;
      VF weight = p->nx * d[DIRECTION_X] + p->ny * d[DIRECTION_Y] + p->nz * d[DIRECTION_Z];
      weight = VMAX(weight, none);
      VF seen = SEL(weight, none, (bits >> i & 1) != 0);
      sum[3] += weight;
      open[3] += seen;
#if SKY
      for (int c = 0; c < 3; c++) { sum[c] += weight * d[DIRECTION_R + c]; open[c] += seen * d[DIRECTION_R + c]; }
#endif
    }
  }
  p->open_ambient = open[3] / VMAX(sum[3], (VF)(1e-6f));
#if SKY
  // Where nothing comes from any of the directions, their share speaks.
  for (int c = 0; c < 3; c++) p->open[c] = SEL(open[c] / VMAX(sum[c], (VF)(1e-20f)), p->open_ambient, sum[c] < 1e-9f);
#endif
}
#endif

INLINE void light_block(__global const float *view, __global const float *shading, __global const uint *shadows,
                        __global const float *directions, __global const uint *hidden, __global const float *materials,
                        __global const float *material_of, __global const float *sky, __global const float4 *texels,
                        VI lane_x, VI lane_y, int bin_x, int bin_y, int at, __global float *planes) {
  VF t = load_plane(planes, FIELD_DEPTH, at);
  VI hit = t < EMPTY_DEPTH;
  Point p;
  p.base[0] = load_plane(planes, FIELD_COLOR, at);
  hit = hit & (AS_VI(p.base[0]) >= 0);  // not lit yet
  if (!any_lane(hit)) return;
  p.base[1] = load_plane(planes, FIELD_COLOR + 1, at);
  p.base[2] = load_plane(planes, FIELD_COLOR + 2, at);
  VF px = TO_VF(lane_x) + (bin_x * BIN + 0.5f), py = TO_VF(lane_y) + (bin_y * BIN + 0.5f);
  p.X = (px - view[CX]) * (1.0f / view[FX]); p.Y = (view[CY] - py) * (1.0f / view[FY]); p.Z = -t;
  p.ex = 0.0f; p.ey = 0.0f; p.ez = 1.0f;
  if (view[PERSPECTIVE] > 0.0f) {
    p.ez = 1.0f / VSQRT(1.0f + p.X * p.X + p.Y * p.Y);
    p.ex = -p.X * p.ez; p.ey = -p.Y * p.ez;
    p.X *= t; p.Y *= t;
  }
  p.nx = load_plane(planes, FIELD_NORMAL, at); p.ny = load_plane(planes, FIELD_NORMAL + 1, at);
  p.nz = load_plane(planes, FIELD_NORMAL + 2, at);
  VF inv = 1.0f / VSQRT(p.nx * p.nx + p.ny * p.ny + p.nz * p.nz + 1e-30f);
  p.nx *= inv; p.ny *= inv; p.nz *= inv;
  p.open_ambient = 1.0f;
  for (int c = 0; c < 3; c++) p.open[c] = 1.0f;
#if OCCLUSION
  openness(directions, hidden, at, &p);
#endif
  p.dark = 0;
#if SHADOWS
  p.dark = AS_VI(load_plane((__global const float *)shadows, 0, at));
#endif
  VF light[3];
#if MATERIALS > 1
  // The materials of a block, one after another.
  VI number = AS_VI(load_plane(planes, FIELD_ID, at)), left = hit;
  for (int i = 0; i < VW; i++)
    ((int *)&number)[i] = ((int *)&hit)[i] ? (int)material_of[((int *)&number)[i]] : -1;
  for (int i = 0; i < 3; i++) light[i] = 0.0f;
  for (int i = 0; i < VW; i++) {
    if (!((int *)&left)[i]) continue;
    int own = ((int *)&number)[i];
    VF mine[3];
    VI here = number == own;
    material_light(view, shading, materials + own * MATERIAL_FLOATS, sky, texels, &p, mine);
    for (int c = 0; c < 3; c++) light[c] = SEL(light[c], mine[c], here);
    left = left & NOT(here);
  }
#else
  material_light(view, shading, materials, sky, texels, &p, light);
#endif
  for (int c = 0; c < 3; c++) {
    VF lit = VMAX(light[c], (VF)(0.0f));  // the sign is the mark of what is lit
    merge_plane(planes, FIELD_COLOR + c, at, -lit, hit);
  }
}

// `shadows`: a word of lamps' bits per pixel of a bin; `hidden`: OCCLUSION / 32 words of bits of `directions`, rows of 8
// floats; `material_of`: the material of each surface; `texels`: what `sky` and materials refer to.
__kernel void light_bins(__global const float *view, __global const float *shading, __global const uint *shadows,
                         __global const float *directions, __global const uint *hidden, __global const float *materials,
                         __global const float *material_of, __global const float *sky, __global const float4 *texels,
                         int bins_x, int bins, __global const int *touched, __global float *all_planes) {
#if VW == 1
  int bin = get_global_id(0) / BIN_PIXELS, pixel = get_global_id(0) % BIN_PIXELS;
  if (bin >= bins || touched[bin] < 0) return;
  light_block(view, shading, shadows + (size_t)bin * BIN_PIXELS, directions,
              hidden + (size_t)bin * BIN_PIXELS * (OCCLUSION / 32), materials, material_of, sky, texels, pixel % BIN,
              pixel / BIN, bin % bins_x, bin / bins_x, pixel, all_planes + (size_t)bin * BIN_PIXELS * FIELDS);
#else
  int bin = get_global_id(0);
  if (bin >= bins || touched[bin] < 0) return;
  for (int b = 0; b < BIN_PIXELS / VW; b++) {
    int quarter = b / (16 / VW), part = b % (16 / VW), x = (quarter & 1) * 4, y = (quarter >> 1) * 4 + part * (VW / 4);
    light_block(view, shading, shadows + (size_t)bin * BIN_PIXELS, directions,
                hidden + (size_t)bin * BIN_PIXELS * (OCCLUSION / 32), materials, material_of, sky, texels,
                (LANE_INDEX & 3) + x, (LANE_INDEX >> 2) + y, bin % bins_x, bin / bins_x, y * BIN + x,
                all_planes + (size_t)bin * BIN_PIXELS * FIELDS);
  }
#endif
}
