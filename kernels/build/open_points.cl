// Which points still need a surfel at this level: neither covered by leaves nor held by an internal surfel.
// One work-item per 16 points; `state` is 0 for an open point (choose_centers.cl).
__kernel void open_points(int count, int blocks, uint threshold, __global const uint *overlap,
                          __global const uchar *held, __global uchar *state, __global uchar *open) {
  int block = get_global_id(0);
  if (block >= blocks) return;
  uchar any = 0;
  for (int i = 16 * block; i < 16 * block + 16; ++i) {
    uchar closed = i >= count || overlap[i] >= threshold || held[i] != 0;
    state[i] = closed;
    any |= !closed;
  }
  open[block] = any;
}
