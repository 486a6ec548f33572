// The nearest depth in every pixel of an orthographic range image: points flushed into a z-buffer.
//
// Pixel (i, j) is centred at (i, j) steps from the image's corner along its x and y axes. Depth grows away from the eye;
// its bits, turned so that they order as unsigned numbers do, meet in an atomic minimum: no order of points matters.
#ifndef FACING
#define FACING 0.25f // least cosine between a point's normal and the direction to the eye
#endif

inline uint ordered(float depth) {
  uint bits = as_uint(depth);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

__kernel void splat_depths(int count, int padded,
                           __global const float *sorted, // x, y, z, normal x, y, z (padded each)
                           __global const float *view,   // corner, unit x, y, z axes (z to the eye): 12 floats
                           float inverse_step, int columns, int rows,
                           __global uint *nearest)       // (rows, columns), all bits set where there is nothing
{
  int p = get_global_id(0);
  if (p >= count) return;
  size_t n = padded;
  float x = sorted[p] - view[0], y = sorted[n + p] - view[1], z = sorted[2 * n + p] - view[2];
  float facing = sorted[3 * n + p] * view[9] + sorted[4 * n + p] * view[10] + sorted[5 * n + p] * view[11];
  int i = (int)floor((x * view[3] + y * view[4] + z * view[5]) * inverse_step + 0.5f);
  int j = (int)floor((x * view[6] + y * view[7] + z * view[8]) * inverse_step + 0.5f);
  if (facing < FACING || i < 0 || j < 0 || i >= columns || j >= rows) return;
  atomic_min(nearest + (size_t)j * columns + i, ordered(-(x * view[9] + y * view[10] + z * view[11])));
}
