// Points (n, 3) in sorted order, as six arrays: unit-diagonal coordinates and unit normals, padded to whole blocks.
#ifndef FAR_POINT
#define FAR_POINT 1e6f // finite: a masked lane must not meet inf * 0
#endif

__kernel void gather_points(int count, int padded, __global const float *points, __global const float *normals,
                            __global const int *order, float mid_x, float mid_y, float mid_z, float scale,
                            __global float *sorted) {
  int i = get_global_id(0);
  if (i >= padded) return;
  float x = FAR_POINT, y = FAR_POINT, z = FAR_POINT, nx = 0.0f, ny = 0.0f, nz = 1.0f;
  if (i < count) {
    size_t j = 3 * (size_t)order[i];
    x = (points[j] - mid_x) * scale;
    y = (points[j + 1] - mid_y) * scale;
    z = (points[j + 2] - mid_z) * scale;
    nx = normals[j];
    ny = normals[j + 1];
    nz = normals[j + 2];
    float k = 1.0f / sqrt(nx * nx + ny * ny + nz * nz);
    nx *= k;
    ny *= k;
    nz *= k;
  }
  sorted[i] = x;
  sorted[padded + (size_t)i] = y;
  sorted[2 * (size_t)padded + i] = z;
  sorted[3 * (size_t)padded + i] = nx;
  sorted[4 * (size_t)padded + i] = ny;
  sorted[5 * (size_t)padded + i] = nz;
}
