// The light of single points, such as those that mirrors show: what kernels/render/light_bins.cl does for pixels.
// One work-item per SPAN points. Twin: tests/reference/light.py, material_light.
#define VW 1
#include "render/materials.clh"

#ifndef SPAN
#define SPAN 64
#endif
enum { PLACE = 0, NORMAL = 3, TO_EYE = 6, BASE_COLOR = 9, MATERIAL = 12, DARK_BITS, POINT_FLOATS = 16 };

__kernel void light_points(__global const float *view, __global const float *shading, __global const float *materials,
                           __global const float *sky, __global const float4 *texels, __global const float *points,
                           int count, __global float *out /* (count, 3) */) {
  int first = get_global_id(0) * SPAN;
  for (int i = 0; i < SPAN && first + i < count; i++) {
    __global const float *at = points + (size_t)(first + i) * POINT_FLOATS;
    Point p;
    VF light[3];
    p.X = at[PLACE]; p.Y = at[PLACE + 1]; p.Z = at[PLACE + 2];
    p.nx = at[NORMAL]; p.ny = at[NORMAL + 1]; p.nz = at[NORMAL + 2];
    p.ex = at[TO_EYE]; p.ey = at[TO_EYE + 1]; p.ez = at[TO_EYE + 2];
    for (int c = 0; c < 3; c++) { p.base[c] = at[BASE_COLOR + c]; p.open[c] = 1.0f; }
    p.open_ambient = 1.0f;
    p.dark = as_int(at[DARK_BITS]);
    material_light(view, shading, materials + (int)at[MATERIAL] * MATERIAL_FLOATS, sky, texels, &p, light);
    for (int c = 0; c < 3; c++) out[3 * (size_t)(first + i) + c] = light[c];
  }
}
