// Project the corners of blocks of cells, find the triangles that may be seen, and where each block touches the picture.
//
// One work-item per block; lanes are cells. Twin: tests/reference/render_cells.py, project_cells.
#include "render/cells.clh"
#include "common/bins.clh"

#ifndef CULL
#define CULL 0  // 1: triangles seen from behind are left out
#endif
#ifndef WHOLE
#define WHOLE 0  // 1: a cell is drawn whole or not at all
#endif

// First and last block of 4 pixels whose centres lie between `low` and `high`, widened by 1/32 pixel; first > last: none.
INLINE void block_range(float low, float high, float size, int *first, int *last) {
  low -= 0.53125f; high -= 0.46875f;
  low = low > 0.0f ? low : 0.0f; high = high < size - 1.0f ? high : size - 1.0f;
  *first = low < size ? (int)ceil(low) >> 2 : (int)size;
  *last = high >= 0.0f ? (int)high >> 2 : -1;
}

__kernel void project_cells(__global const float *view, __global const float *positions, int stride, int side,
                            int blocks_side, int blocks, __global float *records, __global short4 *full,
                            __global short4 *core, __global uint *keys, __global ushort *buckets) {
  int block = get_global_id(0);
  if (block >= blocks) return;
  int grid = block / (blocks_side * blocks_side), row0 = block / blocks_side % blocks_side * BLOCK_SIDE;
  int column0 = block % blocks_side * BLOCK_SIDE;
  int base = (grid * side + row0) * side + column0;
  int rows = side - 1 - row0, columns = side - 1 - column0;  // of cells from here on
  const int perspective = view[PERSPECTIVE] > 0.0f;
  const float unit = 1.0f / view[SCALE], near = view[NEAR] * unit;
  // View axes are in radii: an orthographic picture's pixels are in world units.
  const float across = perspective ? view[FX] : view[FX] * view[SCALE];
  const float up = perspective ? view[FY] : view[FY] * view[SCALE];
  const float ox = view[OFFSET] * unit, oy = view[OFFSET + 1] * unit, oz = view[OFFSET + 2] * unit;
  __global float *record = records + (size_t)block * CELL_RECORD;
  VF most = 1e30f, low_x = most, high_x = -most, low_y = most, high_y = -most, first = most, one = 1.0f;
  uint mask[2] = {0, 0}, crosses = 0;
  for (int part = 0; part < CELLS; part += VW) {
#if VW == 1
    VI in = part / BLOCK_SIDE < rows & part % BLOCK_SIDE < columns;
#else
    VI lane = LANE_INDEX + part;
    VI in = (lane >> 2 < rows) & ((lane & 3) < columns);
#endif
    VF X[4], Y[4], T[4], W[4];
    for (int c = 0; c < 4; c++) {
      __global const float *at = positions + base + (c >> 1) * side + (c & 1);
      VF x = load_cells(at, side, part), y = load_cells(at + stride, side, part), z = load_cells(at + 2 * stride, side, part);
      VF vx = view[ROTATION] * x + view[ROTATION + 1] * y + view[ROTATION + 2] * z + ox;
      VF vy = view[ROTATION + 3] * x + view[ROTATION + 4] * y + view[ROTATION + 5] * z + oy;
      T[c] = -(view[ROTATION + 6] * x + view[ROTATION + 7] * y + view[ROTATION + 8] * z + oz);
      W[c] = perspective ? T[c] : one;
      X[c] = across * vx + view[CX] * W[c]; Y[c] = view[CY] * W[c] - up * vy;
      *(__global VF *)(record + CORNERS + 3 * c * CELLS + part) = X[c];
      *(__global VF *)(record + CORNERS + (3 * c + 1) * CELLS + part) = Y[c];
      *(__global VF *)(record + CORNERS + (3 * c + 2) * CELLS + part) = T[c];
    }
    VI shown[2];
    for (int triangle = 0; triangle < 2; triangle++) {
      int p = triangle ? 3 : 0, q = triangle ? 2 : 1, r = triangle ? 1 : 2;
      // Depths that are not numbers, those of holes, fail here.
      VI drawn = in & ((T[p] > near) | (T[q] > near) | (T[r] > near)) & (T[p] == T[p]) & (T[q] == T[q]) & (T[r] == T[r]);
#if WHOLE
      drawn = drawn & (T[0] == T[0]) & (T[3] == T[3]);
#endif
      VI touches = (W[p] <= 1e-6f) | (W[q] <= 1e-6f) | (W[r] <= 1e-6f);
#if CULL
      VF volume = X[p] * (Y[q] * W[r] - Y[r] * W[q]) + Y[p] * (X[r] * W[q] - X[q] * W[r])
                + W[p] * (X[q] * Y[r] - X[r] * Y[q]);
      drawn = drawn & (touches | (volume >= 0.0f));
#endif
      shown[triangle] = drawn;
      mask[triangle] |= bits_of_lanes(drawn) << part;
      crosses |= bits_of_lanes(drawn & touches);
    }
    for (int c = 0; c < 4; c++) {
      VI used = c == 0 ? shown[0] : c == 3 ? shown[1] : shown[0] | shown[1];
      VF inverse = one / W[c], x = X[c] * inverse, y = Y[c] * inverse;
      low_x = SEL(low_x, lesser(low_x, x), used); high_x = SEL(high_x, greater(high_x, x), used);
      low_y = SEL(low_y, lesser(low_y, y), used); high_y = SEL(high_y, greater(high_y, y), used);
      first = SEL(first, lesser(first, T[c]), used);
    }
  }
  float x_low = least_of(low_x), x_high = -least_of(-high_x), y_low = least_of(low_y), y_high = -least_of(-high_y);
  float front = least_of(first);
  if (crosses) { x_low = y_low = -1e9f; x_high = y_high = 1e9f; front = near; }
  int x0, x1, y0, y1;
  block_range(x_low, x_high, view[WIDTH], &x0, &x1);
  block_range(y_low, y_high, view[HEIGHT], &y0, &y1);
  if (!(mask[0] | mask[1]) || x0 > x1 || y0 > y1) {
    full[block] = (short4)(1, 1, 0, 0);
    return;
  }
  full[block] = core[block] = (short4)(x0, y0, x1, y1);
  front = (front > near ? front : near) * view[SCALE];
  uint bits = as_uint(front);
  bits ^= bits & 0x80000000u ? 0xffffffffu : 0x80000000u;
  keys[block] = bits & 0xffffff00u;
  float bucket = (front - view[FIRST_DEPTH]) / view[BUCKET_DEPTH];
  bucket = bucket > 0.0f ? bucket : 0.0f;
  buckets[block] = (ushort)(bucket < DEPTH_BUCKETS - 1 ? bucket : DEPTH_BUCKETS - 1);
  record[MASK_1] = as_float(mask[0]); record[MASK_2] = as_float(mask[1]);
  record[BASE_NODE] = as_float(base); record[CROSSES] = as_float(crosses);
}
