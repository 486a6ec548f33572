// What packets left in the planes of a picture's bins, as the hits of single rays, row by row (ray_walk.clh); a
// work-item a pixel. `order`: primitive of each slot; `inverse_unit`: frame units of one unit of the model.
#define VW 1
#include "common/planes.clh"
#include "common/view.clh"

__kernel void grid_hits(int count, int width, int bins_x, __global const float *view, __global const int *touched,
                        __global const float *all_planes, __global const int *order, float inverse_unit,
                        __global float *hits) {
  int i = get_global_id(0);
  if (i >= count) return;
  int x = i % width, y = i / width, bin = y / BIN * bins_x + x / BIN;
  __global const float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS + y % BIN * BIN + x % BIN;
  __global float *out = hits + (size_t)i * 8;
  float depth = touched[bin] >= 0 ? planes[FIELD_DEPTH * BIN_PIXELS] : INFINITY;
  for (int k = 0; k < 8; k++) out[k] = 0.0f;
  out[0] = INFINITY;
  out[4] = as_float(-1);
  if (!(depth < EMPTY_DEPTH)) return;
  float right = (x + 0.5f - view[CX]) / view[FX], up = (view[CY] - (y + 0.5f)) / view[FY];
  float slant = view[PERSPECTIVE] > 0.0f ? sqrt(1.0f + right * right + up * up) : 1.0f;
  out[0] = depth * slant / view[SCALE] * inverse_unit;
  for (int a = 0; a < 3; a++)
    for (int k = 0; k < 3; k++)
      out[1 + a] += view[ROTATION + 3 * k + a] * planes[(FIELD_NORMAL + k) * BIN_PIXELS];
  out[4] = as_float(order[as_int(planes[FIELD_SLOT * BIN_PIXELS])]);
}
