// Draw the patches of every tile: all cells compete for its pixels, then the winners' depth, normal and colour go into the
// planes. One work-item per tile. Twin: tests/reference/render_patches.py, tile_patches.
#include "render/patch_planes.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#ifndef TRIANGLES
#define TRIANGLES 0
#endif
#define TILE (TILE_BINS * BIN)

// Whether pixel (px, py) lies in the triangle of projected corners a, b, c, its edges included: products of the same
// numbers are compared on both sides of an edge, so that no pixel falls between two cells.
inline int in_triangle(float ax, float ay, float bx, float by, float cx, float cy) {
  return (ax * by >= ay * bx && bx * cy >= by * cx && cx * ay >= cy * ax)
      || (ax * by <= ay * bx && bx * cy <= by * cx && cx * ay <= cy * ax);
}

// The pixels [x0, x1] x [y0, y1] of one cell, relative to nothing: picture pixels.
inline int draw_cell(__global const float *view, const Node *c, float b0, float b1, float b2, float b3, uint payload,
                     int tile_x, int tile_y, int4 limits, __global uint2 *slots) {
  float near = view[NEAR], x[4], y[4];
  int front = 0, evaluated = 0;
  float extent = 0.0f;
  for (int k = 0; k < 4; k++) { front += c[k].z > near && c[k].w > 0.0f; extent = fmax(extent, fabs(c[k].z - c[0].z)); }
  if (front == 0) return 0;
  int clipped = front < 4;
  float x0 = INFINITY, y0 = INFINITY, x1 = -INFINITY, y1 = -INFINITY;
  for (int k = 0; k < 4; k++) {
    float inv = 1.0f / c[k].w;
    x[k] = c[k].x * inv; y[k] = c[k].y * inv;
    if (!(c[k].z > near && c[k].w > 0.0f)) continue;
    x0 = fmin(x0, x[k]); x1 = fmax(x1, x[k]); y0 = fmin(y0, y[k]); y1 = fmax(y1, y[k]);
  }
  if (clipped) {
    // The part in front lies in the hull of the corners in front and of where the connections cross the near plane.
    float cut = fmax(near, near > -1e30f && c[0].w != 1.0f ? 1e-4f * extent : near);
    for (int a = 0; a < 4; a++)
      for (int b = 0; b < a; b++) {
        if ((c[a].z > cut) == (c[b].z > cut)) continue;
        float u = (cut - c[a].z) / (c[b].z - c[a].z), w = c[a].w + u * (c[b].w - c[a].w);
        float px = (c[a].x + u * (c[b].x - c[a].x)) / w, py = (c[a].y + u * (c[b].y - c[a].y)) / w;
        x0 = fmin(x0, px - 1.0f); x1 = fmax(x1, px + 1.0f); y0 = fmin(y0, py - 1.0f); y1 = fmax(y1, py + 1.0f);
      }
  }
  x0 = fmax(ceil(x0 - 0.5f), (float)limits.x); x1 = fmin(floor(x1 - 0.5f), (float)limits.z);
  y0 = fmax(ceil(y0 - 0.5f), (float)limits.y); y1 = fmin(floor(y1 - 0.5f), (float)limits.w);
  if (!(x0 <= x1 && y0 <= y1)) return 0;
  for (int iy = (int)y0; iy <= (int)y1; iy++)
    for (int ix = (int)x0; ix <= (int)x1; ix++) {
      float px = ix + 0.5f, py = iy + 0.5f, s, t, depth;
      evaluated++;
      if (clipped) {
        float ss[2], tt[2];
        depth = INFINITY;
        if (!cell_roots(c, px, py, ss, tt)) continue;
        for (int r = 0; r < 2; r++) {
          if (outside(ss[r]) > 1e-5f || outside(tt[r]) > 1e-5f) continue;
          float z = bilinear(c[0].z, c[1].z, c[2].z, c[3].z, ss[r], tt[r]);
          if (z > near && z < depth) { depth = z; s = ss[r]; t = tt[r]; }
        }
        if (depth == INFINITY) continue;
      } else {
        float qx[4], qy[4];
        for (int k = 0; k < 4; k++) { qx[k] = x[k] - px; qy[k] = y[k] - py; }
        if (!in_triangle(qx[0], qy[0], qx[1], qy[1], qx[3], qy[3])
            && !in_triangle(qx[0], qy[0], qx[3], qy[3], qx[2], qy[2])) continue;
        depth = cell_place(c, px, py, near, &s, &t);
      }
      put_sample(slots + (iy - tile_y) * TILE + ix - tile_x, sample_key(view, depth, bilinear(b0, b1, b2, b3, s, t)), payload);
    }
  return evaluated;
}

__kernel void tile_patches(__global const float *view, __global const int4 *rectangles, __global const float *records,
                           __global const int *sizes, __global const uint *offsets, int count,
                           __global const height_t *heights, __global const uchar *cells, __global const float *borders,
                           __global const float2 *slopes, __global const uchar *colors, __global const float *linear,
                           int surface, int tiles_x, int tile_count, int bins_x, int bins_y, __global uint2 *all_slots,
                           __global int *touched, __global float *all_planes) {
  int tile = get_global_id(0);
  if (tile >= tile_count) return;
  int tile_x = tile % tiles_x * TILE, tile_y = tile / tiles_x * TILE, perspective = view[PERSPECTIVE] > 0.0f;
  __global uint2 *slots = all_slots + (size_t)tile * TILE * TILE;
  int cost[TILE_BINS * TILE_BINS];
  int any = 0;
  for (int k = 0; k < count; k++) {
    int4 r = rectangles[k];
    if (r.x > tile_x + TILE - 1 || r.z < tile_x || r.y > tile_y + TILE - 1 || r.w < tile_y || r.x > r.z) continue;
    if (!any) {
      for (int i = 0; i < TILE * TILE; i++) slots[i] = (uint2)(NO_SAMPLE, NO_SAMPLE);
      for (int i = 0; i < TILE_BINS * TILE_BINS; i++) cost[i] = 0;
    }
    any = 1;
    int4 limits = (int4)(max(r.x, tile_x), max(r.y, tile_y), min(r.z, tile_x + TILE - 1), min(r.w, tile_y + TILE - 1));
    int m = sizes[2 * k], n = sizes[2 * k + 1];
    uint first = offsets[k];
    __global const float *h = records + (size_t)k * PATCH_FLOATS;
    for (int j = 0; j < n - 1; j++)
      for (int i = 0; i < m - 1; i++) {
        uint at = first + (uint)j * m + i;
        if (!cells[at]) continue;
        Node c[4];
        cell_nodes(h, perspective, heights, first, m, i, j, c);
        float e = view[BORDER_SCALE];
        cost[0] += draw_cell(view, c, e * borders[at], e * borders[at + 1], e * borders[at + m], e * borders[at + m + 1], at,
                             tile_x, tile_y, limits, slots);
      }
  }
  if (!any) return;
  for (int b = 0; b < TILE_BINS * TILE_BINS; b++) {
    int bin_x = tile_x / BIN + b % TILE_BINS, bin_y = tile_y / BIN + b / TILE_BINS;
    if (bin_x >= bins_x || bin_y >= bins_y) continue;
    int bin = bin_y * bins_x + bin_x, was_touched = touched[bin] >= 0;
    __global float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS;
    int hits = 0;
    for (int at = 0; at < BIN_PIXELS; at++) {
      int ix = bin_x * BIN + at % BIN, iy = bin_y * BIN + at / BIN;
      uint2 slot = slots[(iy - tile_y) * TILE + ix - tile_x];
      if (slot.y == NO_SAMPLE) {
        if (!was_touched) planes[FIELD_DEPTH * BIN_PIXELS + at] = EMPTY_DEPTH;
        continue;
      }
      hits++;
      int low = 0, high = count;  // the patch that the node belongs to
      while (high - low > 1) {
        int middle = (low + high) / 2;
        if (offsets[middle] <= slot.y) low = middle; else high = middle;
      }
      uint first = offsets[low];
      int m = sizes[2 * low], j = (slot.y - first) / m, i = (slot.y - first) % m;
      __global const float *h = records + (size_t)low * PATCH_FLOATS;
      Node c[4];
      float s, t, px = ix + 0.5f, py = iy + 0.5f;
      cell_nodes(h, perspective, heights, first, m, i, j, c);
      float depth = cell_place(c, px, py, view[NEAR], &s, &t);
      float2 g0 = slopes[slot.y], g1 = slopes[slot.y + 1], g2 = slopes[slot.y + m], g3 = slopes[slot.y + m + 1];
      float gx = bilinear(g0.x, g1.x, g2.x, g3.x, s, t), gy = bilinear(g0.y, g1.y, g2.y, g3.y, s, t), rgb[3];
      for (int k = 0; k < 3; k++) {
#if CHANNELS
        __global const uchar *color = colors + (size_t)CHANNELS * slot.y + k;
        rgb[k] = bilinear(linear[color[0]], linear[color[CHANNELS]], linear[color[CHANNELS * m]],
                          linear[color[CHANNELS * m + CHANNELS]], s, t);
#else
        rgb[k] = view[PATCH_COLOR + k];
#endif
      }
      store_sample(view, planes, at, was_touched, px, py, depth, h[NX] - gx * h[NX + 1] - gy * h[NX + 2],
                   h[NY] - gx * h[NY + 1] - gy * h[NY + 2], h[NZ] - gx * h[NZ + 1] - gy * h[NZ + 2], rgb[0], rgb[1],
                   rgb[2], surface, 1, 0);
    }
    if (hits || was_touched) touched[bin] = (was_touched ? touched[bin] : 0) + hits;
  }
}
