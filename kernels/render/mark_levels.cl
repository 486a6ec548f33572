// Write the level of every patch into the flags of its record, for the channel "level". One work-item per patch.
#include "common/patch.clh"

__kernel void mark_levels(__global float *records, int stride, __global const int *levels, int count) {
  int k = get_global_id(0);
  if (k >= count) return;
  __global float *flags = records + (size_t)k * stride + PATCH_FLAGS;
  *flags = as_float(as_int(*flags) | levels[k] << PATCH_LEVEL);
}
