// Heights and colours of the nodes of patches, fitted to the points of their own sheet (local range images).
//
// One work-item fits VW nodes, a tile of TILE_W x TILE_H, its lanes; the points come one by one. Three walks over the
// points above the tile:
//  1. the points of the patch's own region, and those around it on the same sheet, give a reference: their tangent
//     planes, blended. A node is needed if an own point, widened by `widen`, lies in one of its four cells;
//  2. all points that face the patch's way and lie within `tolerance` of the reference (which grows by `slack` of the
//     distance) are the sheet: a line through their heights over the reference, weighted by (1 - d^2 / R^2)^4;
//  3. the distances from the node, and from the middle of its cell, to the nearest of those points, and their colour.
#include "common/lanes.clh"
#include "build/patch_columns.clh"

#ifndef COLORED
#define COLORED 1
#endif
// Floats a patch: node (0, 0); unit x, y, z axes; least and largest height of own points; reach, widen, tolerance, slack.
#define FRAME 18
#define FACING 0.2f // least cosine between a point's normal and the patch's
#define RIDGE 1e-3f // of the slopes over the reference's, so that a line of points has no slope across

#if VW == 16
#define TILE_W 4
#define TILE_H 4
#elif VW == 8
#define TILE_W 4
#define TILE_H 2
#elif VW == 4
#define TILE_W 2
#define TILE_H 2
#else
#define TILE_W 1
#define TILE_H 1
#endif

typedef union { float16 v; float s[16]; } Sixteen;

// Points of a block in the patch's frame, relative to the tile.
typedef struct {
  Sixteen u, v, w, slope_u, slope_v;
  int16 usable;
} Block;

// The part of a patch that a tile sees.
typedef struct {
  float3 origin, x, y, z; // tile's first node at height 0; unit axes
  float low_u, high_u, low_v, high_v; // of usable points
} Tile;

inline void load_block(Block *b, __global const float *sorted, int padded, uint block, const Tile *t) {
  __global const float16 *p = (__global const float16 *)sorted + block;
  int n = padded / 16;
  float16 dx = p[0] - t->origin.x, dy = p[n] - t->origin.y, dz = p[2 * n] - t->origin.z;
  float16 nx = p[3 * n], ny = p[4 * n], nz = p[5 * n];
  b->u.v = dx * t->x.x + dy * t->x.y + dz * t->x.z;
  b->v.v = dx * t->y.x + dy * t->y.y + dz * t->y.z;
  b->w.v = dx * t->z.x + dy * t->z.y + dz * t->z.z;
  float16 facing = nx * t->z.x + ny * t->z.y + nz * t->z.z;
  b->usable = (facing > FACING) & (b->u.v >= t->low_u) & (b->u.v <= t->high_u) & (b->v.v >= t->low_v) &
              (b->v.v <= t->high_v);
  float16 inverse = -1.0f / SEL((float16)1.0f, facing, facing > FACING);
  b->slope_u.v = (nx * t->x.x + ny * t->x.y + nz * t->x.z) * inverse;
  b->slope_v.v = (nx * t->y.x + ny * t->y.y + nz * t->y.z) * inverse;
}

inline int any_of_16(int16 c) {
  int8 a = c.lo | c.hi;
  int4 b = a.lo | a.hi;
  int2 d = b.lo | b.hi;
  return d.x | d.y;
}

__kernel void fit_patch_nodes(int patches, int columns, int rows, int tiles_x, int tiles_y,
                              __global const float *frames,  // (patches, FRAME)
                              float spacing,
                              int padded, __global const float *sorted, __global const float *boxes,
                              __global const int *node_offset, int top_level,
                              __global const int *region,    // (3, padded) patch of every point, those beside it; -1
                              __global const float *light,   // (4, padded) premultiplied linear colours
                              __global float *out)           // (4 or 8, patches, rows, columns)
{
  int item = get_global_id(0);
  if (item >= patches * tiles_x * tiles_y) return;
  int patch = item / (tiles_x * tiles_y), tile = item % (tiles_x * tiles_y);
  int first_i = tile % tiles_x * TILE_W, first_j = tile / tiles_x * TILE_H;
  __global const float *f = frames + FRAME * (size_t)patch;
  Tile t;
  t.x = (float3)(f[3], f[4], f[5]), t.y = (float3)(f[6], f[7], f[8]), t.z = (float3)(f[9], f[10], f[11]);
  t.origin = (float3)(f[0], f[1], f[2]) + spacing * ((float)first_i * t.x + (float)first_j * t.y);
  float reach = f[14], widen = f[15], tolerance = f[16], slack = f[17], margin = reach;
  t.low_u = -margin, t.high_u = (TILE_W - 1) * spacing + margin;
  t.low_v = -margin, t.high_v = (TILE_H - 1) * spacing + margin;
  // The axis-aligned box of the column.
  float mid_u = 0.5f * (t.low_u + t.high_u), mid_v = 0.5f * (t.low_v + t.high_v), mid_w = 0.5f * (f[12] + f[13]);
  float half_u = t.high_u - mid_u, half_v = t.high_v - mid_v, half_w = f[13] - mid_w + reach;
  Box box;
  float3 middle = t.origin + mid_u * t.x + mid_v * t.y + mid_w * t.z;
  float3 half3 = (float3)(half_u * fabs(t.x.x) + half_v * fabs(t.y.x) + half_w * fabs(t.z.x),
                          half_u * fabs(t.x.y) + half_v * fabs(t.y.y) + half_w * fabs(t.z.y),
                          half_u * fabs(t.x.z) + half_v * fabs(t.y.z) + half_w * fabs(t.z.z));
  box.low_x = middle.x - half3.x, box.low_y = middle.y - half3.y, box.low_z = middle.z - half3.z;
  box.high_x = middle.x + half3.x, box.high_y = middle.y + half3.y, box.high_z = middle.z + half3.z;

  VI i = LANE_INDEX % TILE_W, j = LANE_INDEX / TILE_W;
  VF u = TO_VF(i) * spacing, v = TO_VF(j) * spacing;
  float inverse2 = 1.0f / (reach * reach), need = spacing + widen;
  VF total = 0.0f, h = 0.0f, su = 0.0f, sv = 0.0f;
  VI needed = 0;
  uint list[BLOCK_LIST];
  Traversal walk;
  Block b;
  union { int16 v; int s[16]; } chosen, own;
  int blocks;

  traversal_start(&walk, top_level);
  while ((blocks = column_next(&walk, boxes, node_offset, &box, list)) > 0)
    for (int k = 0; k < blocks; ++k) {
      load_block(&b, sorted, padded, list[k], &t);
      own.v = ((__global const int16 *)region)[list[k]] == patch;
      chosen.v = b.usable & (own.v | (((__global const int16 *)(region + padded))[list[k]] == patch) |
                             (((__global const int16 *)(region + 2 * (size_t)padded))[list[k]] == patch));
      if (!any_of_16(chosen.v)) continue;
      for (int p = 0; p < 16; ++p) {
        if (!chosen.s[p]) continue;
        VF du = u - b.u.s[p], dv = v - b.v.s[p];
        VF g = 1.0f - (du * du + dv * dv) * inverse2;
        g = SEL((VF)0.0f, g, g > 0.0f);
        g = g * g;
        g = g * g;
        total += g;
        h += g * (b.w.s[p] + b.slope_u.s[p] * du + b.slope_v.s[p] * dv);
        su += g * b.slope_u.s[p];
        sv += g * b.slope_v.s[p];
        if (!own.s[p]) continue;
        needed |= (du <= need) & (du >= -need) & (dv <= need) & (dv >= -need);
      }
    }
  int stride = rows * columns * patches;
  VI inside = (i + first_i < columns) & (j + first_j < rows);
  needed &= (total > 0.0f) & inside;
  union { VF v; float s[VW]; } result[8];
  for (int k = 0; k < 8; ++k) result[k].v = 0.0f;
  result[1].v = INFINITY, result[2].v = INFINITY;
  if (any_lane(needed)) {
    VF scale = 1.0f / SEL((VF)1.0f, total, total > 0.0f);
    h *= scale, su *= scale, sv *= scale;

    // The sheet: deviations from the reference, moments in units of the reach.
    VF m0 = 0.0f, mx = 0.0f, my = 0.0f, mxx = 0.0f, mxy = 0.0f, myy = 0.0f, r0 = 0.0f, rx = 0.0f, ry = 0.0f;
    float unit = 1.0f / reach;
    traversal_start(&walk, top_level);
    while ((blocks = column_next(&walk, boxes, node_offset, &box, list)) > 0)
      for (int k = 0; k < blocks; ++k) {
        load_block(&b, sorted, padded, list[k], &t);
        chosen.v = b.usable;
        if (!any_of_16(chosen.v)) continue;
        for (int p = 0; p < 16; ++p) {
          if (!chosen.s[p]) continue;
          VF du = b.u.s[p] - u, dv = b.v.s[p] - v, d2 = (du * du + dv * dv) * inverse2;
          VF r = b.w.s[p] - h - su * du - sv * dv, g = 1.0f - d2, away = tolerance + slack * d2;
          VI sheet = (g > 0.0f) & (r <= away) & (r >= -away);
          g = SEL((VF)0.0f, g, sheet);
          g = g * g;
          g = g * g;
          VF x = du * unit, y = dv * unit;
          m0 += g, mx += g * x, my += g * y, mxx += g * x * x, mxy += g * x * y, myy += g * y * y;
          r0 += g * r, rx += g * x * r, ry += g * y * r;
        }
      }
    VI seen = m0 > 0.0f;
    VF mean = 1.0f / SEL((VF)1.0f, m0, seen);
    mx *= mean, my *= mean, r0 *= mean;
    VF xx = mxx * mean - mx * mx + RIDGE, xy = mxy * mean - mx * my, yy = myy * mean - my * my + RIDGE;
    VF xr = rx * mean - mx * r0, yr = ry * mean - my * r0, det = 1.0f / (xx * yy - xy * xy);
    VF gx = (xr * yy - yr * xy) * det, gy = (yr * xx - xr * xy) * det;
    VF lift = r0 - gx * mx - gy * my;
    VF fitted = h + SEL((VF)0.0f, lift, seen), fit_u = su + gx * unit, fit_v = sv + gy * unit;

    // Support and colour.
    VF near = INFINITY, cell = INFINITY, weight = 0.0f, red = 0.0f, green = 0.0f, blue = 0.0f, alpha = 0.0f;
    float half_cell = 0.5f * spacing;
    traversal_start(&walk, top_level);
    while ((blocks = column_next(&walk, boxes, node_offset, &box, list)) > 0)
      for (int k = 0; k < blocks; ++k) {
        load_block(&b, sorted, padded, list[k], &t);
        chosen.v = b.usable;
        if (!any_of_16(chosen.v)) continue;
        for (int p = 0; p < 16; ++p) {
          if (!chosen.s[p]) continue;
          VF du = b.u.s[p] - u, dv = b.v.s[p] - v, d2 = du * du + dv * dv;
          VF r = b.w.s[p] - h - su * du - sv * dv, away = tolerance + slack * d2 * inverse2;
          VI sheet = (d2 * inverse2 < 1.0f) & (r <= away) & (r >= -away);
          VF rise = b.w.s[p] - fitted, across = rise - fit_u * half_cell - fit_v * half_cell;
          VF cu = du - half_cell, cv = dv - half_cell;
          VF here = d2 + rise * rise, there = cu * cu + cv * cv + across * across;
          near = SEL(near, here, sheet & (here < near));
          cell = SEL(cell, there, sheet & (there < cell));
#if COLORED
          VF g = SEL((VF)0.0f, 1.0f - d2 * inverse2, sheet);
          g = g * g;
          g = g * g;
          g = g * g * g; // narrower than the heights' weight
          size_t at = 16 * (size_t)list[k] + p;
          weight += g;
          red += g * light[at], green += g * light[padded + at], blue += g * light[2 * (size_t)padded + at];
          alpha += g * light[3 * (size_t)padded + at];
#endif
        }
      }
    scale = 1.0f / SEL((VF)1.0f, weight, weight > 1e-30f);
    result[0].v = fitted;
    result[1].v = near, result[2].v = cell;
    result[3].v = SEL((VF)0.0f, (VF)1.0f, needed & seen);
    result[4].v = red * scale, result[5].v = green * scale, result[6].v = blue * scale, result[7].v = alpha * scale;
  }
  for (int k = 0; k < VW; ++k) {
    int x = first_i + k % TILE_W, y = first_j + k / TILE_W;
    if (x >= columns || y >= rows) continue;
    size_t at = ((size_t)patch * rows + y) * columns + x;
    for (int c = 0; c < (COLORED ? 8 : 4); ++c) out[c * (size_t)stride + at] = result[c].s[k];
  }
}
