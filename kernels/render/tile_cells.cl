// Draw the cells of every bin into its planes: the triangle that is seen at each pixel's centre, then what it shows.
//
// CAST: the nodes are a scale map's texels, and the ray of the pixel meets the map's own interpolated surface within the
// cell that its triangles have found. Otherwise (a geosphere) the triangle itself is drawn, its normals interpolated.
//
// One work-item per tile (VW lanes are pixels of 4x4 blocks), or a work-group of 64 per tile (VW = 1: one bin's pixels at
// a time). Twins: the net's triangles by brute force, and the interpolated map itself (tests/test_render_scale_map.py,
// test_tile_cells).
#include "render/cells.clh"
#include "common/planes.clh"
#include "render/scale_sample.clh"
#include "common/clip.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#ifndef CAST
#define CAST 1
#endif
#define GRIDS (CAST ? 6 : 10)  // of one layer
#define FIRST_BIT LOWEST_BIT
typedef struct {
  VF z;       // -1 / depth, or depth where the picture is orthographic
  VI seen;    // node A of the cell times 4, 2 for the triangle DCB, 1 where it is seen from behind; -1: nothing
#if CLIP_PLANES
  VF near;    // the same of the least depth that is drawn
#endif
#if !CAST
  VF p, q, r; // edge functions across from the corners A, B, C or D, C, B
#endif
} Pixels;

#define CELL(plane) cells[(plane) * CELLS + cell]
#define EDGE(plane) (px * CELL(plane) + py * CELL((plane) + 1) + CELL((plane) + 2))

// Test pixels against one triangle; px, py are relative to the block's centre, `seen` is what a pixel keeps of it.
INLINE void draw_triangle(__global const float *cells, int cell, int across_p, int across_q, int across_r, int depth,
                          int low, int seen, VF px, VF py, VF nearest, Pixels *at) {
  VF zero = 0.0f, p = EDGE(across_p), q = EDGE(across_q), r = EDGE(across_r);
  VI in = (p >= zero) & (q >= zero) & (r >= zero);
  if (!any_lane(in)) return;
  VF z = EDGE(depth);
  z = lesser(greater(z, (VF)(CELL(low))), (VF)(CELL(low + 1)));
#if CLIP_PLANES
  in = in & (z < at->z) & (z > at->near);
#else
  in = in & (z < at->z) & (z > nearest);
#endif
  at->z = SEL(at->z, z, in);
  at->seen = SEL(at->seen, (VI)(seen), in);
#if !CAST
  at->p = SEL(at->p, p, in); at->q = SEL(at->q, q, in); at->r = SEL(at->r, r, in);
#endif
}

INLINE void draw_cell(__global const float *record, int cell, int node, VF px, VF py, VF nearest, Pixels *at) {
  __global const float *cells = record + HEAD;
  if (as_uint(record[MASK_1]) >> cell & 1u)
    draw_triangle(cells, cell, DIAGONAL_1, EDGE_CA, EDGE_AB, DEPTH_1, LOW_1,
                  4 * node + (as_int(record[BACK_1]) >> cell & 1), px, py, nearest, at);
  if (as_uint(record[MASK_2]) >> cell & 1u)
    draw_triangle(cells, cell, DIAGONAL_2, EDGE_BD, EDGE_DC, DEPTH_2, LOW_2,
                  4 * node + 2 + (as_int(record[BACK_2]) >> cell & 1), px, py, nearest, at);
}
#include "render/cells_shown.clh"

// Start a pixel behind what it shows, or where clip planes end what is drawn.
INLINE void start_pixels(__global const float *view, VF px, VF py, VF before, Pixels *at) {
  const int perspective = view[PERSPECTIVE] > 0.0f;
  const float unit = view[SCALE];
  at->seen = -1;
#if CLIP_PLANES
  VF low = view[NEAR], high = before, none = -INFINITY;
  clip_range(view, px, py, &low, &high);
  at->near = perspective ? SEL(none, -unit / low, low > 0.0f) : low / unit;
  at->z = perspective ? SEL(none, -unit / high, high > 0.0f) : high / unit;
#else
  at->z = perspective ? -unit / before : before * (1.0f / unit);
#endif
}

__kernel void tile_cells(__global const float *view, __global const uint2 *pairs, __global const uint *offsets,
                         __global const float *records, __global const float4 *nodes, int side, int grid_nodes,
                         int first_layer, int surface, int tiles_x, int tile_count, int bins_x, int bins_y,
                         __global int *touched, __global float *tile_planes) {
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
  int x0 = tile % tiles_x * TILE_BINS, y0 = tile / tiles_x * TILE_BINS;
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) {
    int bin_x = x0 + i % TILE_BINS, bin_y = y0 + i / TILE_BINS;
    if (bin_x >= bins_x || bin_y >= bins_y) continue;
    int bin = bin_y * bins_x + bin_x, begin = offsets[bin], end = offsets[bin + 1], tests = 0;
    if (begin == end) continue;
    __global float *planes = tile_planes + (size_t)bin * BIN_PIXELS * FIELDS;
    int was_touched = touched[bin] >= 0;
    float bx = bin_x * BIN + 4.0f, by = bin_y * BIN + 4.0f;
#define BEFORE(at_) VF before = was_touched ? load_plane(planes, FIELD_DEPTH, at_) : (VF)(EMPTY_DEPTH);
#if VW == 1
    float px = bx + (pixel & 7) - 3.5f, py = by + (pixel >> 3) - 3.5f;
    Pixels here;
    BEFORE(pixel)
    start_pixels(view, px, py, before, &here);
    for (int e = begin; e < end; e++) {
      __global const float *record = records + (size_t)INDEX_OF(pairs[e]) * CELL_RECORD;
      int base = as_int(record[BASE_NODE]);
      float x = px - record[CENTER_X], y = py - record[CENTER_Y];
      for (uint todo = as_uint(record[MASK_1]) | as_uint(record[MASK_2]); todo; todo &= todo - 1u) {
        int cell = FIRST_BIT(todo);
        __global const float *cells = record + HEAD;
        tests += BIN_PIXELS;
        if (x >= CELL(LEFT) && x <= CELL(RIGHT) && y >= CELL(TOP) && y <= CELL(BOTTOM))
          draw_cell(record, cell, base + (cell >> 2) * side + (cell & 3), x, y, nearest, &here);
      }
    }
    show_pixels(view, nodes, side, grid_nodes, first_layer, surface, &here, before, px, py, planes, pixel);
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (pixel == 0) touched[bin] = (was_touched ? touched[bin] : 0) + tests;
#else
    Pixels all[64 / VW];
    for (int b = 0; b < 64 / VW; b++) {
      int quarter = b / (16 / VW), qx = (quarter & 1) * 4, qy = (quarter >> 1) * 4 + b % (16 / VW) * (VW / 4);
      BEFORE(qy * BIN + qx)
      VF px = TO_VF(LANE_INDEX & 3) + (bx + qx - 3.5f), py = TO_VF(LANE_INDEX >> 2) + (by + qy - 3.5f);
      start_pixels(view, px, py, before, &all[b]);
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
      uint drawn = as_uint(record[MASK_1]) | as_uint(record[MASK_2]), quarters[4] = {0, 0, 0, 0};
      int base = as_int(record[BASE_NODE]);
      float ox = bx - record[CENTER_X], oy = by - record[CENTER_Y];
      for (int part = 0; part < CELLS; part += VW) {  // the quarters of the bin whose pixels' centres a cell may hold
        __global const float *cells = record + HEAD + part;
        VF left = *(__global const VF *)(cells + LEFT * CELLS), right = *(__global const VF *)(cells + RIGHT * CELLS);
        VF top = *(__global const VF *)(cells + TOP * CELLS), bottom = *(__global const VF *)(cells + BOTTOM * CELLS);
        VI in_left = (left <= ox - 0.5f) & (right >= ox - 3.5f), in_right = (left <= ox + 3.5f) & (right >= ox + 0.5f);
        VI above = (top <= oy - 0.5f) & (bottom >= oy - 3.5f), below = (top <= oy + 3.5f) & (bottom >= oy + 0.5f);
        quarters[0] |= bits_of_lanes(in_left & above) << part; quarters[1] |= bits_of_lanes(in_right & above) << part;
        quarters[2] |= bits_of_lanes(in_left & below) << part; quarters[3] |= bits_of_lanes(in_right & below) << part;
      }
      for (int q = 0; q < 4; q++)
        for (uint todo = quarters[q] & drawn; todo; todo &= todo - 1u) {
          int cell = FIRST_BIT(todo), node = base + (cell >> 2) * side + (cell & 3);
          tests += 16;
          for (int b = q * (16 / VW); b < (q + 1) * (16 / VW); b++) {
            int qx = (q & 1) * 4, qy = (q >> 1) * 4 + b % (16 / VW) * (VW / 4);
            VF px = TO_VF(LANE_INDEX & 3) + (ox + qx - 3.5f), py = TO_VF(LANE_INDEX >> 2) + (oy + qy - 3.5f);
            draw_cell(record, cell, node, px, py, nearest, &all[b]);
          }
        }
    }
    for (int b = 0; b < 64 / VW; b++) {
      int q = b / (16 / VW), qx = (q & 1) * 4, qy = (q >> 1) * 4 + b % (16 / VW) * (VW / 4);
      VF px = TO_VF(LANE_INDEX & 3) + (qx - 3.5f), py = TO_VF(LANE_INDEX >> 2) + (qy - 3.5f);
      BEFORE(qy * BIN + qx)
      show_pixels(view, nodes, side, grid_nodes, first_layer, surface, &all[b], before, px + bx, py + by, planes,
                  qy * BIN + qx);
    }
    touched[bin] = (was_touched ? touched[bin] : 0) + tests;
#endif
  }
}
