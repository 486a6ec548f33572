// Write the drawn primitives in order of their depth buckets, front to back; within a bucket they keep their own order.
// Twin: order_depths.
__kernel void order_depths(__global const short4 *full, __global const ushort *buckets, int count, int chunk,
                           int bucket_count, __global uint *counts, __global const uint *offsets, __global uint *order) {
  int part = get_global_id(0);
  int begin = part * chunk, end = begin + chunk < count ? begin + chunk : count;
  __global uint *mine = counts + (size_t)part * bucket_count;
  for (int i = begin; i < end; i++)
    if (full[i].x <= full[i].z) order[offsets[buckets[i]] + mine[buckets[i]]++] = (uint)i;
}
