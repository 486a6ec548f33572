// The tree of the neighbour search: leaves of 16 consecutive points, nodes that hold the boxes of 16 children.
//
// Heap order without pointers: child c of node i is node 16 i + 1 + c; ids from `first_leaf` on are leaves.
// A leaf is 16 x, 16 y, 16 z; a node is 16 low x, low y, low z, high x, high y, high z of its children. Missing points
// are at infinity and missing children have empty boxes, so that no distance to them is ever small.

// Gather the points of one leaf in sorted order and write its box into its parent.
__kernel void knn_leaves(__global const float *points,  // (count, 3)
                         __global const uint *order,    // (count,) indices along the curve
                         __global float *leaves,        // (leaf_count, 3, 16), positions times scale
                         __global float *nodes,         // (node_count, 6, 16)
                         uint count, uint leaf_count, uint padded_count, uint first_leaf, float scale)
{
  uint leaf = get_global_id(0);
  if (leaf >= padded_count) return;
  float low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
  if (leaf < leaf_count)
    for (uint j = 0; j < 16; j++) {
      uint at = 16 * leaf + j;
      uint i = at < count ? 3 * order[at] : 0;
      for (uint a = 0; a < 3; a++) {
        float x = at < count ? points[i + a] * scale : INFINITY;
        leaves[48 * leaf + 16 * a + j] = x;
        if (at < count) {
          low[a] = x < low[a] ? x : low[a];
          high[a] = x > high[a] ? x : high[a];
        }
      }
    }
  uint id = leaf + first_leaf - 1;
  __global float *box = nodes + 96 * (id / 16) + id % 16;
  for (uint a = 0; a < 3; a++) box[16 * a] = low[a], box[48 + 16 * a] = high[a];
}

// Write the boxes of one level's nodes into their parents.
__kernel void knn_nodes(__global float *nodes, uint first, uint node_count, uint padded_count)
{
  uint node = get_global_id(0);
  if (node >= padded_count) return;
  float low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
  if (node < node_count)
    for (uint a = 0; a < 3; a++)
      for (uint j = 0; j < 16; j++) {
        float l = nodes[96 * (first + node) + 16 * a + j], h = nodes[96 * (first + node) + 48 + 16 * a + j];
        low[a] = l < low[a] ? l : low[a];
        high[a] = h > high[a] ? h : high[a];
      }
  uint id = node + first - 1;
  __global float *box = nodes + 96 * (id / 16) + id % 16;
  for (uint a = 0; a < 3; a++) box[16 * a] = low[a], box[48 + 16 * a] = high[a];
}
