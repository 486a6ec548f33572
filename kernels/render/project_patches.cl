// The linear forms that project the nodes of every patch, and the pixels that it may touch. One work-item per patch.
// Twin: tests/reference/render_patches.py, project_patches.
//
// The rectangle (first x, first y, last x, last y; first > last: not in the picture) is that of the eight corners of the
// box around the patch's displacements; a patch that reaches the near plane gets the whole picture.
#include "common/patch.clh"

inline void turned(__global const float *view, __global const float *v, float *out) {
  for (int r = 0; r < 3; r++) out[r] = view[3 * r] * v[0] + view[3 * r + 1] * v[1] + view[3 * r + 2] * v[2];
}

__kernel void project_patches(__global const float *view, __global const float *frames, __global const int *sizes,
                              int count, __global float *records, __global int4 *rectangles) {
  int k = get_global_id(0);
  if (k >= count) return;
  __global const float *f = frames + (size_t)k * FRAME_FLOATS;
  __global float *h = records + (size_t)k * PATCH_FLOATS;
  int perspective = view[PERSPECTIVE] > 0.0f;
  float scale = view[SCALE], v[3];
  for (int part = 0; part < 4; part++) {
    turned(view, f + 3 * part, v);
    for (int r = 0; r < 3; r++) v[r] = scale * v[r] + (part ? 0.0f : view[OFFSET + r]);
    float z = -v[2], w = perspective ? z : part ? 0.0f : 1.0f;
    h[HX + part] = view[FX] * v[0] + view[CX] * w;
    h[HY + part] = -view[FY] * v[1] + view[CY] * w;
    h[HZ + part] = z;
  }
  // Normal of slopes g: a_z / |a_z|^2 - g_x a_x / |a_x|^2 - g_y a_y / |a_y|^2, times |a_z|.
  float z2 = 0.0f, x2 = 0.0f, y2 = 0.0f;
  for (int r = 0; r < 3; r++) {
    z2 += f[AXIS_Z + r] * f[AXIS_Z + r]; x2 += f[AXIS_X + r] * f[AXIS_X + r]; y2 += f[AXIS_Y + r] * f[AXIS_Y + r];
  }
  float z_length = sqrt(z2), share[3] = {1.0f / z_length, z_length / x2, z_length / y2};
  for (int part = 0; part < 3; part++) {
    turned(view, f + (part ? 3 * part : AXIS_Z), v);
    h[NX + part] = v[0] * share[part]; h[NY + part] = v[1] * share[part]; h[NZ + part] = v[2] * share[part];
  }
  float low = f[LOW_STEP], high = f[HIGH_STEP], near = view[NEAR];
  float x0 = INFINITY, y0 = INFINITY, x1 = -INFINITY, y1 = -INFINITY, front = INFINITY, back = -INFINITY;
  for (int corner = 0; corner < 8; corner++) {
    Node p = node_at(h, perspective, corner & 1 ? sizes[2 * k] - 1 : 0, corner & 2 ? sizes[2 * k + 1] - 1 : 0,
                     corner & 4 ? high : low);
    front = fmin(front, p.z); back = fmax(back, p.z);
    x0 = fmin(x0, p.x / p.w); x1 = fmax(x1, p.x / p.w); y0 = fmin(y0, p.y / p.w); y1 = fmax(y1, p.y / p.w);
  }
  if (front <= near || (perspective && front <= 1e-4f * back)) { x0 = y0 = -1e9f; x1 = y1 = 1e9f; }
  // 1/32 pixel covers float rounding.
  x0 = fmax(ceil(x0 - 0.53125f), 0.0f); x1 = fmin(floor(x1 - 0.46875f), view[WIDTH] - 1.0f);
  y0 = fmax(ceil(y0 - 0.53125f), 0.0f); y1 = fmin(floor(y1 - 0.46875f), view[HEIGHT] - 1.0f);
  int shown = low <= high && back > near && x0 <= x1 && y0 <= y1;
  rectangles[k] = shown ? (int4)((int)x0, (int)y0, (int)x1, (int)y1) : (int4)(1, 1, 0, 0);
}
