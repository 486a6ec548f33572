// Draw the cells of every bin into its planes: the triangle that is seen at each pixel's centre, then what it shows.
//
// CAST: the nodes are a scale map's texels, and the ray of the pixel meets the map's own interpolated surface within the
// cell that its triangles have found. Otherwise (a geosphere) the triangle itself is drawn, its normals interpolated.
//
// One work-item per tile (VW lanes are pixels of 4x4 blocks), or a work-group of 64 per tile (VW = 1: one bin's pixels at
// a time). Twin: tests/reference/render_cells.py, tile_cells.
#include "render/cells.clh"
#include "common/planes.clh"
#include "common/cube.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#ifndef CAST
#define CAST 1
#endif
#define GRIDS (CAST ? 6 : 10)  // of one layer
#if defined(__clang__) && __has_builtin(__builtin_ctz)
#define FIRST_BIT(x) __builtin_ctz(x)
#else
#define FIRST_BIT(x) (31 - (int)clz((x) & -(x)))
#endif
#define WIDER 1e-3f  // pixels that triangles are widened by, so that rounding leaves no gaps between neighbours

// What the pixels of a bin need to know of 16 cells, relative to the bin's middle; 16 floats each.
enum { EDGE_AB, EDGE_CA = 3, EDGE_DC = 6, EDGE_BD = 9, DIAGONAL_1 = 12, DIAGONAL_2 = 15,  // 3: x, y, constant
       DEPTH_1 = 18, DEPTH_2 = 21, LOW_1 = 24, HIGH_1, LOW_2, HIGH_2, QUARTERS,
       BACK,  // bit 0, 1: the triangle is seen from behind
       PLANES };
#if VW == 1
#define SPACE __local
#else
#define SPACE __private
#endif
#define PUT_CELLS(plane, value) (*(SPACE VF *)(cells + (plane) * CELLS + part) = (value))

// The edge from (px, py, pw) to (qx, qy, qw): a x + b y + c, positive inside where `sign` is that of the triangle.
#define PUT_EDGE(plane, p, q, sign) do { \
    VF ea = (Y[p] * W[q] - Y[q] * W[p]) * (sign), eb = (X[q] * W[p] - X[p] * W[q]) * (sign); \
    VF ec = (X[p] * Y[q] - X[q] * Y[p]) * (sign), wide = SEL(ea, -ea, ea < 0.0f) + SEL(eb, -eb, eb < 0.0f); \
    PUT_CELLS(plane, ea); PUT_CELLS((plane) + 1, eb); PUT_CELLS((plane) + 2, ec + WIDER * wide); \
    a += ea * V[opposite]; b += eb * V[opposite]; c += ec * V[opposite]; } while (0)

// Set up the cells of `part`: edges in homogeneous coordinates, which need no clipping at the eye's plane (Olano, Greer,
// 1997), and the planes of -1 / depth or depth over the screen.
INLINE void set_up(__global const float *record, int part, float bx, float by, int perspective, SPACE float *cells) {
  VF X[4], Y[4], T[4], W[4], V[4], zero = 0.0f, one = 1.0f;
  VI back = 0;
  for (int k = 0; k < 4; k++) {
    T[k] = *(__global const VF *)(record + CORNERS + (3 * k + 2) * CELLS + part);
    W[k] = perspective ? T[k] : one;
    X[k] = *(__global const VF *)(record + CORNERS + 3 * k * CELLS + part) - bx * W[k];
    Y[k] = *(__global const VF *)(record + CORNERS + (3 * k + 1) * CELLS + part) - by * W[k];
    V[k] = perspective ? -one : T[k];
  }
  for (int triangle = 0; triangle < 2; triangle++) {
    int p = triangle ? 3 : 0, q = triangle ? 2 : 1, r = triangle ? 1 : 2, opposite;
    VF volume = X[p] * (Y[q] * W[r] - Y[r] * W[q]) + Y[p] * (X[r] * W[q] - X[q] * W[r])
              + W[p] * (X[q] * Y[r] - X[r] * Y[q]);
    back = back | SEL((VI)(0), (VI)(1 << triangle), volume < 0.0f);
    VF sign = SEL(one, -one, volume < 0.0f), a = zero, b = zero, c = zero;
    opposite = r; PUT_EDGE(triangle ? EDGE_DC : EDGE_AB, p, q, sign);
    opposite = q; PUT_EDGE(triangle ? EDGE_BD : EDGE_CA, r, p, sign);
    opposite = p; PUT_EDGE(triangle ? DIAGONAL_2 : DIAGONAL_1, q, r, sign);
    VF size = SEL(volume, -volume, volume < 0.0f), inverse = SEL(one / size, zero, size < 1e-30f);
    int plane = triangle ? DEPTH_2 : DEPTH_1;
    PUT_CELLS(plane, a * inverse); PUT_CELLS(plane + 1, b * inverse); PUT_CELLS(plane + 2, c * inverse);
    // Depths lie between those of the corners, but for triangles that cross the eye's plane.
    VF low = INFINITY, high = -INFINITY;
    for (int k = 0; k < 3; k++) {
      int at = k == 0 ? p : k == 1 ? q : r;
      VF value = perspective ? -one / T[at] : T[at];
      low = lesser(low, value); high = greater(high, value);
    }
    VI touches = (W[p] <= 1e-6f) | (W[q] <= 1e-6f) | (W[r] <= 1e-6f);
    PUT_CELLS(triangle ? LOW_2 : LOW_1, SEL(low, (VF)(-INFINITY), touches));
    PUT_CELLS(triangle ? HIGH_2 : HIGH_1, SEL(high, (VF)(INFINITY), touches));
  }
  // Which quarters of the bin each cell may touch.
  VF low_x = INFINITY, high_x = -INFINITY, low_y = INFINITY, high_y = -INFINITY;
  VI touches = 0;
  for (int k = 0; k < 4; k++) {
    VF inverse = one / W[k], x = X[k] * inverse, y = Y[k] * inverse;
    low_x = lesser(low_x, x); high_x = greater(high_x, x);
    low_y = lesser(low_y, y); high_y = greater(high_y, y);
    touches = touches | NOT(W[k] > 1e-6f);  // a hole's corner too
  }
  VI left = touches | ((low_x <= -0.5f + WIDER) & (high_x >= -3.5f - WIDER));
  VI right = touches | ((low_x <= 3.5f + WIDER) & (high_x >= 0.5f - WIDER));
  VI above = touches | ((low_y <= -0.5f + WIDER) & (high_y >= -3.5f - WIDER));
  VI below = touches | ((low_y <= 3.5f + WIDER) & (high_y >= 0.5f - WIDER));
  VI quarters = SEL((VI)(0), (VI)(1), left & above) | SEL((VI)(0), (VI)(2), right & above)
              | SEL((VI)(0), (VI)(4), left & below) | SEL((VI)(0), (VI)(8), right & below);
  PUT_CELLS(QUARTERS, AS_VF(quarters));
  PUT_CELLS(BACK, AS_VF(back));
}

typedef struct {
  VF z;       // -1 / depth, or depth where the picture is orthographic
  VI seen;    // node A of the cell times 4, 2 for the triangle DCB, 1 where it is seen from behind; -1: nothing
#if !CAST
  VF p, q, r; // edge functions across from the corners A, B, C or D, C, B
#endif
} Pixels;

#define CELL(plane) cells[(plane) * CELLS + cell]
#define EDGE(plane) (px * CELL(plane) + py * CELL((plane) + 1) + CELL((plane) + 2))

// Test pixels against one cell; `drawn` has bit 0 for ABC, bit 1 for DCB.
INLINE void draw_cell(SPACE const float *cells, int cell, uint drawn, int node, VF px, VF py, VF nearest, Pixels *at) {
  VF zero = 0.0f;
  if (drawn & 1u) {
    VF ab = EDGE(EDGE_AB), ca = EDGE(EDGE_CA), bc = EDGE(DIAGONAL_1);
    VI in = (ab >= zero) & (ca >= zero) & (bc >= zero);
    if (any_lane(in)) {
      VF z = EDGE(DEPTH_1);
      z = lesser(greater(z, (VF)(CELL(LOW_1))), (VF)(CELL(HIGH_1)));
      in = in & (z < at->z) & (z > nearest);
      at->z = SEL(at->z, z, in);
      at->seen = SEL(at->seen, (VI)(node * 4 + (as_int(CELL(BACK)) & 1)), in);
#if !CAST
      at->p = SEL(at->p, bc, in); at->q = SEL(at->q, ca, in); at->r = SEL(at->r, ab, in);
#endif
    }
  }
  if (drawn & 2u) {
    VF dc = EDGE(EDGE_DC), bd = EDGE(EDGE_BD), cb = EDGE(DIAGONAL_2);
    VI in = (dc >= zero) & (bd >= zero) & (cb >= zero);
    if (any_lane(in)) {
      VF z = EDGE(DEPTH_2);
      z = lesser(greater(z, (VF)(CELL(LOW_2))), (VF)(CELL(HIGH_2)));
      in = in & (z < at->z) & (z > nearest);
      at->z = SEL(at->z, z, in);
      at->seen = SEL(at->seen, (VI)(node * 4 + 2 + (as_int(CELL(BACK)) >> 1)), in);
#if !CAST
      at->p = SEL(at->p, cb, in); at->q = SEL(at->q, bd, in); at->r = SEL(at->r, dc, in);
#endif
    }
  }
}
#include "render/cells_shown.clh"

__kernel void tile_cells(__global const float *view, __global const uint2 *pairs, __global const uint *offsets,
                         __global const float *records, __global const float4 *nodes, int side, int grid_nodes,
                         int surface, int tiles_x, int tile_count, int bins_x, int bins_y, __global int *touched,
                         __global float *tile_planes) {
#if VW == 1
  int tile = get_group_id(0), pixel = get_local_id(0);
#else
  int tile = get_global_id(0);
#endif
  if (tile >= tile_count) return;
  tile = spread_tile(tile, tile_count);
  const int perspective = view[PERSPECTIVE] > 0.0f;
  const float unit = view[SCALE];
  // In front of the near plane: -1 / near is no larger than every -1 / depth behind it.
  const float nearest = perspective ? (view[NEAR] > 0.0f ? -unit / view[NEAR] : -INFINITY) : view[NEAR] / unit;
  SPACE float cells[PLANES * CELLS] __attribute__((aligned(64)));
  int x0 = tile % tiles_x * TILE_BINS, y0 = tile / tiles_x * TILE_BINS;
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) {
    int bin_x = x0 + i % TILE_BINS, bin_y = y0 + i / TILE_BINS;
    if (bin_x >= bins_x || bin_y >= bins_y) continue;
    int bin = bin_y * bins_x + bin_x, begin = offsets[bin], end = offsets[bin + 1], tests = 0;
    if (begin == end) continue;
    __global float *planes = tile_planes + (size_t)bin * BIN_PIXELS * FIELDS;
    int was_touched = touched[bin] >= 0;
    float bx = bin_x * BIN + 4.0f, by = bin_y * BIN + 4.0f;
#define START(at_) \
    VF before = EMPTY_DEPTH; \
    if (was_touched) before = load_plane(planes, FIELD_DEPTH, at_); \
    VF start = perspective ? -unit / before : before * (1.0f / unit);
#if VW == 1
    float px = (pixel & 7) - 3.5f, py = (pixel >> 3) - 3.5f;
    uint quarter = (pixel & 7) >> 2 | (pixel >> 5) << 1;
    Pixels here;
    START(pixel)
    here.z = start; here.seen = -1;
    for (int e = begin; e < end; e++) {
      __global const float *record = records + (size_t)INDEX_OF(pairs[e]) * CELL_RECORD;
      barrier(CLK_LOCAL_MEM_FENCE);
      if (pixel < CELLS) set_up(record, pixel, bx, by, perspective, cells);
      barrier(CLK_LOCAL_MEM_FENCE);
      uint mask_1 = as_uint(record[MASK_1]), mask_2 = as_uint(record[MASK_2]);
      int base = as_int(record[BASE_NODE]);
      for (int cell = 0; cell < CELLS; cell++) {
        uint drawn = (mask_1 >> cell & 1u) | (mask_2 >> cell & 1u) << 1;
        tests += drawn ? BIN_PIXELS : 0;
        if (drawn && as_int(CELL(QUARTERS)) >> quarter & 1)
          draw_cell(cells, cell, drawn, base + (cell >> 2) * side + (cell & 3), px, py, nearest, &here);
      }
    }
    show_pixels(view, nodes, side, grid_nodes, surface, &here, before, px + bx, py + by, planes, pixel);
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (pixel == 0) touched[bin] = (was_touched ? touched[bin] : 0) + tests;
#else
    Pixels all[64 / VW];
    for (int b = 0; b < 64 / VW; b++) {
      int quarter = b / (16 / VW), qx = (quarter & 1) * 4, qy = (quarter >> 1) * 4 + b % (16 / VW) * (VW / 4);
      START(qy * BIN + qx)
      all[b].z = start; all[b].seen = -1;
    }
    for (int e = begin; e < end; e++) {
      uint2 pair = pairs[e];
      // Behind everything in the quarters that the block may touch: nothing of it is seen.
      float key = near_of_key(pair.y);
      key = perspective ? -unit / key : key / unit;
      VI open = 0;
      for (int b = 0; b < 64 / VW; b++)
        if (pair.y >> (b / (16 / VW)) & 1u) open = open | (all[b].z > key) | (VI)(perspective & !(key < 0.0f) ? -1 : 0);
      if (!any_lane(open)) continue;
      __global const float *record = records + (size_t)INDEX_OF(pair) * CELL_RECORD;
      uint mask_1 = as_uint(record[MASK_1]), mask_2 = as_uint(record[MASK_2]), quarters[4] = {0, 0, 0, 0};
      int base = as_int(record[BASE_NODE]);
      for (int part = 0; part < CELLS; part += VW) {
        set_up(record, part, bx, by, perspective, cells);
        VI may = *(VI *)(cells + QUARTERS * CELLS + part);
        for (int q = 0; q < 4; q++) quarters[q] |= bits_of_lanes((may & (1 << q)) != 0) << part;
      }
      for (int q = 0; q < 4; q++) {
        uint todo = quarters[q] & (mask_1 | mask_2);
        while (todo) {
          int cell = FIRST_BIT(todo);
          todo &= todo - 1u;
          tests += 16;
          uint drawn = (mask_1 >> cell & 1u) | (mask_2 >> cell & 1u) << 1;
          for (int b = q * (16 / VW); b < (q + 1) * (16 / VW); b++) {
            int qx = (q & 1) * 4, qy = (q >> 1) * 4 + b % (16 / VW) * (VW / 4);
            VF px = TO_VF(LANE_INDEX & 3) + (qx - 3.5f), py = TO_VF(LANE_INDEX >> 2) + (qy - 3.5f);
            draw_cell(cells, cell, drawn, base + (cell >> 2) * side + (cell & 3), px, py, nearest, &all[b]);
          }
        }
      }
    }
    for (int b = 0; b < 64 / VW; b++) {
      int q = b / (16 / VW), qx = (q & 1) * 4, qy = (q >> 1) * 4 + b % (16 / VW) * (VW / 4);
      VF px = TO_VF(LANE_INDEX & 3) + (qx - 3.5f), py = TO_VF(LANE_INDEX >> 2) + (qy - 3.5f);
      START(qy * BIN + qx)
      show_pixels(view, nodes, side, grid_nodes, surface, &all[b], before, px + bx, py + by, planes, qy * BIN + qx);
    }
    touched[bin] = (was_touched ? touched[bin] : 0) + tests;
#endif
  }
}
