// Single rays from the points of a picture to one lamp, in the frame of a surface that may hide it: a work-item a point.
// Rays start `step` up the normal and look behind another `step`, so that the surface's own points are no obstacles.
// Points that face away from the lamp, or do not see it already, get rays that miss. What the rays hit: lamp_bits.cl.
// Twin: tests/reference/trace.py, lamp_rays.
#define VW 1
#include "common/planes.clh"
#include "common/view.clh"

enum { LIGHT_KIND, LIGHT_X, LIGHT_Y, LIGHT_Z, LIGHT_FLOATS = 8 };
enum { HEADLIGHT, DIRECTIONAL, POINT };

// `pixels`: bin * 64 + pixel, from `first` on; `place`: 13 floats, view space to the frame, row by row, and the world
// length of one unit of the frame; `mask`: see trace_lights.cl; `rays`: ray_walk.clh.
__kernel void lamp_rays(int count, int first, __global const int *pixels, __global const float *view,
                        __global const float *place, __global const float *lamps, int lamp, float step, float reach,
                        int bins_x, __global const float *all_planes, __global const uint *mask, int mask_stride,
                        int mask_offset, __global float *rays) {
  int i = get_global_id(0);
  if (i >= count) return;
  int bin = pixels[first + i] / BIN_PIXELS, pixel = pixels[first + i] % BIN_PIXELS;
  __global const float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS + pixel;
  lamps += lamp * LIGHT_FLOATS;
  float depth = planes[FIELD_DEPTH * BIN_PIXELS], across = view[PERSPECTIVE] > 0.0f ? depth : 1.0f;
  float X = (bin % bins_x * BIN + pixel % BIN + 0.5f - view[CX]) / view[FX] * across;
  float Y = (view[CY] - (bin / bins_x * BIN + pixel / BIN + 0.5f)) / view[FY] * across, Z = -depth;
  float nx = planes[FIELD_NORMAL * BIN_PIXELS], ny = planes[(FIELD_NORMAL + 1) * BIN_PIXELS];
  float nz = planes[(FIELD_NORMAL + 2) * BIN_PIXELS], inv = 1.0f / sqrt(nx * nx + ny * ny + nz * nz + 1e-30f);
  X += step * inv * nx; Y += step * inv * ny; Z += step * inv * nz;
  float x = lamps[LIGHT_X], y = lamps[LIGHT_Y], z = lamps[LIGHT_Z], far = reach;
  if ((int)lamps[LIGHT_KIND] == POINT) { x -= X; y -= Y; z -= Z; }
  float length = sqrt(x * x + y * y + z * z);
  if ((int)lamps[LIGHT_KIND] == POINT) far = length < far ? length : far;
  int want = x * nx + y * ny + z * nz > 0.0f
           && !(mask[(size_t)bin * mask_stride + mask_offset + pixel] >> lamp & 1u);
  float unit = place[12], turn = unit / length;
  __global float *ray = rays + (size_t)i * 8;
  for (int a = 0; a < 3; a++) {
    __global const float *row = place + 4 * a;
    ray[a] = row[0] * X + row[1] * Y + row[2] * Z + row[3];
    ray[4 + a] = (row[0] * x + row[1] * y + row[2] * z) * turn;
  }
  ray[3] = step / unit;
  ray[7] = want ? (far < 1e30f ? far : 1e30f) / unit : -1.0f;  // walks end behind a number
}
