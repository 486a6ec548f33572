// The rows of faces as seven arrays padded to whole blocks, as the point tree has them: centroid, normal, weight.
#ifndef FAR_POINT
#define FAR_POINT 1e6f // finite: a masked lane must not meet inf * 0
#endif
#define ROW 8

__kernel void guided_rows(int count, int padded, __global const float *rows, __global float *sorted) {
  int i = get_global_id(0);
  if (i >= padded) return;
  __global const float *row = rows + ROW * (size_t)i;
  int known = i < count;
  size_t n = padded;
  float length2 = known ? row[0] * row[0] + row[1] * row[1] + row[2] * row[2] : 0.0f;
  int usable = length2 > 0.5f; // a face without area beside others without
  for (int k = 0; k < 3; ++k) {
    sorted[k * n + i] = known ? row[4 + k] : FAR_POINT;
    sorted[(3 + k) * n + i] = usable ? row[k] : k == 2 ? 1.0f : 0.0f;
  }
  sorted[6 * n + i] = usable ? row[3] : 0.0f;
}
