// A device's self test: target = factor * sqrt(source) + 1, VW values a work-item. Run by `clsurf doctor`.
#include "common/lanes.clh"

__kernel void self_test(__global const float *source, __global float *target, const float factor) {
  int i = get_global_id(0);
  ((__global VF *)target)[i] = VSQRT(((__global const VF *)source)[i]) * factor + 1.0f;
}
