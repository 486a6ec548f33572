// The linear forms that project the nodes of every patch, the pixels and bins that it may touch, and how it is drawn. One
// work-item per patch. Twin: tests/reference/render_patches.py, project_patches.
//
// The rectangle (first x, first y, last x, last y; first > last: not in the picture) is that of the eight corners of the
// box around the patch's displacements; a patch that reaches the near plane gets the whole picture. `boxes`: the same in
// bins, first x of all patches, then first y, last x and last y, `stride` apart.
//
// With several levels a patch, level l of patch k is patch k * levels + l of the surface, and the chosen ones' frames, sizes
// and first nodes are written as well.
#include "common/bins.clh"
#include "render/patch_levels.clh"

#ifndef NODES
#define NODES 0   // 0: exact projection; 1: trilinear from the box's corners, 2: the same before the division
#endif
#ifndef LEVELS
#define LEVELS 0  // 1: there are several levels a patch
#endif
#ifndef OVERSHOOT
#define OVERSHOOT 0.0f  // of the largest difference: smooth cells rise above their nodes, by an eighth of it each way
#endif
#ifndef DIRECT
#define DIRECT 0  // 1: patches of cells smaller than a pixel are drawn node by node
#endif
#ifndef LARGE_PX
#define LARGE_PX 12.0f  // a cell may be this wide or high before lanes are pixels of a cell instead of cells of a row
#endif
#define PATCH_STRIDE (NODES ? PATCH_FLOATS + 24 : PATCH_FLOATS)

#if NODES
// The polynomial through the values v at the corners of a box (bits: i, j, d) of size (m, n, e) from (0, 0, low).
inline void trilinear(const float *v, float m, float n, float low, float e, __global float *out) {
  float c = v[0], x = (v[1] - v[0]) / m, y = (v[2] - v[0]) / n, z = (v[4] - v[0]) / e;
  float xy = (v[3] - v[2] - v[1] + v[0]) / (m * n), xz = (v[5] - v[4] - v[1] + v[0]) / (m * e);
  float yz = (v[6] - v[4] - v[2] + v[0]) / (n * e);
  float xyz = (v[7] - v[6] - v[5] - v[3] + v[4] + v[2] + v[1] - v[0]) / (m * n * e);
  // In displacements d, not d - low.
  out[0] = c - low * z; out[1] = x - low * xz; out[2] = y - low * yz; out[3] = z;
  out[4] = xy - low * xyz; out[5] = xz; out[6] = yz; out[7] = xyz;
}
#endif

// Comparisons: PoCL's fmin, fmax and fabs are calls.
#define LESS(a, b) ((b) < (a) ? (b) : (a))
#define MORE(a, b) ((b) > (a) ? (b) : (a))
#define SIZE(x) ((x) < 0.0f ? -(x) : (x))

inline void turned(__global const float *view, __global const float *v, float *out) {
  for (int r = 0; r < 3; r++) out[r] = view[3 * r] * v[0] + view[3 * r + 1] * v[1] + view[3 * r + 2] * v[2];
}

__kernel void project_patches(__global const float *view, __global const float *frames, __global const int *sizes,
                              __global const uint *offsets, int count, int levels, float widest, int stride,
                              __global float *records, __global int4 *rectangles, __global short *boxes,
                              __global float *chosen_frames, __global int *chosen_sizes, __global uint *chosen_offsets,
                              __global int *chosen) {
  int k = get_global_id(0), level = 0, from = k;
#if LEVELS
  if (k == count) chosen_offsets[k] = offsets[count * levels];
#endif
  if (k >= count) return;
#if LEVELS
  from = k * levels;
  level = level_of(view, frames + (size_t)from * FRAME_FLOATS, sizes + 2 * from, levels, widest);
  from += level;
  for (int i = 0; i < FRAME_FLOATS; i++)
    chosen_frames[(size_t)k * FRAME_FLOATS + i] = frames[(size_t)from * FRAME_FLOATS + i];
  chosen_sizes[2 * k] = sizes[2 * from]; chosen_sizes[2 * k + 1] = sizes[2 * from + 1];
  chosen_offsets[k] = offsets[from];
  chosen[k] = level;
#endif
  __global const float *f = frames + (size_t)from * FRAME_FLOATS;
  __global float *h = records + (size_t)k * PATCH_STRIDE;
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
  float more = OVERSHOOT * f[LARGEST_STEP], low = f[LOW_STEP] - more, high = f[HIGH_STEP] + more;
  float near = view[NEAR], m = sizes[2 * from] - 1, n = sizes[2 * from + 1] - 1;
  float x0 = INFINITY, y0 = INFINITY, x1 = -INFINITY, y1 = -INFINITY, front = INFINITY, back = -INFINITY;
#if NODES
  float extent = high > low ? high - low : 1.0f, corners[3][8];
#endif
  for (int corner = 0; corner < 8; corner++) {
#if NODES
    high = low + extent;
#endif
    Node p = node_at(h, perspective, corner & 1 ? m : 0, corner & 2 ? n : 0, corner & 4 ? high : low);
    front = LESS(front, p.z); back = MORE(back, p.z);
    float inv = 1.0f / p.w;
    x0 = LESS(x0, p.x * inv); x1 = MORE(x1, p.x * inv); y0 = LESS(y0, p.y * inv); y1 = MORE(y1, p.y * inv);
#if NODES
    corners[0][corner] = NODES == 1 ? p.x * inv : p.x; corners[1][corner] = NODES == 1 ? p.y * inv : p.y;
    corners[2][corner] = p.z;
#endif
  }
  int clipped = front <= near || (perspective && front <= 1e-4f * back), flags = clipped ? PATCH_CLIPPED : 0;
#if NODES
  for (int r = 0; r < 3; r++) trilinear(corners[r], m, n, low, extent, h + PATCH_FLOATS + 8 * r);
#endif
  if (clipped) { x0 = y0 = -1e9f; x1 = y1 = 1e9f; }
  else {
    // The sides of a cell in pixels: from node a to b, x changes by (change of x w - x_b change of w) / w_a.
    float inv = perspective ? 1.0f / front : 1.0f, turn = perspective ? 1.0f : 0.0f, wide = 0.0f, tall = 0.0f;
    for (int side = 1; side < 3; side++) {
#define CHANGE(H, at) (SIZE(h[H + side] - at * turn * h[HZ + side]) + f[LARGEST_STEP] * SIZE(h[H + 3] - at * turn * h[HZ + 3]))
      wide += inv * MORE(CHANGE(HX, x0), CHANGE(HX, x1));
      tall += inv * MORE(CHANGE(HY, y0), CHANGE(HY, y1));
    }
    if (DIRECT && wide <= 1.0f && tall <= 1.0f) flags = PATCH_DIRECT;
    if (wide > LARGE_PX || tall > LARGE_PX) flags = PATCH_LARGE;
  }
  h[PATCH_FLAGS] = as_float(flags | level << PATCH_LEVEL);
  h[PATCH_NEAR] = front > near ? front : near;
  h[SLOPE_SCALE] = f[SCALE_OF_SLOPES];
  // 1/32 pixel covers float rounding.
  x0 = MORE(ceil(x0 - 0.53125f), 0.0f); x1 = LESS(floor(x1 - 0.46875f), view[WIDTH] - 1.0f);
  y0 = MORE(ceil(y0 - 0.53125f), 0.0f); y1 = LESS(floor(y1 - 0.46875f), view[HEIGHT] - 1.0f);
  int shown = f[LOW_STEP] <= f[HIGH_STEP] && back > near && x0 <= x1 && y0 <= y1;
  rectangles[k] = shown ? (int4)((int)x0, (int)y0, (int)x1, (int)y1) : (int4)(1, 1, 0, 0);
  boxes[k] = shown ? x0 / BIN : 32767;
  boxes[stride + k] = shown ? y0 / BIN : 32767;
  boxes[2 * stride + k] = shown ? x1 / BIN : -1;
  boxes[3 * stride + k] = shown ? y1 / BIN : -1;
}
