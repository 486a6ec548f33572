// Draw the faces of every tile: they compete for its pixels, then the winners' depth, normal and colour at the pixels'
// centres go into the planes.
//
// VW > 1: one work-item per tile; lanes are faces, or pixels of one face where it is large. VW = 1: one work-group of 64
// work-items per tile, each a face, then a pixel. Twin: tests/reference/render_triangles.py, tile_triangles.
#include "render/triangle_draw.clh"

#ifndef HAS_NORMALS
#define HAS_NORMALS 0  // 1: normals of vertices, 0: of faces
#endif

// Interpolated normals that look away from the eye: turned over where the face, which counts as looking to the same side as
// them, shows its back. Elsewhere, at contours, only what points away is mirrored: turned over they would point almost the
// other way.
INLINE void face_eye(VF fx, VF fy, VF fz, VF ex, VF ey, VF *nx, VF *ny, VF *nz) {
  VF side = *nx * ex + *ny * ey + *nz, along = fx * *nx + fy * *ny + fz * *nz, back = fx * ex + fy * ey + fz;
  VI away = side < 0.0f, over = away & ((back < 0.0f) == (along > 0.0f));
  VF mirror = 2.0f * side / (ex * ex + ey * ey + 1.0f);
  mirror = SEL((VF)(0.0f), mirror, away);
  *nx = SEL(*nx - mirror * ex, -*nx, over); *ny = SEL(*ny - mirror * ey, -*ny, over); *nz = SEL(*nz - mirror, -*nz, over);
}

#define TURNED(row, p, q, s) (view[3 * (row)] * (p) + view[3 * (row) + 1] * (q) + view[3 * (row) + 2] * (s))
#define MIXED(i) (a[i] + wb * (b[i] - a[i]) + wc * (c[i] - a[i]))  // exact where all three are equal

// What the winners show at pixels (px, py); `payload` NO_SAMPLE: nothing.
INLINE Seen resolve(__global const float *view, __global const float4 *points, __global const int *faces,
                    __global const float4 *positions, __global const float4 *normals, __global const float4 *colors,
                    VU payload, VF px, VF py) {
  Seen out;
  VF zero = 0.0f, one = 1.0f;
  out.depth = EMPTY_DEPTH;
  out.nx = zero; out.ny = zero; out.nz = one; out.red = zero; out.green = zero; out.blue = zero;
  VI shown = payload != (VU)(NO_SAMPLE);
  uint some = lane_mask(shown);
  if (!some) return out;
  float perspective = view[PERSPECTIVE];
  payload = SEL((VU)(((const uint *)&payload)[FIRST_LANE(some)]), payload, shown);
  VU i, j, k;
  for (int l = 0; l < VW; l++) {
    __global const int *f = faces + 3 * (size_t)((const uint *)&payload)[l];
    ((uint *)&i)[l] = f[0]; ((uint *)&j)[l] = f[1]; ((uint *)&k)[l] = f[2];
  }
  VF a[4], b[4], c[4], wb, wc;
  GATHERED4(a, points, i) GATHERED4(b, points, j) GATHERED4(c, points, k)
  Corner p = {a[0], a[1], a[2], a[3]}, q = {b[0], b[1], b[2], b[3]}, r = {c[0], c[1], c[2], c[3]};
  weigh(perspective, px, py, p, q, r, &wb, &wc);
  out.depth = SEL(out.depth, MIXED(3), shown);
  VF ex = zero, ey = zero;  // towards the eye, z 1
  if (perspective > 0.0f) { ex = (px - view[CX]) * (-1.0f / view[FX]); ey = (py - view[CY]) * (1.0f / view[FY]); }
#if HAS_NORMALS
  GATHERED4(a, normals, i) GATHERED4(b, normals, j) GATHERED4(c, normals, k)
  VF mx = MIXED(0), my = MIXED(1), mz = MIXED(2);
  VF nx = TURNED(0, mx, my, mz), ny = TURNED(1, mx, my, mz), nz = TURNED(2, mx, my, mz);
  VI flat = (nx * nx + ny * ny + nz * nz) < 1e-12f;
  if (any_lane(shown & (flat | (nx * ex + ny * ey + nz < 0.0f)))) {
#endif
    GATHERED4(a, positions, i) GATHERED4(b, positions, j) GATHERED4(c, positions, k)
    for (int d = 0; d < 3; d++) { b[d] -= a[d]; c[d] -= a[d]; }
    VF hx = b[1] * c[2] - b[2] * c[1], hy = b[2] * c[0] - b[0] * c[2], hz = b[0] * c[1] - b[1] * c[0];
    VF longest = VMAX(VMAX(VMAX(hx, -hx), VMAX(hy, -hy)), VMAX(hz, -hz));
    VI point = longest < 1e-37f;
    VF inv = one / SEL(longest, one, point);  // squares of small faces' areas would vanish
    hx *= inv; hy *= inv; hz *= inv;
    VF fx = TURNED(0, hx, hy, hz), fy = TURNED(1, hx, hy, hz), fz = TURNED(2, hx, hy, hz);
    fz = SEL(fz, one, point);
#if HAS_NORMALS
    nx = SEL(nx, fx, flat); ny = SEL(ny, fy, flat); nz = SEL(nz, fz, flat);
    face_eye(fx, fy, fz, ex, ey, &nx, &ny, &nz);
  }
  out.nx = SEL(out.nx, nx, shown); out.ny = SEL(out.ny, ny, shown); out.nz = SEL(out.nz, nz, shown);
#else
  VI back = fx * ex + fy * ey + fz < 0.0f;
  out.nx = SEL(zero, SEL(fx, -fx, back), shown); out.ny = SEL(zero, SEL(fy, -fy, back), shown);
  out.nz = SEL(one, SEL(fz, -fz, back), shown);
#endif
#if FIELD_COLOR >= 0
#if HAS_COLOR
  GATHERED4(a, colors, i) GATHERED4(b, colors, j) GATHERED4(c, colors, k)
  out.red = SEL(zero, MIXED(0), shown); out.green = SEL(zero, MIXED(1), shown); out.blue = SEL(zero, MIXED(2), shown);
#else
  out.red = view[FLAT_COLOR]; out.green = view[FLAT_COLOR + 1]; out.blue = view[FLAT_COLOR + 2];
#endif
#endif
  return out;
}

__kernel void tile_triangles(__global const float *view, __global const uint2 *pairs, __global const uint *offsets,
                             __global const float4 *points, __global const int *faces, int count,
                             __global const float4 *positions, __global const float4 *normals,
                             __global const float4 *colors, int surface, int tiles_x, int tile_count, int bins_x,
                             int bins_y, __global int *touched, __global float *all_planes) {
  Target to;
  to.view = view;
#if VW == 1
  __local uint slots[TILE * TILE * 2] __attribute__((aligned(16)));
  __local int cost[TILE_BINS * TILE_BINS];
  int tile = get_group_id(0), item = get_local_id(0);
#else
  ulong slots[TILE * TILE] __attribute__((aligned(64)));
  int cost[TILE_BINS * TILE_BINS];
  int tile = get_global_id(0);
#endif
  if (tile >= tile_count) return;
  tile = spread_tile(tile, tile_count);
  uint begin = offsets[tile], end = offsets[tile + 1];
  if (begin == end) return;
  int width = (int)view[WIDTH], height = (int)view[HEIGHT];
  int bin_x = tile % tiles_x * TILE_BINS, bin_y = tile / tiles_x * TILE_BINS;
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
      uint2 pair = pairs[e];
      int face = (int)INDEX_OF(pair) * RUN + item;
      if (face >= count) continue;
      float4 a = points[faces[3 * face]], b = points[faces[3 * face + 1]], c = points[faces[3 * face + 2]];
      if (pair.x & RUN_CLIPPED) draw_clipped(&to, a, b, c, face);
      else draw_face(&to, a, b, c, face);
    }
    SYNC;
  }
#else
  ulong8 none = NO_SLOT;
  for (int i = 0; i < TILE * TILE / 8; i++) ((ulong8 *)slots)[i] = none;
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) cost[i] = 0;
  for (uint e = begin; e < end; e++) {
    uint2 pair = pairs[e];
    int first = (int)INDEX_OF(pair) * RUN, last = first + RUN < count ? first + RUN : count;
    if (pair.x & RUN_CLIPPED) {
      for (int f = first; f < last; f++)
        draw_clipped(&to, points[faces[3 * f]], points[faces[3 * f + 1]], points[faces[3 * f + 2]], f);
      continue;
    }
    for (int f = first; f < last; f += VW) draw_faces(&to, points, faces, f, last - f < VW ? last - f : VW);
  }
#endif
  for (int b = 0; b < TILE_BINS * TILE_BINS; b++) {
    int x = bin_x + b % TILE_BINS, y = bin_y + b / TILE_BINS;
    if (x >= bins_x || y >= bins_y) continue;
    int bin = y * bins_x + x, was_touched = touched[bin] >= 0;
    __global float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS;
#if VW == 1
    int px = x * BIN + item % BIN, py = y * BIN + item / BIN;
    Seen s = resolve(view, points, faces, positions, normals, colors, payload_of(&to, SLOT_OF(px - to.x, py - to.y)),
                     px + 0.5f, py + 0.5f);
    store_seen(planes, was_touched, item, &s, surface);
#else
    for (int q = 0; q < 64 / VW; q++) {
      int qx = q / (16 / VW) % 2 * 4, qy = q / (32 / VW) * 4 + q % (16 / VW) * (VW / 4);
      int sx = b % TILE_BINS * BIN + qx, sy = b / TILE_BINS * BIN + qy;
      VF px = TO_VF((VI)(to.x + sx) + (LANE_INDEX & 3)) + 0.5f, py = TO_VF((VI)(to.y + sy) + (LANE_INDEX >> 2)) + 0.5f;
      Seen s = resolve(view, points, faces, positions, normals, colors, payload_of(&to, SLOT_OF(sx, sy)), px, py);
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
    if (x < bins_x && y < bins_y) touched[bin] = (touched[bin] >= 0 ? touched[bin] : 0) + cost[b];
  }
#endif
}
