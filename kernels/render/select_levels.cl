// Choose the level of every patch by the distance of its nodes in the picture: the coarsest whose nodes are at most
// `widest` pixels apart where the patch is nearest to the eye. One work-item per patch, and one for the end of the nodes.
// Level l of patch k is patch k * levels + l of the surface. Twin: tests/reference/render_patch_modes.py, select_levels.
#include "common/patch.clh"

__kernel void select_levels(__global const float *view, __global const float *all_frames, __global const int *all_sizes,
                            __global const uint *all_offsets, int count, int levels, float widest,
                            __global float *frames, __global int *sizes, __global uint *offsets, __global int *chosen) {
  int k = get_global_id(0);
  if (k > count) return;
  if (k == count) { offsets[k] = all_offsets[count * levels]; return; }
  int first = k * levels, level = 0;
  __global const float *f = all_frames + (size_t)first * FRAME_FLOATS;
  // The nearest depth of the box around the patch's displacements.
  float near = INFINITY, scale = view[SCALE];
  for (int corner = 0; corner < 8; corner++) {
    float i = corner & 1 ? all_sizes[2 * first] - 1 : 0, j = corner & 2 ? all_sizes[2 * first + 1] - 1 : 0;
    float d = corner & 4 ? f[HIGH_STEP] : f[LOW_STEP], z = view[OFFSET + 2];
    for (int r = 0; r < 3; r++)
      z += scale * view[6 + r] * (f[ORIGIN + r] + i * f[AXIS_X + r] + j * f[AXIS_Y + r] + d * f[AXIS_Z + r]);
    near = -z < near ? -z : near;
  }
  float px = scale * (view[FX] > view[FY] ? view[FX] : view[FY]) / (view[PERSPECTIVE] > 0.0f ? near : 1.0f);
  if (view[PERSPECTIVE] == 0.0f || near > 0.0f)
    for (int l = 1; l < levels; l++) {
      __global const float *c = f + l * FRAME_FLOATS;
      float x2 = 0.0f, y2 = 0.0f;
      for (int r = 0; r < 3; r++) { x2 += c[AXIS_X + r] * c[AXIS_X + r]; y2 += c[AXIS_Y + r] * c[AXIS_Y + r]; }
      if (px * sqrt(x2 > y2 ? x2 : y2) <= widest) level = l;
    }
  for (int i = 0; i < FRAME_FLOATS; i++) frames[(size_t)k * FRAME_FLOATS + i] = f[level * FRAME_FLOATS + i];
  sizes[2 * k] = all_sizes[2 * (first + level)];
  sizes[2 * k + 1] = all_sizes[2 * (first + level) + 1];
  offsets[k] = all_offsets[first + level];
  chosen[k] = level;
}
