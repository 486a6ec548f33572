// Exclusive sums of `totals`, and their whole sum at the end: offsets has count + 1 entries. One work-group of GROUP
// work-items, each with its own stretch. Twin: scan_totals.
#ifndef GROUP
#define GROUP 64
#endif

__kernel void scan_totals(__global const uint *totals, int count, __global uint *offsets) {
  __local uint sums[GROUP];
  int item = get_local_id(0), stretch = (count + GROUP - 1) / GROUP;
  int begin = item * stretch < count ? item * stretch : count, end = begin + stretch < count ? begin + stretch : count;
  uint sum = 0;
  for (int i = begin; i < end; i++) sum += totals[i];
  sums[item] = sum;
  barrier(CLK_LOCAL_MEM_FENCE);
  uint at = 0;
  for (int i = 0; i < item; i++) at += sums[i];
  for (int i = begin; i < end; i++) { offsets[i] = at; at += totals[i]; }
  if (item == GROUP - 1) offsets[count] = at;
}
