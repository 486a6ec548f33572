// Which neighbouring pixels show one continuous surface: a plane of bits (HIT, LINK_RIGHT, LINK_DOWN).
//
// Two pixels are linked unless their depths differ by more than their slopes explain: by LIMIT footprints and SLACK
// times the mean slope. A plain limit on the difference would cut smooth surfaces that turn away from the eye. One
// work-item per VW pixels of the padded planes. Twin: tests/reference/lines.py.
#include "analysis/line_planes.clh"
#ifndef LIMIT
#define LIMIT 6.0f
#endif
#ifndef SLACK
#define SLACK 0.75f
#endif

INLINE VI linked(VF here, VF there, VF slope_here, VF slope_there, float step, int perspective) {
  VF footprint = perspective ? VMIN(here, there) * step : (VF)(step);
  VF mean = 0.5f * (slope_here + slope_there);
  VF rest = (there - here) / footprint - mean;
  return ABS(rest) <= LIMIT + SLACK * ABS(mean);  // false where either is NaN
}

__kernel void line_links(int height, int stride, __global const float *camera, __global const float *depths,
                         __global const float *slope_x, __global const float *slope_y, __global int *links) {
  int x = get_global_id(0) * VW - MARGIN_X, y = get_global_id(1) - MARGIN_Y;
  if (x >= stride - MARGIN_X || y >= height + MARGIN_Y) return;
  size_t at = PLANE_AT(x, y);
  VF here = LOAD(depths + at);
  VI hit = here == here;
  if (!any_lane(hit)) { STORE_INT(links + at, (VI)(0)); return; }
  // Hits lie inside the margins, so the pixels on the right and below are in the planes.
  float fx = sqrt(camera[GX] * camera[GX] + camera[GX + 1] * camera[GX + 1] + camera[GX + 2] * camera[GX + 2]);
  float fy = sqrt(camera[GY] * camera[GY] + camera[GY + 1] * camera[GY + 1] + camera[GY + 2] * camera[GY + 2]);
  int perspective = camera[IN_PERSPECTIVE] > 0.0f;
  VI right = linked(here, LOAD(depths + at + 1), LOAD(slope_x + at), LOAD(slope_x + at + 1), fx, perspective);
  VI down = linked(here, LOAD(depths + at + stride), LOAD(slope_y + at), LOAD(slope_y + at + stride), fy, perspective);
  STORE_INT(links + at, SEL((VI)(0), (VI)(HIT), hit) | SEL((VI)(0), (VI)(LINK_RIGHT), right)
                        | SEL((VI)(0), (VI)(LINK_DOWN), down));
}
