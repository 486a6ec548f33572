// The geometry of a picture for feature lines: planes of depth (NaN: nothing hit), of the depth's slopes to the right
// and downwards as the normals tell them (in pixel footprints a pixel, so that 1 is 45 degrees), and of the squared
// sine between normal and ray. One work-item per VW pixels of the padded planes. Twin: tests/reference/lines.py.
#include "analysis/line_planes.clh"
#define STEEPEST 100.0f

__kernel void line_slopes(int width, int height, int stride, __global const float *camera, __global const float *depth,
                          __global const float *normal, __global float *depths, __global float *slope_x,
                          __global float *slope_y, __global float *sine2) {
  int x = get_global_id(0) * VW - MARGIN_X, y = get_global_id(1) - MARGIN_Y;
  if (x >= stride - MARGIN_X || y >= height + MARGIN_Y) return;
  size_t to = PLANE_AT(x, y);
  int lanes = x < 0 || y < 0 || y >= height ? 0 : width - x < VW ? width - x : VW;
  size_t at = (size_t)y * width + x;
  VF z = (VF)(NAN);
  if (lanes > 0) z = load_channel(depth, at, lanes);
  STORE(depths + to, z);
  if (!any_lane(z == z)) return;  // the other planes are only read where there is a depth
  VF px = TO_VF(x + LANE_INDEX), g[3], n[3];
  load_vectors(normal, at, lanes, n);
  for (int c = 0; c < 3; c++) {
    VF ray = camera[G0 + c] + px * camera[GX + c] + (float)y * camera[GY + c];
    g[c] = camera[IN_PERSPECTIVE] > 0.0f ? ray : (VF)(camera[FORWARD + c]);
  }
  VF along = n[0] * g[0] + n[1] * g[1] + n[2] * g[2], g2 = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
  VF facing = SEL((VF)(-1e-4f), along, along < -1e-4f);
  VF rx = n[0] * camera[GX] + n[1] * camera[GX + 1] + n[2] * camera[GX + 2];
  VF ry = n[0] * camera[GY] + n[1] * camera[GY + 1] + n[2] * camera[GY + 2];
  float fx = camera[GX] * camera[GX] + camera[GX + 1] * camera[GX + 1] + camera[GX + 2] * camera[GX + 2];
  float fy = camera[GY] * camera[GY] + camera[GY + 1] * camera[GY + 1] + camera[GY + 2] * camera[GY + 2];
  VF sx = -rx / (facing * sqrt(fx)), sy = -ry / (facing * sqrt(fy));
  sx = VMIN(VMAX(sx, (VF)(-STEEPEST)), (VF)(STEEPEST));
  sy = VMIN(VMAX(sy, (VF)(-STEEPEST)), (VF)(STEEPEST));
  STORE(slope_x + to, sx);
  STORE(slope_y + to, sy);
  // |n x g|: 1 - cos^2 would be rounding where the eye looks along the normal.
  VF cx = n[1] * g[2] - n[2] * g[1], cy = n[2] * g[0] - n[0] * g[2], cz = n[0] * g[1] - n[1] * g[0];
  STORE(sine2 + to, (cx * cx + cy * cy + cz * cz) / g2);
}
