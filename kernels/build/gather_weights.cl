// Weights (n,) in sorted order, into the seventh row of the sorted points; 0 for the padding.
__kernel void gather_weights(int count, int padded, __global const float *weights, __global const int *order,
                             __global float *sorted) {
  int i = get_global_id(0);
  if (i < padded) sorted[6 * (size_t)padded + i] = i < count ? weights[order[i]] : 0.0f;
}
