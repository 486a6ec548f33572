// Gouraud shading (paper, section 3): the nodes of the patches in the picture with lit colours. Normals are made in patch
// space, where that takes two products, and the lamps and the eye are brought there.
//
// VW > 1: one work-item per patch, lanes over nodes. VW = 1: a work-group of 64 work-items per patch.
// Twin: tests/reference/render_patch_modes.py, light_nodes.
#include "common/patch.clh"
#include "render/shade.clh"

#ifndef LIT_RANGE
#define LIT_RANGE 4.0f  // of lit colours in 16 bits
#endif
#define UNIT (1.0f / 65535.0f)

INLINE float along(__global const float *view, __global const float *axis, float scale, const float *v) {
  float sum = 0.0f;  // v, in view space, along a model axis
  for (int r = 0; r < 3; r++) sum += (view[3 * r] * axis[0] + view[3 * r + 1] * axis[1] + view[3 * r + 2] * axis[2]) * v[r];
  return sum * scale;
}

__kernel void light_nodes(__global const float *view, __global const float *shading, __global const int4 *rectangles,
                          __global const float *frames, __global const int *sizes, __global const uint *offsets,
                          int count, __global const uint4 *all_nodes, __global uint4 *lit) {
#if VW == 1
  int k = get_group_id(0), start = get_local_id(0), stride = 64;
#else
  int k = get_global_id(0), start = 0, stride = VW;
#endif
  if (k >= count || rectangles[k].x > rectangles[k].z) return;
  __global const float *f = frames + (size_t)k * FRAME_FLOATS;
  int m = sizes[2 * k], nodes = m * sizes[2 * k + 1], perspective = view[PERSPECTIVE] > 0.0f;
  uint first = offsets[k];
  float length[3], origin[3], eye[3], back[3] = {0.0f, 0.0f, 1.0f}, to_eye[3];
  for (int r = 0; r < 3; r++) {
    __global const float *o = f + ORIGIN;
    origin[r] = view[SCALE] * (view[3 * r] * o[0] + view[3 * r + 1] * o[1] + view[3 * r + 2] * o[2]) + view[OFFSET + r];
    __global const float *a = f + AXIS_X + 3 * r;
    length[r] = sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
    eye[r] = -origin[r];
  }
#define IN_PATCH(v, r) along(view, f + AXIS_X + 3 * (r), 1.0f / length[r], v)
  float e[3], b[3];
  for (int r = 0; r < 3; r++) { e[r] = IN_PATCH(eye, r); b[r] = IN_PATCH(back, r); }
  float sx = view[SCALE] * length[0], sy = view[SCALE] * length[1], sz = view[SCALE] * length[2];
  float tilt_x = length[2] / length[0], tilt_y = length[2] / length[1];
  for (int at = start; at < nodes; at += stride) {
    VF X, Y, Z, gx, gy, base[3], reflected[3], gloss[3];
    float step = f[SCALE_OF_SLOPES];
    for (int l = 0; l < VW; l++) {
      int node = at + l < nodes ? at + l : nodes - 1;
      uint4 q = all_nodes[first + node];
      ((float *)&X)[l] = node % m; ((float *)&Y)[l] = node / m; ((float *)&Z)[l] = as_float(q.x);
      ((float *)&gx)[l] = (as_int(q.w << 16) >> 16) * step; ((float *)&gy)[l] = (as_int(q.w) >> 16) * step;
#if CHANNELS
      ((float *)&base[0])[l] = (q.y & 0xffffu) * UNIT; ((float *)&base[1])[l] = (q.y >> 16) * UNIT;
      ((float *)&base[2])[l] = (q.z & 0xffffu) * UNIT;
#else
      for (int c = 0; c < 3; c++) ((float *)&base[c])[l] = view[PATCH_COLOR + c];
#endif
    }
    X *= sx; Y *= sy; Z *= sz;
    VF nx = -gx * tilt_x, ny = -gy * tilt_y, nz = 1.0f / VSQRT(1.0f + nx * nx + ny * ny);
    nx *= nz; ny *= nz;
    VF ex = b[0], ey = b[1], ez = b[2];
    if (perspective) {
      ex = e[0] - X; ey = e[1] - Y; ez = e[2] - Z;
      VF inv = 1.0f / VSQRT(ex * ex + ey * ey + ez * ez + 1e-30f);
      ex *= inv; ey *= inv; ez *= inv;
    }
    VF side = SEL((VF)(1.0f), (VF)(-1.0f), nx * ex + ny * ey + nz * ez < 0.0f);
    nx *= side; ny *= side; nz *= side;
    for (int c = 0; c < 3; c++) { reflected[c] = shading[AMBIENT]; gloss[c] = 0.0f; }
    for (int i = 0; i < (int)shading[LIGHT_COUNT]; i++) {
      __global const float *lamp = shading + LIGHTS + i * LIGHT_FLOATS;
      float v[3] = {lamp[LIGHT_X], lamp[LIGHT_Y], lamp[LIGHT_Z]}, s[3] = {lamp[SPOT_X], lamp[SPOT_Y], lamp[SPOT_Z]};
      if ((int)lamp[LIGHT_KIND] >= POINT)
        for (int r = 0; r < 3; r++) v[r] -= origin[r];
      Aim aim = {IN_PATCH(v, 0), IN_PATCH(v, 1), IN_PATCH(v, 2), IN_PATCH(s, 0), IN_PATCH(s, 1), IN_PATCH(s, 2)};
      add_lamp(shading, lamp, aim, X, Y, Z, nx, ny, nz, ex, ey, ez, reflected, gloss);
    }
    for (int c = 0; c < 3; c++) {
      base[c] = (base[c] * reflected[c] + gloss[c]) * (65535.0f / LIT_RANGE) + 0.5f;
      base[c] = VMAX(base[c], (VF)(0.0f)); base[c] = VMIN(base[c], (VF)(65535.0f));
    }
    for (int l = 0; l < VW && at + l < nodes; l++) {
      uint4 q = all_nodes[first + at + l];
      q.y = (uint)((float *)&base[0])[l] | (uint)((float *)&base[1])[l] << 16;
      q.z = (q.z & 0xffff0000u) | (uint)((float *)&base[2])[l];
      lit[first + at + l] = q;
    }
  }
}
