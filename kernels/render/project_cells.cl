// Project the corners of blocks of cells, find the triangles that may be seen, where each block touches the picture, and
// the edges and depths of its triangles over the screen, in homogeneous coordinates, which need no clipping at the eye's
// plane (Olano, Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997). Set up once here, not in every
// bin: 2 of 4 ms of a bunny's tile stage.
//
// One work-item per block; lanes are cells. Test: tests/test_render_scale_map.py, test_project_cells.
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

#define WIDER 1e-3f  // pixels that triangles are widened by, so that rounding leaves no gaps between neighbours

// Corners of VW cells: screen x times w, screen y times w, depth, w (depth, or 1 where the picture is orthographic).
typedef struct { VF X[4], Y[4], T[4], W[4]; VI shown[2]; } Projected;

INLINE VF volume_of(const Projected *k, int p, int q, int r) {
  return k->X[p] * (k->Y[q] * k->W[r] - k->Y[r] * k->W[q]) + k->Y[p] * (k->X[r] * k->W[q] - k->X[q] * k->W[r])
       + k->W[p] * (k->X[q] * k->Y[r] - k->X[r] * k->Y[q]);
}

#define PUT_PLANE(plane, value) (*(__global VF *)(record + HEAD + (plane) * CELLS + part) = (value))

// Write the edge from corner p to q of the triangle whose third corner is `opposite`, and add to the plane of depth.
INLINE void put_edge(const Projected *k, int p, int q, VF sign, VF value, int plane, int part, __global float *record,
                     VF *depth) {
  VF a = (k->Y[p] * k->W[q] - k->Y[q] * k->W[p]) * sign, b = (k->X[q] * k->W[p] - k->X[p] * k->W[q]) * sign;
  VF c = (k->X[p] * k->Y[q] - k->X[q] * k->Y[p]) * sign;
  PUT_PLANE(plane, a); PUT_PLANE(plane + 1, b);
  PUT_PLANE(plane + 2, c + WIDER * (SEL(a, -a, a < 0.0f) + SEL(b, -b, b < 0.0f)));
  depth[0] += a * value; depth[1] += b * value; depth[2] += c * value;
}

INLINE void put_cells(Projected *k, int part, float cx, float cy, int perspective, __global float *record, uint *back) {
  VF V[4], inverse[4], zero = 0.0f, one = 1.0f;
  for (int c = 0; c < 4; c++) {
    inverse[c] = perspective ? one / k->W[c] : one;
    V[c] = perspective ? -one : k->T[c];
    k->X[c] -= cx * k->W[c]; k->Y[c] -= cy * k->W[c];
  }
  VF left = INFINITY, right = -INFINITY, top = INFINITY, bottom = -INFINITY;
  for (int triangle = 0; triangle < 2; triangle++) {
    const int p = triangle ? 3 : 0, q = triangle ? 2 : 1, r = triangle ? 1 : 2;
    VF volume = volume_of(k, p, q, r), sign = SEL(one, -one, volume < 0.0f), depth[3] = {zero, zero, zero};
    back[triangle] |= bits_of_lanes(volume < 0.0f) << part;
    put_edge(k, p, q, sign, V[r], triangle ? EDGE_DC : EDGE_AB, part, record, depth);
    put_edge(k, r, p, sign, V[q], triangle ? EDGE_BD : EDGE_CA, part, record, depth);
    put_edge(k, q, r, sign, V[p], triangle ? DIAGONAL_2 : DIAGONAL_1, part, record, depth);
    VF size = volume * sign, over = SEL(one / size, zero, size < 1e-30f);
    for (int i = 0; i < 3; i++) PUT_PLANE((triangle ? DEPTH_2 : DEPTH_1) + i, depth[i] * over);
    // Depths lie between those of the corners, but for triangles that cross the eye's plane.
    VF low = INFINITY, high = -INFINITY, x0 = INFINITY, x1 = -INFINITY, y0 = INFINITY, y1 = -INFINITY;
    VI crosses = 0;
    for (int i = 0; i < 3; i++) {
      int c = i == 0 ? p : i == 1 ? q : r;
      VF value = V[c] * inverse[c], x = k->X[c] * inverse[c], y = k->Y[c] * inverse[c];
      low = lesser(low, value); high = greater(high, value);
      x0 = lesser(x0, x); x1 = greater(x1, x); y0 = lesser(y0, y); y1 = greater(y1, y);
      crosses = crosses | (k->W[c] <= 1e-6f);
    }
    VF all = INFINITY;
    PUT_PLANE(triangle ? LOW_2 : LOW_1, SEL(low, -all, crosses));
    PUT_PLANE(triangle ? HIGH_2 : HIGH_1, SEL(high, all, crosses));
    VI use = k->shown[triangle];
    left = SEL(left, lesser(left, SEL(x0, -all, crosses)), use); right = SEL(right, greater(right, SEL(x1, all, crosses)), use);
    top = SEL(top, lesser(top, SEL(y0, -all, crosses)), use); bottom = SEL(bottom, greater(bottom, SEL(y1, all, crosses)), use);
  }
  PUT_PLANE(LEFT, left - 2 * WIDER); PUT_PLANE(RIGHT, right + 2 * WIDER);
  PUT_PLANE(TOP, top - 2 * WIDER); PUT_PLANE(BOTTOM, bottom + 2 * WIDER);
}

__kernel void project_cells(__global const float *view, __global const float *positions, int stride, int side,
                            int blocks_side, int first_block, int blocks /* from there on */,
                            __global float *records, __global short4 *full, __global short4 *core,
                            __global uint *keys, __global ushort *buckets) {
  int block = get_global_id(0), number = first_block + block;
  if (block >= blocks) return;
  int grid = number / (blocks_side * blocks_side), row0 = number / blocks_side % blocks_side * BLOCK_SIDE;
  int column0 = number % blocks_side * BLOCK_SIDE;
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
  uint mask[2] = {0, 0}, back[2] = {0, 0}, crosses = 0;
  Projected all[CELLS / VW];
  for (int part = 0; part < CELLS; part += VW) {
#if VW == 1
    VI in = part / BLOCK_SIDE < rows & part % BLOCK_SIDE < columns;
#else
    VI lane = LANE_INDEX + part;
    VI in = (lane >> 2 < rows) & ((lane & 3) < columns);
#endif
    Projected *k = all + part / VW;
    for (int c = 0; c < 4; c++) {
      __global const float *at = positions + base + (c >> 1) * side + (c & 1);
      VF x = load_cells(at, side, part), y = load_cells(at + stride, side, part), z = load_cells(at + 2 * stride, side, part);
      VF vx = view[ROTATION] * x + view[ROTATION + 1] * y + view[ROTATION + 2] * z + ox;
      VF vy = view[ROTATION + 3] * x + view[ROTATION + 4] * y + view[ROTATION + 5] * z + oy;
      k->T[c] = -(view[ROTATION + 6] * x + view[ROTATION + 7] * y + view[ROTATION + 8] * z + oz);
      k->W[c] = perspective ? k->T[c] : one;
      k->X[c] = across * vx + view[CX] * k->W[c]; k->Y[c] = view[CY] * k->W[c] - up * vy;
    }
    VI known[4];  // depths that are not numbers are those of holes
    for (int c = 0; c < 4; c++) known[c] = k->T[c] == k->T[c];
    for (int triangle = 0; triangle < 2; triangle++) {
      const int p = triangle ? 3 : 0, q = triangle ? 2 : 1, r = triangle ? 1 : 2;
      VI drawn = in & ((k->T[p] > near) | (k->T[q] > near) | (k->T[r] > near)) & known[p] & known[q] & known[r];
#if WHOLE
      drawn = drawn & known[0] & known[3];
#endif
      VI touches = (k->W[p] <= 1e-6f) | (k->W[q] <= 1e-6f) | (k->W[r] <= 1e-6f);
#if CULL
      drawn = drawn & (touches | (volume_of(k, p, q, r) >= 0.0f));
#endif
      k->shown[triangle] = drawn;
      mask[triangle] |= bits_of_lanes(drawn) << part;
      crosses |= bits_of_lanes(drawn & touches);
    }
    for (int c = 0; c < 4; c++) {
      VI used = c == 0 ? k->shown[0] : c == 3 ? k->shown[1] : k->shown[0] | k->shown[1];
      VF inverse = one / k->W[c], x = k->X[c] * inverse, y = k->Y[c] * inverse;
      low_x = SEL(low_x, lesser(low_x, x), used); high_x = SEL(high_x, greater(high_x, x), used);
      low_y = SEL(low_y, lesser(low_y, y), used); high_y = SEL(high_y, greater(high_y, y), used);
      first = SEL(first, lesser(first, k->T[c]), used);
    }
  }
  full[block] = (short4)(1, 1, 0, 0);
  if (!(mask[0] | mask[1])) return;
  float x_low = least_of(low_x), x_high = -least_of(-high_x), y_low = least_of(low_y), y_high = -least_of(-high_y);
  float front = least_of(first);
  if (crosses) { x_low = y_low = -1e9f; x_high = y_high = 1e9f; front = near; }
  int x0, x1, y0, y1;
  block_range(x_low, x_high, view[WIDTH], &x0, &x1);
  block_range(y_low, y_high, view[HEIGHT], &y0, &y1);
  if (x0 > x1 || y0 > y1) return;
  full[block] = core[block] = (short4)(x0, y0, x1, y1);
  front = (front > near ? front : near) * view[SCALE];
  uint bits = as_uint(front);
  bits ^= bits & 0x80000000u ? 0xffffffffu : 0x80000000u;
  keys[block] = bits & 0xffffff00u;
  float bucket = (front - view[FIRST_DEPTH]) / view[BUCKET_DEPTH];
  bucket = bucket > 0.0f ? bucket : 0.0f;
  buckets[block] = (ushort)(bucket < DEPTH_BUCKETS - 1 ? bucket : DEPTH_BUCKETS - 1);
  // The middle of what the block may touch: float32 is finest there.
  float cx = 2 * (x0 + x1 + 1), cy = 2 * (y0 + y1 + 1);
  for (int part = 0; part < CELLS; part += VW) put_cells(all + part / VW, part, cx, cy, perspective, record, back);
  record[MASK_1] = as_float(mask[0]); record[MASK_2] = as_float(mask[1]);
  record[BACK_1] = as_float(back[0]); record[BACK_2] = as_float(back[1]);
  record[BASE_NODE] = as_float(base); record[CENTER_X] = cx; record[CENTER_Y] = cy;
}
