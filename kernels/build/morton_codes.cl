// Morton codes of points: BITS bits an axis, x in the lowest bit of each triple; points outside the box are clamped.
// The index fills the INDEX_BITS lowest bits, so that sorting the codes sorts the points and no two codes are equal.
#ifndef BITS
#define BITS 14
#endif
#ifndef INDEX_BITS
#define INDEX_BITS 22
#endif

inline ulong spread_bits(ulong x) {
  x = (x | x << 32) & 0x1f00000000ffffUL;
  x = (x | x << 16) & 0x1f0000ff0000ffUL;
  x = (x | x << 8) & 0x100f00f00f00f00fUL;
  x = (x | x << 4) & 0x10c30c30c30c30c3UL;
  return (x | x << 2) & 0x1249249249249249UL;
}

inline ulong cell_of(float p, float low, float scale) {
  float c = (p - low) * scale;
  float top = (float)((1 << BITS) - 1);
  c = c > 0.0f ? c : 0.0f;
  return (ulong)(c < top ? c : top);
}

__kernel void morton_codes(int count, __global const float *points, float low_x, float low_y, float low_z, float scale,
                           __global ulong *codes) {
  int i = get_global_id(0);
  if (i >= count) return;
  ulong x = cell_of(points[3 * i], low_x, scale), y = cell_of(points[3 * i + 1], low_y, scale),
        z = cell_of(points[3 * i + 2], low_z, scale);
  ulong code = spread_bits(x) | spread_bits(y) << 1 | spread_bits(z) << 2;
  codes[i] = code << INDEX_BITS | (ulong)i;
}
