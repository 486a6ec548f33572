// The lowest records of the point tree: boxes of blocks of 16 points, or of balls where `grown` (see point_tree.clh).
#define EMPTY 1e30f

__kernel void block_boxes(int nodes, int blocks, int padded, __global const float *sorted, __global const float *radius,
                          int grown, __global float *boxes) {
  int node = get_global_id(0);
  if (node >= nodes) return;
  for (int axis = 0; axis < 3; ++axis)
    for (int j = 0; j < 16; ++j) {
      int block = 16 * node + j;
      float low = EMPTY, high = -EMPTY;
      if (block < blocks) {
        __global const float *p = sorted + (size_t)axis * padded + 16 * (size_t)block;
        for (int k = 0; k < 16; ++k) {
          float r = grown ? radius[16 * (size_t)block + k] : 0.0f;
          low = p[k] - r < low ? p[k] - r : low;
          high = p[k] + r > high ? p[k] + r : high;
        }
      }
      boxes[96 * (size_t)node + 16 * axis + j] = low;
      boxes[96 * (size_t)node + 16 * (axis + 3) + j] = high;
    }
}
