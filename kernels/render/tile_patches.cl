// Draw the patches of every tile: their cells compete for its pixels, then the winners' depth, normal and colour at the
// pixels' centres go into the planes, or, where the surface is the frame's only one, shaded into the picture.
//
// VW > 1: one work-item per tile; lanes are the cells of a row, or 4x4 pixels of one cell where cells are large. VW = 1:
// one work-group of 64 work-items per tile, each a cell, then a pixel. Twin: tests/reference/render_patches.py.
#include "render/patch_draw.clh"
#include "render/patch_winners.clh"

#if VW > 1
typedef CAT(short, VW) __attribute__((aligned(2))) BoxesAt;
#define BOXES_AT(at) TO_VI(*(__global const BoxesAt *)(boxes + (at)))

// The largest key of a bin of the tile: what lies behind it cannot show there.
INLINE uint farthest_of(const ulong *slots, int bin) {
  const ulong *row = slots + (bin / TILE_BINS * TILE + bin % TILE_BINS) * BIN;
  ulong8 most = *(const ulong8 *)row;
  for (int y = 1; y < BIN; y++) {
    ulong8 next = *(const ulong8 *)(row + y * TILE);
    most = next > most ? next : most;
  }
  ulong4 four = most.lo > most.hi ? most.lo : most.hi;
  ulong2 two = four.lo > four.hi ? four.lo : four.hi;
  return (uint)((two.x > two.y ? two.x : two.y) >> 32);
}
#endif

#define HITS 1024    // patches that are sorted and drawn at a time
#define CLASSES 64   // of depth

INLINE void draw_hit(Target *to, Patches patches, Nodes nodes, int k, int4 box, int item) {
  __global const float *h = patches.records + (size_t)k * PATCH_STRIDE;
  int perspective = to->view[PERSPECTIVE] > 0.0f, m = patches.sizes[2 * k], n = patches.sizes[2 * k + 1];
  int flags = as_int(h[PATCH_FLAGS]);
  uint first = patches.offsets[k];
  to->limits = box;
#if VW > 1
  // What shows will be read in no order.
  for (int i = 0; i < m * n && !(flags & PATCH_LARGE); i += 4) PREFETCH(nodes.nodes + first + i);
#endif
#if LATTICE
  draw_lattice(to, nodes, h, perspective, first, m, n, item);
#else
  if (flags & PATCH_DIRECT) draw_nodes(to, nodes, h, perspective, first, m, n, item);
#if VW == 1
  else if (flags & PATCH_CLIPPED) draw_large(to, nodes, h, perspective, first, m, n, item);
#else
  else if (flags & (PATCH_CLIPPED | PATCH_LARGE)) draw_large(to, nodes, h, perspective, first, m, n, item);
#endif
  else draw_patch(to, nodes, h, perspective, first, m, n, flags & PATCH_LARGE, item);
#endif
}

__kernel void tile_patches(__global const float *view, __global const short *boxes /* bins */, int stride,
                           __global const float *records, __global const int *sizes, __global const uint *offsets,
                           int count, __global const float *steps, __global const ushort *rims,
                           __global const uint4 *all_nodes, __global const float *twists, int surface, int tiles_x,
                           int tile_count, int bins_x, int bins_y, __global int *touched, __global float *all_planes,
                           __global float4 *color, __global float *depth, __global float *normal,
                           __global float *position, __global int *id, __global int *number, __global int *level,
                           __global int *cost_out) {
  Patches patches = {records, sizes, offsets, count};
  Nodes nodes = {steps, rims, all_nodes, twists};
  Target to;
  to.view = view;
#if VW == 1
  __local uint slots[TILE * TILE * 2] __attribute__((aligned(16)));
  __local int cost[TILE_BINS * TILE_BINS], any;
  int tile = get_group_id(0), item = get_local_id(0);
#else
  ulong slots[TILE * TILE] __attribute__((aligned(64)));
  int cost[TILE_BINS * TILE_BINS], any = 0;
  int tile = get_global_id(0), item = 0;
#endif
  if (tile >= tile_count) return;
  tile = spread_tile(tile, tile_count);
  int width = (int)view[WIDTH], height = (int)view[HEIGHT];
  int bin_x = tile % tiles_x * TILE_BINS, bin_y = tile / tiles_x * TILE_BINS;
#if MASKED
  int some_wanted = 0;
  uchar wanted[TILE_BINS * TILE_BINS];
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) {
    int x = bin_x + i % TILE_BINS, y = bin_y + i / TILE_BINS;
    wanted[i] = x < bins_x && y < bins_y && WANTED(y * bins_x + x);
    some_wanted |= wanted[i];
  }
  if (!some_wanted) return;
#if VW == 1  // the array did not outlive PoCL's barriers
#define WANTED_HERE(b) WANTED((bin_y + (b) / TILE_BINS) * bins_x + bin_x + (b) % TILE_BINS)
#else
#define WANTED_HERE(bin) wanted[bin]
#endif
#else
#define WANTED_HERE(bin) 1
#endif
  to.x = bin_x * BIN; to.y = bin_y * BIN;
  to.slots = slots;
  to.cost = cost;
  int4 whole = (int4)(to.x, to.y, (to.x + TILE < width ? to.x + TILE : width) - 1,
                      (to.y + TILE < height ? to.y + TILE : height) - 1);
#define BOX(k) (int4)(boxes[k], boxes[stride + (k)], boxes[2 * stride + (k)], boxes[3 * stride + (k)])
#define CLIPPED_TO(b) (int4)(max(whole.x, b.x * BIN), max(whole.y, b.y * BIN), min(whole.z, b.z * BIN + BIN - 1), \
                             min(whole.w, b.w * BIN + BIN - 1))
#if VW == 1
  if (item == 0) any = 0;
  for (int i = item; i < TILE_BINS * TILE_BINS; i += GROUP) cost[i] = 0;
  for (int i = item; i < TILE * TILE * 2; i += GROUP) slots[i] = NO_SAMPLE;
  SYNC;
  for (to.round = 0; to.round < ROUNDS; to.round++) {
    for (int k = 0; k < count; k++) {
      int4 b = BOX(k);
      if (b.x > bin_x + TILE_BINS - 1 || b.z < bin_x || b.y > bin_y + TILE_BINS - 1 || b.w < bin_y) continue;
      any = 1;
      draw_hit(&to, patches, nodes, k, CLIPPED_TO(b), item);
    }
    SYNC;
  }
#else
  for (int k = 0; k < count;) {
    int hits[HITS], sorted[HITS], found = 0, starts[CLASSES + 1];
    for (; k < count && found <= HITS - VW; k += VW) {
      VI touched_here = ((VI)(k) + LANE_INDEX < count) & (BOXES_AT(k) < bin_x + TILE_BINS)
                      & (BOXES_AT(stride + k) < bin_y + TILE_BINS) & (BOXES_AT(2 * stride + k) >= bin_x)
                      & (BOXES_AT(3 * stride + k) >= bin_y);
      if (any_lane(touched_here))
        for (uint bits = lane_mask(touched_here); bits; bits &= bits - 1) hits[found++] = k + FIRST_LANE(bits);
    }
    if (!found) continue;
    if (!any) {
      ulong8 none = NO_SLOT;
      for (int i = 0; i < TILE * TILE / 8; i++) ((ulong8 *)slots)[i] = none;
      for (int i = 0; i < TILE_BINS * TILE_BINS; i++) cost[i] = 0;
      any = 1;
    }
    // Front to back, so that what is hidden is seen to be.
    float least = INFINITY, most = -INFINITY;
    for (int i = 0; i < found; i++) {
      float z = records[(size_t)hits[i] * PATCH_STRIDE + PATCH_NEAR];
      least = z < least ? z : least; most = z > most ? z : most;
    }
    float per = most > least ? (CLASSES - 1) / (most - least) : 0.0f;
    for (int i = 0; i <= CLASSES; i++) starts[i] = 0;
#define CLASS_OF(k) (int)((records[(size_t)(k) * PATCH_STRIDE + PATCH_NEAR] - least) * per)
    for (int i = 0; i < found; i++) starts[CLASS_OF(hits[i]) + 1]++;
    for (int i = 0; i < CLASSES; i++) starts[i + 1] += starts[i];
    for (int i = 0; i < found; i++) sorted[starts[CLASS_OF(hits[i])]++] = hits[i];
    uint farthest[TILE_BINS * TILE_BINS];
    uchar stale[TILE_BINS * TILE_BINS];
    for (int i = 0; i < TILE_BINS * TILE_BINS; i++) { farthest[i] = WANTED_HERE(i) ? NO_SAMPLE : 0u; stale[i] = 0; }
    for (int i = 0; i < found; i++) {
      int p = sorted[i];
      int4 b = BOX(p);
      int x0 = max(b.x, bin_x) - bin_x, x1 = min(b.z, bin_x + TILE_BINS - 1) - bin_x;
      int y0 = max(b.y, bin_y) - bin_y, y1 = min(b.w, bin_y + TILE_BINS - 1) - bin_y;
      float layer = (records[(size_t)p * PATCH_STRIDE + PATCH_NEAR] - view[FIRST_DEPTH]) * view[LAYER] - 2.0f;
      layer = layer < 0.0f ? 0.0f : layer > LAST_LAYER ? LAST_LAYER : layer;
      uint key = (uint)layer << 12;
      int shows = 0;
      for (int y = y0; y <= y1 && !shows; y++)
        for (int x = x0; x <= x1 && !shows; x++) {
          int bin = y * TILE_BINS + x;
          if (stale[bin] && WANTED_HERE(bin)) { farthest[bin] = farthest_of(slots, bin); stale[bin] = 0; }
          shows = farthest[bin] >= key && WANTED_HERE(bin);
        }
      if (!shows) continue;
      for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++) stale[y * TILE_BINS + x] = 1;
      draw_hit(&to, patches, nodes, p, CLIPPED_TO(b), 0);
    }
  }
#endif
#if FUSED
  Channels out = {color, depth, normal, position, id, number, level, cost_out};
  __global const float *frame = view + VIEW_FLOATS, *shading = view + 2 * VIEW_FLOATS;
#if VW == 1
  for (int p = item; p < TILE * TILE; p += GROUP) {
    int x = to.x + p % TILE, y = to.y + p / TILE;
    if (x > whole.z || y > whole.w) continue;
    if (!any) { background_row(shading, width, x, y, 1, out); continue; }
    Shown s = resolve(view, patches, nodes, payload_of(&to, SLOT_OF(p % TILE, p / TILE)), x + 0.5f, y + 0.5f);
    s.id = surface;
    shade_row(frame, shading, &s, width, x, y, 1, out);
#if WRITE_COST
    cost_out[y * width + x] = cost[p / TILE / BIN * TILE_BINS + p % TILE / BIN];
#endif
  }
#else
  if (!any) {
    for (int y = to.y; y <= whole.w; y++) background_row(shading, width, to.x, y, whole.z + 1 - to.x, out);
    return;
  }
  // Strips of VW pixels, as many rows as blocks of 4 pixels have: blocks are resolved, rows are shaded.
  for (int y = to.y; y <= whole.w; y += VW / 4)
    for (int x = to.x; x <= whole.z; x += VW) {
      Shown blocks[VW / 4];
      int some = 0;
      for (int b = 0; b < VW / 4; b++) {
        int block = x + 4 * b < to.x + TILE ? x + 4 * b : x;  // past the tile's edge: anything
        VU payload = payload_of(&to, SLOT_OF(block - to.x, y - to.y));
        VF px = TO_VF((VI)(block) + (LANE_INDEX & 3)) + 0.5f, py = TO_VF((VI)(y) + (LANE_INDEX >> 2)) + 0.5f;
        blocks[b] = resolve(view, patches, nodes, payload, px, py);
        some |= any_lane(payload != (VU)(NO_SAMPLE));
      }
      int lanes = whole.z + 1 - x < VW ? whole.z + 1 - x : VW;
      for (int r = 0; r < VW / 4 && y + r <= whole.w; r++) {
        if (some) {
          Shown row;
          row.id = surface;
#if VW == 16
#define PIECE(f, type, b) ((const type *)&blocks[b].f)[r]
#define ROW_OF(f, vector, type) row.f = (vector)(PIECE(f, type, 0), PIECE(f, type, 1), PIECE(f, type, 2), PIECE(f, type, 3));
#else
#define ROW_OF(f, vector, type) for (int b = 0; b < VW / 4; b++) ((type *)&row.f)[b] = ((const type *)&blocks[b].f)[r];
#endif
          ROW_OF(depth, VF, float4) ROW_OF(nx, VF, float4) ROW_OF(ny, VF, float4) ROW_OF(nz, VF, float4)
#if FIELD_COLOR >= 0
          ROW_OF(red, VF, float4) ROW_OF(green, VF, float4) ROW_OF(blue, VF, float4)
#endif
#if FIELD_COUNT >= 0
          ROW_OF(count, VI, int4)
#endif
#if FIELD_LEVEL >= 0
          ROW_OF(level, VI, int4)
#endif
          shade_row(frame, shading, &row, width, x, y + r, lanes, out);
        } else background_row(shading, width, x, y + r, lanes, out);
#if WRITE_COST
        for (int i = 0; i < lanes; i++)
          cost_out[(size_t)(y + r) * width + x + i] = cost[(y + r - to.y) / BIN * TILE_BINS + (x + i - to.x) / BIN];
#endif
      }
    }
#endif
#else
  if (!any) return;
  for (int b = 0; b < TILE_BINS * TILE_BINS; b++) {
    int x = bin_x + b % TILE_BINS, y = bin_y + b / TILE_BINS;
    if (x >= bins_x || y >= bins_y || !WANTED_HERE(b)) continue;
    int bin = y * bins_x + x, was_touched = touched[bin] >= 0;
    __global float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS;
#if VW == 1
    int px = x * BIN + item % BIN, py = y * BIN + item / BIN;
    Shown s = resolve(view, patches, nodes, payload_of(&to, SLOT_OF(px - to.x, py - to.y)), px + 0.5f, py + 0.5f);
    store_block(planes, was_touched, item, &s, surface);
#else
    for (int q = 0; q < 64 / VW; q++) {
      int qx = q / (16 / VW) % 2 * 4, qy = q / (32 / VW) * 4 + q % (16 / VW) * (VW / 4);
      int sx = b % TILE_BINS * BIN + qx, sy = b / TILE_BINS * BIN + qy;
      VF px = TO_VF((VI)(to.x + sx) + (LANE_INDEX & 3)) + 0.5f, py = TO_VF((VI)(to.y + sy) + (LANE_INDEX >> 2)) + 0.5f;
      Shown s = resolve(view, patches, nodes, payload_of(&to, SLOT_OF(sx, sy)), px, py);
      store_block(planes, was_touched, qy * BIN + qx, &s, surface);
    }
    touched[bin] = (was_touched ? touched[bin] : 0) + cost[b];
#endif
  }
#if VW == 1
  // All have read it by then; a barrier in the loop above, which some tiles leave early, made PoCL crash.
  barrier(CLK_GLOBAL_MEM_FENCE);
  for (int b = item; b < TILE_BINS * TILE_BINS; b += GROUP) {
    int x = bin_x + b % TILE_BINS, y = bin_y + b / TILE_BINS, bin = y * bins_x + x;
    if (x < bins_x && y < bins_y && WANTED_HERE(b)) touched[bin] = (touched[bin] >= 0 ? touched[bin] : 0) + cost[b];
  }
#endif
#endif
}
