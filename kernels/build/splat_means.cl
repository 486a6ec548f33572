// Sums over the points of each pixel that lie within `thickness` of the nearest: height at the pixel's centre, colour.
//
// Heights (towards the eye) are carried to the centre along the points' tangent planes. Sums are fixed-point integers,
// so that no order of points matters: heights over the nearest depth in steps of `unit`, colours in steps of 1 / 4096.
#ifndef FACING
#define FACING 0.25f
#endif
#ifndef COLORED
#define COLORED 1
#endif
#define SUMS 7 // points, height, facing, linear premultiplied red, green, blue, alpha

__kernel void splat_means(int count, int padded,
                          __global const float *sorted, __global const float *view, // see splat_depths.cl
                          float inverse_step, int columns, int rows,
                          __global const uint *nearest, float thickness, float inverse_unit,
                          __global const float *light,  // (4, padded)
                          __global int *sums)           // (SUMS, rows, columns)
{
  int p = get_global_id(0);
  if (p >= count) return;
  size_t n = padded, pixels = (size_t)rows * columns;
  float x = sorted[p] - view[0], y = sorted[n + p] - view[1], z = sorted[2 * n + p] - view[2];
  float nx = sorted[3 * n + p], ny = sorted[4 * n + p], nz = sorted[5 * n + p];
  float facing = nx * view[9] + ny * view[10] + nz * view[11];
  float u = x * view[3] + y * view[4] + z * view[5], v = x * view[6] + y * view[7] + z * view[8];
  int i = (int)floor(u * inverse_step + 0.5f), j = (int)floor(v * inverse_step + 0.5f);
  if (facing < FACING || i < 0 || j < 0 || i >= columns || j >= rows) return;
  size_t at = (size_t)j * columns + i;
  uint bits = nearest[at];
  float front = -as_float(bits & 0x80000000u ? bits & 0x7fffffffu : ~bits);
  float height = x * view[9] + y * view[10] + z * view[11];
  if (height < front - thickness) return;
  float du = i / inverse_step - u, dv = j / inverse_step - v;
  float rise = -((nx * view[3] + ny * view[4] + nz * view[5]) * du + (nx * view[6] + ny * view[7] + nz * view[8]) * dv);
  rise /= facing;
  rise = rise > thickness ? thickness : rise < -thickness ? -thickness : rise;
  atomic_add(sums + at, 1);
  atomic_add(sums + pixels + at, (int)rint((height + rise - front) * inverse_unit));
  atomic_add(sums + 2 * pixels + at, (int)rint(facing * 4096.0f));
#if COLORED
  for (int k = 0; k < 4; ++k) atomic_add(sums + (3 + k) * pixels + at, (int)rint(light[k * n + p] * 4096.0f));
#endif
}
