// Count the drawn primitives of every depth bucket, each chunk of primitives apart (see count_bins). Twin: count_depths.
__kernel void count_depths(__global const short4 *full, __global const ushort *buckets, int count, int chunk,
                           int bucket_count, __global uint *counts) {
  int part = get_global_id(0);
  int begin = part * chunk, end = begin + chunk < count ? begin + chunk : count;
  __global uint *mine = counts + (size_t)part * bucket_count;
  for (int i = 0; i < bucket_count; i++) mine[i] = 0;
  for (int i = begin; i < end; i++)
    if (full[i].x <= full[i].z) mine[buckets[i]]++;
}
