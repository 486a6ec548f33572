// Eye-dome lighting: pixels that are final already (their red is stored negative) are darkened by how much nearer their
// neighbours are. Boucheny, "Visualisation scientifique de grands volumes de donnees", thesis, Grenoble 2009, chapter 4.
//
// One work-item per bin (VW = 1: per pixel). Twin: tests/reference/render_points.py, eye_dome.
#include "common/planes.clh"

#if VW > 1
typedef float4 __attribute__((aligned(4))) FourAt;
#endif

INLINE VF depths_at(__global const float *depths, int pitch, int x, int y) {
#if VW == 1
  return depths[(size_t)y * pitch + x];
#else
  VF out;
  for (int r = 0; r < VW / 4; r++) ((float4 *)&out)[r] = *(__global const FourAt *)(depths + (size_t)(y + r) * pitch + x);
  return out;
#endif
}

INLINE void darken(__global const float *depths, int pitch, int rim, __global const int2 *steps, int count,
                   float strength, float reference, int x, int y, int at, __global float *planes) {
  VF red = load_plane(planes, FIELD_COLOR, at), z = load_plane(planes, FIELD_DEPTH, at), sum = 0.0f, none = 0.0f;
  VI chosen = (AS_VI(red) < 0) & (z < EMPTY_DEPTH);
  if (!any_lane(chosen)) return;
  for (int i = 0; i < count; i++) {
    VF nearer = z - depths_at(depths, pitch, x + rim + steps[i].x, y + rim + steps[i].y);
    sum += SEL(none, nearer, (nearer > none) & chosen);
  }
  VF scale = reference;
  if (reference == 0.0f) scale = SEL((VF)(1.0f), z, chosen);
  VF dark = strength * sum / (scale * (float)count);
  dark = VMIN(dark, (VF)(80.0f));
  VF kept = native_exp(-dark);
  merge_plane(planes, FIELD_COLOR, at, red * kept, chosen);
  merge_plane(planes, FIELD_COLOR + 1, at, load_plane(planes, FIELD_COLOR + 1, at) * kept, chosen);
  merge_plane(planes, FIELD_COLOR + 2, at, load_plane(planes, FIELD_COLOR + 2, at) * kept, chosen);
}

// `steps`: offsets of the neighbours, pixels, at most `rim` each way. `reference`: depth that differences are measured by,
// 0: the pixel's own.
__kernel void eye_dome(__global const float *depths, int pitch, int rim, __global const int2 *steps, int count,
                       float strength, float reference, int bins_x, int bins, __global const int *touched,
                       __global float *all_planes) {
#if VW == 1
  int bin = get_global_id(0) / BIN_PIXELS, pixel = get_global_id(0) % BIN_PIXELS;
  if (bin >= bins || touched[bin] < 0) return;
  darken(depths, pitch, rim, steps, count, strength, reference, bin % bins_x * BIN + pixel % BIN,
         bin / bins_x * BIN + pixel / BIN, pixel, all_planes + (size_t)bin * BIN_PIXELS * FIELDS);
#else
  int bin = get_global_id(0);
  if (bin >= bins || touched[bin] < 0) return;
  for (int b = 0; b < BIN_PIXELS / VW; b++) {
    int quarter = b / (16 / VW), part = b % (16 / VW), x = (quarter & 1) * 4, y = (quarter >> 1) * 4 + part * (VW / 4);
    darken(depths, pitch, rim, steps, count, strength, reference, bin % bins_x * BIN + x, bin / bins_x * BIN + y,
           y * BIN + x, all_planes + (size_t)bin * BIN_PIXELS * FIELDS);
  }
#endif
}
