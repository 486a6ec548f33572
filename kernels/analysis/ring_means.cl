// Means of 16 values a point over the point itself (counted OWN times) and the points of its list.
#ifndef OWN
#define OWN 2.0f
#endif

__kernel void ring_means(int count, __global const int *offset, __global const int *near, __global const float16 *values,
                         __global float16 *out) {
  int i = get_global_id(0);
  if (i >= count) return;
  float16 sum = OWN * values[i];
  int first = offset[i], last = offset[i + 1];
  for (int k = first; k < last; ++k) sum += values[near[k]];
  out[i] = sum * (1.0f / (OWN + (float)(last - first)));
}
