// Draw the points of every tile: their discs compete for its pixels, then the winners' depth, normal and colour at the
// pixels' centres go into the planes. The same forms as tile_triangles. Twin: tests/reference/render_points.py, tile_points.
#include "render/point_draw.clh"

#ifndef UNLIT
#define UNLIT 0  // 1: colours are final: stored negative, as kernels/common/planes.clh says
#endif

// What the winners show at pixels (px, py); `payload` NO_SAMPLE: nothing.
INLINE void resolve(__global const float *view, __global const float *points, size_t stride, __global const int *drawn,
                    __global const uchar4 *colors, __global const float *linear, VU payload, VF px, VF py, Seen *seen) {
  Seen out;
  VF zero = 0.0f, one = 1.0f, away;
  out.depth = EMPTY_DEPTH;
  out.nx = zero; out.ny = zero; out.nz = one; out.red = zero; out.green = zero; out.blue = zero;
  VI shown = payload != (VU)(NO_SAMPLE);
  uint some = lane_mask(shown);
  *seen = out;
  if (!some) return;
  payload = SEL((VU)(((const uint *)&payload)[FIRST_LANE(some)]), payload, shown);
  const uint *at = (const uint *)&payload;
  VF x, y, z, radius, nx = zero, ny = zero, nz = zero;
#define FETCHED(v, plane) for (int l = 0; l < VW; l++) ((float *)&v)[l] = points[(plane) * stride + at[l]];
  FETCHED(x, PX) FETCHED(y, PY) FETCHED(z, PZ) FETCHED(radius, PRADIUS)
  for (int l = 0; l < VW; l++) ((float *)&radius)[l] *= LARGER(drawn[at[l] / POINT_RUN]);
#if HAS_NORMALS
  FETCHED(nx, PNORMAL) FETCHED(ny, PNORMAL + 1) FETCHED(nz, PNORMAL + 2)
#endif
  Disc d;
  Lens lens;
  disc_of(view, x, y, z, radius, nx, ny, nz, &d);
  lens_of(view, &lens);
  VF depth = disc_depth(lens, &d, px, py, &away);
#if !HAS_NORMALS
  depth += BULGE * d.radius * VMIN(away, (VF)(4.0f));
#endif
  out.depth = SEL(out.depth, depth, shown);
  VF ex = zero, ey = zero;  // towards the eye, z 1
  if (view[PERSPECTIVE] > 0.0f) { ex = (px - view[CX]) * (-1.0f / view[FX]); ey = (py - view[CY]) * (1.0f / view[FY]); }
#if HAS_NORMALS
  // Discs are two-sided: what looks away from the eye is turned over, by what it shows at its middle, and mirrored where
  // that is at its rim.
  VF a = TURNED(0, nx, ny, nz), b = TURNED(1, nx, ny, nz), c = TURNED(2, nx, ny, nz);
  VI over = c - a * d.gx - b * d.gy < 0.0f;
  a = SEL(a, -a, over); b = SEL(b, -b, over); c = SEL(c, -c, over);
  VF side = a * ex + b * ey + c, mirror = 2.0f * side / (ex * ex + ey * ey + one);
  mirror = SEL(zero, mirror, side < 0.0f);
  a -= mirror * ex; b -= mirror * ey; c -= mirror;
  VI none = a * a + b * b + c * c < 1e-24f;
  out.nx = SEL(a, ex, none); out.ny = SEL(b, ey, none); out.nz = SEL(c, one, none);
#else
  out.nx = ex; out.ny = ey; out.nz = one;
#endif
#if FIELD_COLOR >= 0
#if HAS_COLOR
  for (int l = 0; l < VW; l++) {
    uchar4 rgb = colors[at[l]];
    ((float *)&out.red)[l] = linear[rgb.x]; ((float *)&out.green)[l] = linear[rgb.y]; ((float *)&out.blue)[l] = linear[rgb.z];
  }
#else
  out.red = view[FLAT_COLOR]; out.green = view[FLAT_COLOR + 1]; out.blue = view[FLAT_COLOR + 2];
#endif
#if UNLIT
  out.red = -out.red; out.green = -out.green; out.blue = -out.blue;
#endif
#endif
  *seen = out;
}

__kernel void tile_points(__global const float *view, __global const uint2 *pairs, __global const uint *offsets,
                          __global const short4 *boxes, __global const float *points, int stride, int count,
                          __global const int *drawn, __global const uchar4 *colors, __global const float *linear,
                          int surface, int tiles_x, int tile_count, int bins_x, int bins_y, __global int *touched,
                          __global float *all_planes) {
  Target to;
  to.view = view;
#if VW == 1
  __local uint slots[TILE * TILE * 2] __attribute__((aligned(16)));
  __local int cost[TILE_BINS * TILE_BINS];
  int tile = get_group_id(0), item = get_local_id(0);
#else
  ulong slots[TILE * TILE] __attribute__((aligned(64)));
  int cost[TILE_BINS * TILE_BINS], item = 0;
#endif
#if VW > 1
  int tile = get_global_id(0);
#endif
  if (tile >= tile_count) return;
  tile = spread_tile(tile, tile_count);
  uint begin = offsets[tile], end = offsets[tile + 1];
  if (begin == end) return;
  int width = (int)view[WIDTH], height = (int)view[HEIGHT];
  int bin_x = tile % tiles_x * TILE_BINS, bin_y = tile / tiles_x * TILE_BINS;
#if MASKED
  int some_wanted = 0;
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) {
    int x = bin_x + i % TILE_BINS, y = bin_y + i / TILE_BINS;
    some_wanted |= x < bins_x && y < bins_y && WANTED(y * bins_x + x);
  }
  if (!some_wanted) return;
#endif
  to.x = bin_x * BIN; to.y = bin_y * BIN;
  to.slots = slots;
  to.cost = cost;
  to.limits = (int4)(to.x, to.y, (to.x + TILE < width ? to.x + TILE : width) - 1,
                     (to.y + TILE < height ? to.y + TILE : height) - 1);
#if VW == 1
  for (int i = item; i < TILE_BINS * TILE_BINS; i += GROUP) cost[i] = 0;
  for (int i = item; i < TILE * TILE * 2; i += GROUP) slots[i] = NO_SAMPLE;
  SYNC;
  for (to.round = 0; to.round < ROUNDS; to.round++) {
    for (uint e = begin; e < end; e++) {
      uint run = INDEX_OF(pairs[e]), first = run * POINT_RUN;
      for (int i = item; i < drawn[run]; i += GROUP)
        draw_points(&to, points, stride, first + i, LARGER(drawn[run]), 1);
    }
    SYNC;
  }
#else
  ulong8 none = NO_SLOT;
  for (int i = 0; i < TILE * TILE / 8; i++) ((ulong8 *)slots)[i] = none;
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) cost[i] = 0;
  Hidden hidden;
  start_hidden(&hidden);
  for (uint e = begin; e < end; e++) {
    uint2 pair = pairs[e];
    uint run = INDEX_OF(pair);
    if (is_hidden(&hidden, slots, boxes[run], bin_x, bin_y, ordered_one(near_of_key(pair.y)))) continue;
    int use = drawn[run];
    for (int i = 0; i < use; i += VW)
      draw_points(&to, points, stride, run * POINT_RUN + i, LARGER(use), VW);
  }
#endif
  for (int b = 0; b < TILE_BINS * TILE_BINS; b++) {
    int x = bin_x + b % TILE_BINS, y = bin_y + b / TILE_BINS;
    if (x >= bins_x || y >= bins_y) continue;
    int bin = y * bins_x + x, was_touched = touched[bin] >= 0;
    if (!WANTED(bin)) continue;
    __global float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS;
#if VW == 1
    int px = x * BIN + item % BIN, py = y * BIN + item / BIN;
    Seen s;
    resolve(view, points, stride, drawn, colors, linear, payload_of(&to, SLOT_OF(px - to.x, py - to.y)), px + 0.5f,
            py + 0.5f, &s);
    store_seen(planes, was_touched, item, &s, surface);
#else
    for (int q = 0; q < 64 / VW; q++) {
      int qx = q / (16 / VW) % 2 * 4, qy = q / (32 / VW) * 4 + q % (16 / VW) * (VW / 4);
      int sx = b % TILE_BINS * BIN + qx, sy = b / TILE_BINS * BIN + qy;
      VF px = TO_VF((VI)(to.x + sx) + (LANE_INDEX & 3)) + 0.5f, py = TO_VF((VI)(to.y + sy) + (LANE_INDEX >> 2)) + 0.5f;
      Seen s;
      resolve(view, points, stride, drawn, colors, linear, payload_of(&to, SLOT_OF(sx, sy)), px, py, &s);
      store_seen(planes, was_touched, qy * BIN + qx, &s, surface);
    }
    touched[bin] = (was_touched ? touched[bin] : 0) + cost[b];
#endif
  }
#if VW == 1
  // All have read it by then; a barrier in the loop above, which some tiles leave early, made PoCL crash.
  barrier(CLK_GLOBAL_MEM_FENCE);
  for (int b = item; b < TILE_BINS * TILE_BINS; b += GROUP) {
    int x = bin_x + b % TILE_BINS, y = bin_y + b / TILE_BINS, bin = y * bins_x + x;
    if (x < bins_x && y < bins_y && WANTED(bin)) touched[bin] = (touched[bin] >= 0 ? touched[bin] : 0) + cost[b];
  }
#endif
}
