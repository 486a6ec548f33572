// The samples of a range image in world axes: a (3, 4) matrix times (depth u, depth v, depth, 1) of a depth image, or
// times (x, y, z, 1) of a grid of points. Missing samples stay NaN.
#ifndef DEPTH
#define DEPTH 1  // 0: three planes of floats x, y, z a sample
#endif

__kernel void range_samples(int count, int columns, __global const float *values, __global const float *matrix,
                            int first, __global float4 *samples) {
  int k = get_global_id(0);
  if (k >= count) return;
#if DEPTH
  float z = values[k], x = z * (float)(k % columns), y = z * (float)(k / columns);
#else
  float x = values[3 * k], y = values[3 * k + 1], z = values[3 * k + 2];
#endif
  float4 p;
  p.x = matrix[0] * x + matrix[1] * y + matrix[2] * z + matrix[3];
  p.y = matrix[4] * x + matrix[5] * y + matrix[6] * z + matrix[7];
  p.z = matrix[8] * x + matrix[9] * y + matrix[10] * z + matrix[11];
  p.w = 0.0f;
  samples[first + k] = p;
}
