// Vectors (n, 3) in sorted order, as three arrays padded to whole blocks: unit-diagonal coordinates, or unit normals.
//
// Two launches, so that the host's copies of points and normals can take turns in one block of memory.
#ifndef FAR_POINT
#define FAR_POINT 1e6f // finite: a masked lane must not meet inf * 0
#endif

__kernel void gather_points(int count, int padded, int normals, __global const float *vectors,
                            __global const int *order, float mid_x, float mid_y, float mid_z, float scale,
                            __global float *sorted) {
  int i = get_global_id(0);
  if (i >= padded) return;
  float far = normals ? 0.0f : FAR_POINT, x = far, y = far, z = normals ? 1.0f : far;
  if (i < count) {
    size_t j = 3 * (size_t)order[i];
    x = vectors[j];
    y = vectors[j + 1];
    z = vectors[j + 2];
    float k = scale;
    if (normals) {
      k = 1.0f / sqrt(x * x + y * y + z * z);
    } else {
      x -= mid_x;
      y -= mid_y;
      z -= mid_z;
    }
    x *= k;
    y *= k;
    z *= k;
  }
  size_t first = normals ? 3 * (size_t)padded : 0;
  sorted[first + i] = x;
  sorted[first + padded + i] = y;
  sorted[first + 2 * (size_t)padded + i] = z;
}
