// Leave out the patches that show their backs only: where every facet normal, inside a cone, points away from the eye for
// every point of the sphere around the patch's box. One work-item per patch.
// Twin: tests/reference/render_patch_modes.py, seen_from_behind.
#include "common/patch.clh"

__kernel void cull_patches(__global const float *view, __global const float *frames, __global const int *sizes, int count,
                           __global const float4 *cones /* axis, half angle */, int levels, __global const int *chosen,
                           __global int4 *rectangles, int stride, __global short *boxes) {
  int k = get_global_id(0);
  if (k >= count) return;
  __global const float *f = frames + (size_t)k * FRAME_FLOATS;
  float4 cone = cones[k * levels + (levels > 1 ? chosen[k] : 0)];
  float i = 0.5f * (sizes[2 * k] - 1), j = 0.5f * (sizes[2 * k + 1] - 1), d = 0.5f * (f[LOW_STEP] + f[HIGH_STEP]);
  float e = f[HIGH_STEP] - d, reach2 = 0.0f, middle[3], to_eye[3], axis[3];
  for (int r = 0; r < 3; r++) {
    middle[r] = f[ORIGIN + r] + i * f[AXIS_X + r] + j * f[AXIS_Y + r] + d * f[AXIS_Z + r];
    float x = i * f[AXIS_X + r], y = j * f[AXIS_Y + r], z = e * f[AXIS_Z + r];
    reach2 += x * x + y * y + z * z;
  }
  float distance2 = 0.0f, along = 0.0f;
  for (int r = 0; r < 3; r++) {
    to_eye[r] = -view[OFFSET + r];
    axis[r] = 0.0f;
    for (int c = 0; c < 3; c++) {
      to_eye[r] -= view[SCALE] * view[3 * r + c] * middle[c];
      axis[r] += view[3 * r + c] * (c == 0 ? cone.x : c == 1 ? cone.y : cone.z);
    }
    if (view[PERSPECTIVE] == 0.0f) to_eye[r] = r == 2 ? 1.0f : 0.0f;
    distance2 += to_eye[r] * to_eye[r];
    along += axis[r] * to_eye[r];
  }
  float distance = sqrt(distance2), reach = view[PERSPECTIVE] > 0.0f ? view[SCALE] * sqrt(reach2) : 0.0f;
  if (!(reach < distance)) return;  // the eye may be within the patch
  // Angles from the axis to the eye, of the cone, and of the sphere; 0.001 covers rounding.
  float off = acos(clamp(along / distance, -1.0f, 1.0f));
  if (off - cone.w - asin(reach / distance) > M_PI_2_F + 0.001f) {
    rectangles[k] = (int4)(1, 1, 0, 0);
    boxes[k] = boxes[stride + k] = 32767;
    boxes[2 * stride + k] = boxes[3 * stride + k] = -1;
  }
}
