// The upper records of the point tree: boxes of nodes, from the records of the level below (see point_tree.clh).
#define EMPTY 1e30f

__kernel void node_boxes(int nodes, int children, int offset, int child_offset, __global float *boxes) {
  int node = get_global_id(0);
  if (node >= nodes) return;
  __global float *out = boxes + 96 * ((size_t)offset + node);
  for (int side = 0; side < 6; ++side)
    for (int j = 0; j < 16; ++j) {
      int child = 16 * node + j;
      float value = side < 3 ? EMPTY : -EMPTY;
      if (child < children) {
        __global const float *in = boxes + 96 * ((size_t)child_offset + child) + 16 * side;
        for (int k = 0; k < 16; ++k) value = side < 3 ? (in[k] < value ? in[k] : value) : (in[k] > value ? in[k] : value);
      }
      out[16 * side + j] = value;
    }
}
