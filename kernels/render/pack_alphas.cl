// Once per upload, one work-item per node: its alpha into the 16 bits that the packed nodes have for it.
__kernel void pack_alphas(__global const uchar *alphas, int count, __global uint4 *nodes) {
  int i = get_global_id(0);
  if (i >= count) return;
  nodes[i].z = (nodes[i].z & 0xffffu) | (uint)alphas[i] * 257u << 16;
}
