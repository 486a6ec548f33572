// Draw the patches of every tile: their cells compete for its pixels, then the winners' depth, normal and colour at the
// pixels' centres go into the planes, or, where the surface is the frame's only one, shaded into the picture.
//
// VW > 1: one work-item per tile; lanes are the cells of a row, or 4x4 pixels of one cell where cells are large. VW = 1:
// one work-group of 64 work-items per tile, each a cell, then a pixel. Twin: tests/reference/render_patches.py.
#include "render/patch_cells.clh"
#include "render/patch_heights.clh"
#include "render/shade.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#ifndef FUSED
#define FUSED 0      // 1: shade at once
#endif
#ifndef COUNT_COST
#define COUNT_COST 0
#endif
#ifndef EQUAL_NODES
#define EQUAL_NODES 0  // nodes of every patch, 0: they differ
#endif
#ifndef ATOMICS_64
#define ATOMICS_64 0   // VW = 1: 64-bit minimum in local memory; 0: two rounds of 32 bits
#endif
#ifndef LATTICE
#define LATTICE 0      // 1: cells are subdivided into points
#endif
#ifndef SMOOTH_NORMALS
#define SMOOTH_NORMALS 0  // 1: normals are those of the C1 surface through the nodes
#endif
#ifndef ALPHA_TEST
#define ALPHA_TEST 0   // 1: only what has an interpolated alpha of at least 1/2 is drawn
#endif
#ifndef COLOR_UNIT
#define COLOR_UNIT (1.0f / 65535.0f)  // of the nodes' colours; negative: they are lit already
#endif
#define TILE (TILE_BINS * BIN)
#define BLOCKS (TILE / 4)

#if VW == 1
#define GROUP 64
#define SYNC barrier(CLK_LOCAL_MEM_FENCE)
#define SLOTS __local uint *
#define COSTS __local int *
#if ATOMICS_64
#pragma OPENCL EXTENSION cl_khr_int64_extended_atomics : enable
#define ROUNDS 1
#else
#define ROUNDS 2
#endif
#else
#define GROUP 1
#define SYNC
#define SLOTS ulong *
#define COSTS int *
#define ROUNDS 1
#endif

typedef struct {
  __global const float *view;
  SLOTS slots;      // in blocks of 4x4 pixels, row by row
  COSTS cost;       // samples of each bin
  int x, y;         // first pixel
  int4 limits;      // first and last pixel of the patch within the tile
  int round;
} Target;

// The nodes of a surface.
typedef struct {
  __global const float *steps;   // displacements
  __global const ushort *rims;   // distance to the border, and what is drawn
  __global const uint4 *nodes;   // displacement, linear colour, alpha and slopes in 16 bits each
  __global const float *twists;  // mixed differences, for what is smooth
} Nodes;

#define SLOT_OF(x, y) (((((y) >> 2) * BLOCKS + ((x) >> 2)) << 4) + (((y) & 3) << 2) + ((x) & 3))

INLINE void put_lane(const Target *to, int slot, uint key, uint payload) {
#if VW == 1
#if ATOMICS_64
  atom_min((volatile __local ulong *)to->slots + slot, (ulong)key << 32 | payload);
#else
  volatile __local uint *at = to->slots + 2 * slot;
  if (to->round == 0) atomic_min(at, key);
  else if (*at == key) atomic_min(at + 1, payload);
#endif
#else
  ulong sample = (ulong)key << 32 | payload, old = to->slots[slot];
  to->slots[slot] = sample < old ? sample : old;
#endif
#if COUNT_COST
  int bin = slot / (16 * 2 * BLOCKS) * TILE_BINS + slot / 16 % BLOCKS / 2;
#if VW == 1
  if (to->round == 0) atomic_inc((volatile __local int *)to->cost + bin);
#else
  to->cost[bin]++;
#endif
#endif
}

// The samples at pixels (x, y) of lanes whose cells are `payload`, `payload` + 1, ...
INLINE void put_lanes(const Target *to, VI hit, VI x, VI y, VU key, uint payload) {
#if VW == 1
  if (hit) put_lane(to, SLOT_OF(x - to->x, y - to->y), key, payload);
#else
  x -= to->x; y -= to->y;
  VI slot = SLOT_OF(x, y);
  const int *at = (const int *)&slot;
  const uint *keys = (const uint *)&key;
  for (uint bits = lane_mask(hit); bits; bits &= bits - 1) {
    int l = FIRST_LANE(bits);
    put_lane(to, at[l], keys[l], payload + l);
  }
#endif
}

// Lanes are cells with corners a b / c d.
INLINE void draw_cells(const Target *to, Spot a, Spot b, Spot c, Spot d, VI drawn, int large, uint payload) {
  VI first_x, last_x, first_y, last_y;
  pixel_range(least4(a.x, b.x, c.x, d.x), most4(a.x, b.x, c.x, d.x), to->limits.x, to->limits.z, &first_x, &last_x);
  pixel_range(least4(a.y, b.y, c.y, d.y), most4(a.y, b.y, c.y, d.y), to->limits.y, to->limits.w, &first_y, &last_y);
  drawn = drawn & (first_x <= last_x) & (first_y <= last_y);
  if (!any_lane(drawn)) return;
  Fit fit = fit_cell(to->view, a, b, c, d, large);
  VI right = runs_right(a, b, c, d);
  VF bx = SEL(b.x, c.x, right), by = SEL(b.y, c.y, right), cx = SEL(c.x, b.x, right), cy = SEL(c.y, b.y, right);
  Spot e = b, f = c;
  e.x = bx; e.y = by; f.x = cx; f.y = cy;
  VI folded = (VI)(TRIANGLES ? -1 : 0) | is_folded(a, e, f, d);
#if VW == 1
  folded = folded != 0;
#endif
#if VW == 16
  // Cells of at most 2x2 pixels, the most: all four at once, without branches, then their hits in one go.
  VI wide = drawn & (folded | (last_x - first_x > 1) | (last_y - first_y > 1));
  if (!any_lane(wide)) {
    VI slots[4];
    VU keys[4];
    uint masks[2] = {0, 0};
    for (int q = 0; q < 4; q++) {
      VI column = first_x + (q & 1), row = first_y + (q >> 1);
      VF px = TO_VF(column) + 0.5f, py = TO_VF(row) + 0.5f;
      VI hit = drawn & (column <= last_x) & (row <= last_y)
             & in_convex(a.x - px, a.y - py, e.x - px, e.y - py, f.x - px, f.y - py, d.x - px, d.y - py);
      keys[q] = fit_key(to->view, &fit, px, py, large);
      column -= to->x; row -= to->y;
      slots[q] = SLOT_OF(column, row);
      masks[q >> 1] |= lane_mask(hit) << 16 * (q & 1);
    }
    for (int pair = 0; pair < 2; pair++)
      for (uint bits = masks[pair]; bits; bits &= bits - 1) {
        int l = FIRST_LANE(bits);
        put_lane(to, ((const int *)(slots + 2 * pair))[l], ((const uint *)(keys + 2 * pair))[l], payload + (l & 15));
      }
    return;
  }
#endif
  // Folded cells, a few at silhouettes, take a round of their own.
  for (int odd = 0; odd < 2; odd++) {
    VI live = drawn & (odd ? folded : NOT(folded));
    if (!any_lane(live)) continue;
    VI row = first_y;
    for (VI on = live & (row <= last_y); any_lane(on); row += 1, on = live & (row <= last_y)) {
      VF py = TO_VF(row) + 0.5f;
      VF ay = a.y - py, ey = e.y - py, fy = f.y - py, dy = d.y - py;
      VI column = first_x;
      for (VI go = on & (column <= last_x); any_lane(go); column += 1, go = on & (column <= last_x)) {
        VF px = TO_VF(column) + 0.5f;
        VF ax = a.x - px, ex = e.x - px, fx = f.x - px, dx = d.x - px;
        VI hit = go & (odd ? in_folded(ax, ay, ex, ey, fx, fy, dx, dy) : in_convex(ax, ay, ex, ey, fx, fy, dx, dy));
        if (any_lane(hit)) put_lanes(to, hit, column, row, fit_key(to->view, &fit, px, py, large), payload);
      }
    }
  }
}

#if VW == 16
#define GATHERED(out, base, index) { const uint *g = (const uint *)&(index); uint16 q0, q1, q2, q3; \
    q0 = (uint16)((base)[g[0]], (base)[g[1]], (base)[g[2]], (base)[g[3]]); \
    q1 = (uint16)((base)[g[4]], (base)[g[5]], (base)[g[6]], (base)[g[7]]); \
    q2 = (uint16)((base)[g[8]], (base)[g[9]], (base)[g[10]], (base)[g[11]]); \
    q3 = (uint16)((base)[g[12]], (base)[g[13]], (base)[g[14]], (base)[g[15]]); \
    out[0] = (uint16)(q0.s048c, q1.s048c, q2.s048c, q3.s048c); out[1] = (uint16)(q0.s159d, q1.s159d, q2.s159d, q3.s159d); \
    out[2] = (uint16)(q0.s26ae, q1.s26ae, q2.s26ae, q3.s26ae); out[3] = (uint16)(q0.s37bf, q1.s37bf, q2.s37bf, q3.s37bf); }
#elif VW == 1
#define GATHERED(out, base, index) { uint4 q = (base)[index]; out[0] = q.x; out[1] = q.y; out[2] = q.z; out[3] = q.w; }
#else
#define GATHERED(out, base, index) for (int l = 0; l < VW; l++) { uint4 q = (base)[((const uint *)&(index))[l]]; \
    ((uint *)&out[0])[l] = q.x; ((uint *)&out[1])[l] = q.y; ((uint *)&out[2])[l] = q.z; ((uint *)&out[3])[l] = q.w; }
#endif
#define RED(n) TO_VF(AS_VI(n[1] & 0xffffu))
#define GREEN(n) TO_VF(AS_VI(n[1] >> 16))
#define BLUE(n) TO_VF(AS_VI(n[2] & 0xffffu))
#define ALPHA(n) TO_VF(AS_VI(n[2] >> 16))
#define HALF_ALPHA 32767.5f
#define SLOPE_X(n) TO_VF(AS_VI(n[3] << 16) >> 16)
#define SLOPE_Y(n) TO_VF(AS_VI(n[3]) >> 16)

#if VW > 1
typedef VF __attribute__((aligned(4))) FloatsAt;
typedef CAT(ushort, VW) Shorts;
typedef Shorts __attribute__((aligned(2))) ShortsAt;
#define FLOATS_AT(p) (*(__global const FloatsAt *)(p))
#define RIMS_AT(p) TO_VI(*(__global const ShortsAt *)(p))
#else
#define FLOATS_AT(p) (*(p))
#define RIMS_AT(p) ((int)*(p))
#endif

INLINE Spot spot_at(__global const float *h, int perspective, VF i, VF j, VF d, VI rim) {
  Spot s;
  VF x, y, z, w;
  project_nodes(h, perspective, i, j, d, &x, &y, &z, &w);
  VF inv = 1.0f / w;
  s.x = x * inv; s.y = y * inv; s.z = z;
  s.r = TO_VF(rim & RIM_BORDER) * RIM_SCALE;
  return s;
}

// One cell, lanes over 4x4 pixels; the corners may lie behind the eye (`clipped`).
INLINE void draw_one(const Target *to, const VF *x, const VF *y, const VF *z, const VF *w, const VF *r, const VF *alphas,
                     int clipped, uint payload) {
  float near = to->view[NEAR], x0 = INFINITY, x1 = -INFINITY, y0 = INFINITY, y1 = -INFINITY, extent = 0.0f;
  float X[4], Y[4], Z[4], W[4];
  for (int k = 0; k < 4; k++) {
    X[k] = ((const float *)(x + k))[0]; Y[k] = ((const float *)(y + k))[0];
    Z[k] = ((const float *)(z + k))[0]; W[k] = ((const float *)(w + k))[0];
    float off = Z[k] - Z[0];
    off = off < 0.0f ? -off : off;
    extent = off > extent ? off : extent;
  }
  // The part in front lies in the hull of the corners in front and of where the connections cross the near plane.
  float cut = clipped && to->view[PERSPECTIVE] > 0.0f && near < 1e-4f * extent ? 1e-4f * extent : near;
  for (int p = 0; p < 4; p++)
    for (int q = 0; q <= p; q++) {
      float u = 0.0f, margin = 0.0f;
      if (p == q) { if (clipped && !(Z[p] > cut)) continue; }
      else {
        if (!clipped || (Z[p] > cut) == (Z[q] > cut)) continue;
        u = (cut - Z[p]) / (Z[q] - Z[p]);
        margin = 1.0f;
      }
      float inv = 1.0f / (W[p] + u * (W[q] - W[p]));
      float at_x = (X[p] + u * (X[q] - X[p])) * inv, at_y = (Y[p] + u * (Y[q] - Y[p])) * inv;
      x0 = at_x - margin < x0 ? at_x - margin : x0; x1 = at_x + margin > x1 ? at_x + margin : x1;
      y0 = at_y - margin < y0 ? at_y - margin : y0; y1 = at_y + margin > y1 ? at_y + margin : y1;
    }
  int4 box;
  x0 = x0 - 0.5f > to->limits.x ? x0 - 0.5f : to->limits.x; x1 = x1 - 0.5f < to->limits.z ? x1 - 0.5f : to->limits.z;
  y0 = y0 - 0.5f > to->limits.y ? y0 - 0.5f : to->limits.y; y1 = y1 - 0.5f < to->limits.w ? y1 - 0.5f : to->limits.w;
  if (!(x0 <= x1 && y0 <= y1)) return;
  box.x = (int)x0; box.x += (float)box.x < x0; box.z = (int)x1;
  box.y = (int)y0; box.y += (float)box.y < y0; box.w = (int)y1;
  if (box.x > box.z || box.y > box.w) return;
  Spot a, b, c, d;
  Fit fit;
  VI folded = 0, right = 0;
  if (!clipped) {
    VF inv;
#define AS_SPOT(s, k) inv = 1.0f / w[k]; s.x = x[k] * inv; s.y = y[k] * inv; s.z = z[k]; s.r = r[k];
    AS_SPOT(a, 0) AS_SPOT(b, 1) AS_SPOT(c, 2) AS_SPOT(d, 3)
    fit = fit_cell(to->view, a, b, c, d, 1);
    right = runs_right(a, b, c, d);
    Spot e = b;
    b.x = SEL(b.x, c.x, right); b.y = SEL(b.y, c.y, right); c.x = SEL(c.x, e.x, right); c.y = SEL(c.y, e.y, right);
    folded = is_folded(a, b, c, d);
  }
  int odd = TRIANGLES || any_lane(folded);
#if VW == 1
  const int step_x = 1, step_y = 1;
#else
  const int step_x = 4, step_y = VW / 4;
#endif
  for (int iy = box.y / step_y * step_y; iy <= box.w; iy += step_y)
    for (int ix = box.x / step_x * step_x; ix <= box.z; ix += step_x) {
#if VW == 1
      VI column = ix, row = iy;
#else
      VI column = (VI)(ix) + (LANE_INDEX & 3), row = (VI)(iy) + (LANE_INDEX >> 2);
#endif
      VF px = TO_VF(column) + 0.5f, py = TO_VF(row) + 0.5f;
      VI hit = (column >= box.x) & (column <= box.z) & (row >= box.y) & (row <= box.w);
      VU key;
      if (clipped) {
        VF s, t, depth;
        VF off = place_in_cell(x[0] - px * w[0], y[0] - py * w[0], x[1] - px * w[1], y[1] - py * w[1],
                               x[2] - px * w[2], y[2] - py * w[2], x[3] - px * w[3], y[3] - py * w[3], z[0], z[1], z[2],
                               z[3], near, &s, &t, &depth);
        hit = hit & (off == 0.0f);
#if ALPHA_TEST
        hit = hit & (mixed(alphas[0], alphas[1], alphas[2], alphas[3], s, t) >= HALF_ALPHA);
#endif
        VF p = r[0] + s * (r[1] - r[0]), q = r[2] + s * (r[3] - r[2]);
        key = key_of(layer_of(to->view, depth), p + t * (q - p));
      } else {
        VF ax = a.x - px, ay = a.y - py, bx = b.x - px, by = b.y - py, cx = c.x - px, cy = c.y - py, dx = d.x - px,
           dy = d.y - py;
        hit = hit & (odd ? in_folded(ax, ay, bx, by, cx, cy, dx, dy) : in_convex(ax, ay, bx, by, cx, cy, dx, dy));
        if (!any_lane(hit)) continue;
        key = fit_key(to->view, &fit, px, py, 1);
#if ALPHA_TEST
        VF s, t, depth;
        place_in_cell(x[0] - px * w[0], y[0] - py * w[0], x[1] - px * w[1], y[1] - py * w[1], x[2] - px * w[2],
                      y[2] - py * w[2], x[3] - px * w[3], y[3] - py * w[3], z[0], z[1], z[2], z[3], near, &s, &t, &depth);
        hit = hit & (mixed(alphas[0], alphas[1], alphas[2], alphas[3], s, t) >= HALF_ALPHA);
#endif
      }
      if (!any_lane(hit)) continue;
#if VW == 1
      put_lane(to, SLOT_OF(ix - to->x, iy - to->y), key, payload);
#elif VW == 16 && defined(__clang__) && !COUNT_COST
      ulong16 *at = (ulong16 *)(to->slots + SLOT_OF(ix - to->x, iy - to->y));
      ulong16 sample = __builtin_convertvector(key, ulong16) << 32 | (ulong16)(payload), old = *at;
      long16 less = (sample < old) & __builtin_convertvector(hit, long16);
      *at = less ? sample : old;
#else
      for (int l = 0; l < VW; l++) {
        if (!((const int *)&hit)[l]) continue;
        put_lane(to, SLOT_OF(((const int *)&column)[l] - to->x, ((const int *)&row)[l] - to->y), ((const uint *)&key)[l],
                 payload);
      }
#endif
    }
}

// One cell by itself.
INLINE void draw_alone(const Target *to, Nodes nodes, __global const float *h, int perspective, uint first, int m, int i,
                       int j) {
  float near = to->view[NEAR];
  uint at = first + (uint)j * m + i;
  int front = 0, shown = !ALPHA_TEST;
  VF x[4], y[4], z[4], w[4], r[4], alphas[4];
  for (int k = 0; k < 4; k++) {
    uint node = at + (k >> 1) * m + (k & 1);
    project_nodes(h, perspective, (VF)(i + (k & 1)), (VF)(j + (k >> 1)), (VF)(nodes.steps[node]), x + k, y + k, z + k,
                  w + k);
    r[k] = (nodes.rims[node] & RIM_BORDER) * RIM_SCALE;
    front += ((const float *)(z + k))[0] > near;
#if ALPHA_TEST
    alphas[k] = nodes.nodes[node].z >> 16;
    shown |= nodes.nodes[node].z >> 31;  // a half or more
#endif
  }
  if (front && shown) draw_one(to, x, y, z, w, r, alphas, front < 4, at);
}

// A patch of large cells, or one that reaches the near plane, cell by cell.
INLINE void draw_large(const Target *to, Nodes nodes, __global const float *h, int perspective, uint first, int m, int n,
                       int item) {
  for (int cell = item; cell < (m - 1) * (n - 1); cell += GROUP) {
    int i = cell % (m - 1), j = cell / (m - 1);
    if (nodes.rims[first + (uint)j * m + i] & RIM_DRAWN) draw_alone(to, nodes, h, perspective, first, m, i, j);
  }
}

#if ALPHA_TEST
// Whether all corners of a cell have at least half an alpha, so that all of it shows.
INLINE int is_whole(Nodes nodes, uint at, int m) {
  return nodes.nodes[at].z & nodes.nodes[at + 1].z & nodes.nodes[at + m].z & nodes.nodes[at + m + 1].z & 0x80000000u ? -1 : 0;
}
#endif

// A patch all of which is in front of the eye, lanes over rows of cells. VW = 1: `item` of the group's cells.
INLINE void draw_patch(const Target *to, Nodes nodes, __global const float *h, int perspective, uint first, int m, int n,
                       int large, int item) {
#if VW == 1
  for (int cell = item; cell < (m - 1) * (n - 1); cell += GROUP) {
    int i = cell % (m - 1), j = cell / (m - 1);
    uint at = first + (uint)j * m + i;
    int rim = nodes.rims[at];
    if (!(rim & RIM_DRAWN)) continue;
#if ALPHA_TEST
    if (!is_whole(nodes, at, m)) { draw_alone(to, nodes, h, perspective, first, m, i, j); continue; }
#endif
#define SPOT(i, j, at) spot_at(h, perspective, i, j, nodes.steps[at], nodes.rims[at])
    draw_cells(to, SPOT(i, j, at), SPOT(i + 1, j, at + 1), SPOT(i, j + 1, at + m), SPOT(i + 1, j + 1, at + m + 1), 1,
               large, at);
  }
#else
  for (int i = 0; i < m - 1; i += VW) {
    VF left = TO_VF((VI)(i) + LANE_INDEX), right = left + 1.0f;
    VI inside = (VI)(i) + LANE_INDEX < (VI)(m - 1), before;
    Spot a, b, c, d;
    for (int j = 0; j < n; j++) {
      uint at = first + (uint)j * m + i;
      VI rim = RIMS_AT(nodes.rims + at);
      c = spot_at(h, perspective, left, (VF)(j), FLOATS_AT(nodes.steps + at), rim);
      d = spot_at(h, perspective, right, (VF)(j), FLOATS_AT(nodes.steps + at + 1), RIMS_AT(nodes.rims + at + 1));
      if (j > 0) {
        VI drawn = inside & ((before & RIM_DRAWN) != 0);
#if ALPHA_TEST
        for (uint bits = lane_mask(drawn); bits; bits &= bits - 1) {
          int l = FIRST_LANE(bits);
          if (is_whole(nodes, at - m + l, m)) continue;
          ((int *)&drawn)[l] = 0;
          draw_alone(to, nodes, h, perspective, first, m, i + l, j - 1);
        }
#endif
        if (any_lane(drawn)) draw_cells(to, a, b, c, d, drawn, large, at - m);
      }
      a = c; b = d; before = rim;
    }
  }
#endif
}

// A patch whose cells are nowhere larger than a pixel: every node into the pixel it falls into.
INLINE void draw_nodes(const Target *to, Nodes nodes, __global const float *h, int perspective, uint first, int m, int n,
                       int item) {
#if VW == 1
  for (int node = item; node < m * n; node += GROUP) {
    int i = node % m, j = node / m;
#else
  for (int j = 0; j < n; j++)
    for (int i = 0; i < m; i += VW) {
#endif
    uint at = first + (uint)j * m + i;
    VI rim = RIMS_AT(nodes.rims + at);
    VF place = TO_VF((VI)(i) + LANE_INDEX);
    Spot s = spot_at(h, perspective, place, (VF)(j), FLOATS_AT(nodes.steps + at), rim);
    VI live = (place < (VF)(m)) & ((rim & RIM_SHOWN) != 0) & (s.x >= to->limits.x) & (s.y >= to->limits.y)
            & (s.x < to->limits.z + 1) & (s.y < to->limits.w + 1);
    if (!any_lane(live)) continue;
    VF x = SEL((VF)(to->limits.x), s.x, live), y = SEL((VF)(to->limits.y), s.y, live);
    put_lanes(to, live, TO_VI(x), TO_VI(y), key_of(layer_of(to->view, s.z), s.r), at);
  }
}

#if LATTICE
#include "render/patch_lattice.clh"
#endif

INLINE uint patch_of(uint node, __global const uint *offsets, int count) {
#if EQUAL_NODES
  return node / EQUAL_NODES;
#else
  int low = 0, high = count;
  while (high - low > 1) {
    int middle = (low + high) / 2;
    if (offsets[middle] <= node) low = middle; else high = middle;
  }
  return low;
#endif
}

// The patches of a surface, projected.
typedef struct {
  __global const float *records;
  __global const int *sizes;
  __global const uint *offsets;
  int count;
} Patches;

// Interpolated normals that look away from the eye by `side` < 0: turned over where their facet, of slopes (fx, fy), shows its
// back by more than CONTOUR, the sine of an angle. Elsewhere, at contours, only what points away is mirrored: turned over they
// would point almost the other way. Nodes drawn as they are have no facet: there the normal itself decides, by more.
#define CONTOUR 0.05f
INLINE void face_eye(__global const float *h, int direct, VF fx, VF fy, VF ex, VF ey, VF side, VF *nx, VF *ny, VF *nz) {
  VF x = h[NX] - fx * h[NX + 1] - fy * h[NX + 2], y = h[NY] - fx * h[NY + 1] - fy * h[NY + 2];
  VF z = h[NZ] - fx * h[NZ + 1] - fy * h[NZ + 2], e2 = ex * ex + ey * ey + 1.0f, back = x * ex + y * ey + z;
  VF least = (x * x + y * y + z * z) * e2 * (direct ? 25.0f * CONTOUR * CONTOUR : CONTOUR * CONTOUR);
  VI away = side < 0.0f, over = away & (back < 0.0f) & (back * back > least);
  VF mirror = 2.0f * side / e2;
  mirror = SEL((VF)(0.0f), mirror, away);
  *nx = SEL(*nx - mirror * ex, -*nx, over); *ny = SEL(*ny - mirror * ey, -*ny, over); *nz = SEL(*nz - mirror, -*nz, over);
}

// What the winners show at pixels (px, py); `payload` NO_SAMPLE: nothing.
INLINE Shown resolve(__global const float *view, Patches patches, Nodes nodes, VU payload, VF px, VF py) {
  Shown out;
  VF zero = 0.0f;
  out.depth = EMPTY_DEPTH;
  out.nx = zero; out.ny = zero; out.nz = 1.0f; out.red = zero; out.green = zero; out.blue = zero;
  out.id = 0; out.count = 1; out.level = 0;
  int perspective = view[PERSPECTIVE] > 0.0f;
  VF ex = zero, ey = zero;  // towards the eye, z 1
  if (perspective) { ex = (px - view[CX]) * (-1.0f / view[FX]); ey = (py - view[CY]) * (1.0f / view[FY]); }
  VI left = payload != (VU)(NO_SAMPLE);
  if (!any_lane(left)) return out;
  // Which patches: 16 pixels show about two.
  uint lead = ((const uint *)&payload)[FIRST_LANE(lane_mask(left))], found[VW];
  int number = 0, cells = 0;
  VU at = SEL((VU)(lead), payload, left), start = lead;
  VI row = 1, rank = -1;
  for (uint bits = lane_mask(left); bits; bits = lane_mask(left)) {
    uint k = patch_of(((const uint *)&payload)[FIRST_LANE(bits)], patches.offsets, patches.count);
    uint first = patches.offsets[k], last = patches.offsets[k + 1];
    VI mine = left & (payload >= (VU)(first)) & (payload < (VU)(last));
    left = left & NOT(mine);
    start = SEL(start, (VU)(first), mine);
    row = SEL(row, (VI)(patches.sizes[2 * k]), mine);
    rank = SEL(rank, (VI)(number), mine);
    cells |= !(as_int(patches.records[(size_t)k * PATCH_STRIDE + PATCH_FLAGS]) & PATCH_DIRECT);
    found[number++] = k;
  }
  // The nodes of all lanes at once.
  VI within = AS_VI(at - start), j = TO_VI((TO_VF(within) + 0.5f) * (1.0f / TO_VF(row))), i = within - j * row;
  VI low = i < 0, high = i >= row;  // the division was rounded
  j = SEL(SEL(j, j - 1, low), j + 1, high); i = within - j * row;
  VF fi = TO_VF(i), fj = TO_VF(j), across_s = zero, across_t = zero;
  VU a[4], b[4], c[4], d[4], next = at + 1, above = at + AS_VU(row), across = above + 1;
  GATHERED(a, nodes.nodes, at)
  if (cells) {
    GATHERED(b, nodes.nodes, next)
    GATHERED(c, nodes.nodes, above)
    GATHERED(d, nodes.nodes, across)
  } else for (int q = 0; q < 4; q++) b[q] = c[q] = d[q] = a[q];
  // A patch at a time: its record is the same for all its lanes.
  for (int g = 0; g < number; g++) {
    VI mine = rank == g;
    __global const float *h = patches.records + (size_t)found[g] * PATCH_STRIDE;
    int flags = as_int(h[PATCH_FLAGS]);
    VF x, y, z, w, depth = zero, gx, gy, fx, fy, s = zero, t = zero;
    if (flags & PATCH_DIRECT) {
      project_nodes(h, perspective, fi, fj, AS_VF(a[0]), &x, &y, &depth, &w);
      gx = SLOPE_X(a); gy = SLOPE_Y(a);
      fx = gx * h[SLOPE_SCALE]; fy = gy * h[SLOPE_SCALE];
    } else {
#if LATTICE || SMOOTH_NORMALS
      Heights cell;
#define CORNER(k, n, node) cell.d[k] = AS_VF(n[0]); cell.gx[k] = SLOPE_X(n) * h[SLOPE_SCALE]; \
    cell.gy[k] = SLOPE_Y(n) * h[SLOPE_SCALE]; cell.gxy[k] = zero; \
    if (SMOOTH || SMOOTH_NORMALS) \
      for (int l = 0; l < VW; l++) ((float *)&cell.gxy[k])[l] = nodes.twists[((const uint *)&node)[l]];
      CORNER(0, a, at) CORNER(1, b, next) CORNER(2, c, above) CORNER(3, d, across)
#endif
#if LATTICE
      depth = seen_place(&cell, h, perspective, fi, fj, px, py, &s, &t);
#else
      VI hard = mine;
#if !TRIANGLES && !NODES
      VF e;
      hard = mine & NOT(place_on_ray(h, perspective, px, py, fi, fj, AS_VF(a[0]), AS_VF(b[0]), AS_VF(c[0]), AS_VF(d[0]),
                                     &s, &t, &e));
      depth = h[HZ] + (fi + s) * h[HZ + 1] + (fj + t) * h[HZ + 2] + (AS_VF(a[0]) + e) * h[HZ + 3];
#endif
      if (flags & PATCH_CLIPPED) hard = mine;
      if (any_lane(hard)) {
        VF bx, by, bz, bw, cx, cy, cz, cw, dx, dy, dz, dw, u, v, deep;
        project_nodes(h, perspective, fi, fj, AS_VF(a[0]), &x, &y, &z, &w);
        project_nodes(h, perspective, fi + 1.0f, fj, AS_VF(b[0]), &bx, &by, &bz, &bw);
        project_nodes(h, perspective, fi, fj + 1.0f, AS_VF(c[0]), &cx, &cy, &cz, &cw);
        project_nodes(h, perspective, fi + 1.0f, fj + 1.0f, AS_VF(d[0]), &dx, &dy, &dz, &dw);
        place_in_cell(x - px * w, y - py * w, bx - px * bw, by - py * bw, cx - px * cw, cy - py * cw, dx - px * dw,
                      dy - py * dw, z, bz, cz, dz, view[NEAR], &u, &v, &deep);
        s = SEL(s, u, hard); t = SEL(t, v, hard); depth = SEL(depth, deep, hard);
      }
#endif
      // Weights of the corners; the depth of two triangles is not bilinear.
      VF wd = s * t, wb = s - wd, wc = t - wd, wa = 1.0f - s - wc;
#define MEAN(f) (wa * f(a) + wb * f(b) + wc * f(c) + wd * f(d))
#if SMOOTH || SMOOTH_NORMALS
      smooth_height(&cell, s, t, &gx, &gy);
      gx *= 1.0f / h[SLOPE_SCALE]; gy *= 1.0f / h[SLOPE_SCALE];
#else
      gx = MEAN(SLOPE_X); gy = MEAN(SLOPE_Y);
#endif
      // Slopes of the facet itself.
      VF fa = AS_VF(a[0]), fb = AS_VF(b[0]) - fa, fc = AS_VF(c[0]) - fa, fd = AS_VF(d[0]) - fa;
#if TRIANGLES
      fx = SEL(fd - fc, fb, s >= t); fy = SEL(fc, fd - fb, s >= t);
#else
      fx = fb + t * (fd - fb - fc); fy = fc + s * (fd - fb - fc);
#endif
    }
    float scale = h[SLOPE_SCALE];
    gx *= scale; gy *= scale;
    out.depth = SEL(out.depth, depth, mine);
#if FIELD_LEVEL >= 0
    out.level = SEL(out.level, (VI)(flags >> PATCH_LEVEL), mine);
#endif
    VF nx = h[NX] - gx * h[NX + 1] - gy * h[NX + 2], ny = h[NY] - gx * h[NY + 1] - gy * h[NY + 2],
       nz = h[NZ] - gx * h[NZ + 1] - gy * h[NZ + 2];
    VF side = nx * ex + ny * ey + nz;
    if (any_lane(mine & (side < 0.0f))) face_eye(h, flags & PATCH_DIRECT, fx, fy, ex, ey, side, &nx, &ny, &nz);
    out.nx = SEL(out.nx, nx, mine); out.ny = SEL(out.ny, ny, mine); out.nz = SEL(out.nz, nz, mine);
    across_s = SEL(across_s, s, mine); across_t = SEL(across_t, t, mine);
  }
#if FIELD_COLOR >= 0
#if CHANNELS
#if LATTICE
  // Depth and normal are carried on beyond the cell, colours are not: they could leave their range.
  across_s = limited(across_s, zero, (VF)(1.0f)); across_t = limited(across_t, zero, (VF)(1.0f));
#endif
  VF wd = across_s * across_t, wb = across_s - wd, wc = across_t - wd, wa = 1.0f - across_s - wc, none = 0.0f;
  rank = rank >= 0;
#define COLOR(f) SEL(none, MEAN(f) * COLOR_UNIT, rank)
  out.red = COLOR(RED); out.green = COLOR(GREEN); out.blue = COLOR(BLUE);
#else
  out.red = view[PATCH_COLOR]; out.green = view[PATCH_COLOR + 1]; out.blue = view[PATCH_COLOR + 2];
#endif
#endif
  return out;
}

INLINE VU payload_of(const Target *to, int slot) {
#if VW == 1
  return to->slots[2 * slot + !ATOMICS_64];
#else
  VU out;
#if VW == 16 && defined(__clang__)
  out = __builtin_convertvector(*(const ulong16 *)(to->slots + slot), uint16);
#else
  for (int l = 0; l < VW; l++) ((uint *)&out)[l] = (uint)to->slots[slot + l];
#endif
  return out;
#endif
}

// Samples of a whole tile into the planes of its bins.
INLINE void store_block(__global float *planes, int was_touched, int at, const Shown *s, int surface) {
  VF before = EMPTY_DEPTH;
  if (was_touched) before = load_plane(planes, FIELD_DEPTH, at);
  VI closer = s->depth < before;
  store_plane(planes, FIELD_DEPTH, at, SEL(before, s->depth, closer));
  if (!any_lane(closer)) return;
  merge_plane(planes, FIELD_NORMAL, at, s->nx, closer);
  merge_plane(planes, FIELD_NORMAL + 1, at, s->ny, closer);
  merge_plane(planes, FIELD_NORMAL + 2, at, s->nz, closer);
#if FIELD_COLOR >= 0
  merge_plane(planes, FIELD_COLOR, at, s->red, closer);
  merge_plane(planes, FIELD_COLOR + 1, at, s->green, closer);
  merge_plane(planes, FIELD_COLOR + 2, at, s->blue, closer);
#endif
#if FIELD_ID >= 0
  merge_plane(planes, FIELD_ID, at, AS_VF((VI)(surface)), closer);
#endif
#if FIELD_COUNT >= 0
  merge_plane(planes, FIELD_COUNT, at, AS_VF(s->count), closer);
#endif
#if FIELD_LEVEL >= 0
  merge_plane(planes, FIELD_LEVEL, at, AS_VF(s->level), closer);
#endif
}

#if VW > 1
// The largest key of a bin of the tile: what lies behind it cannot show there.
INLINE uint farthest_of(const ulong *slots, int bin) {
  ulong most = 0;
  for (int q = 0; q < 4; q++) {
    const ulong *block = slots + 16 * ((bin / TILE_BINS * 2 + (q >> 1)) * BLOCKS + bin % TILE_BINS * 2 + (q & 1));
    for (int i = 0; i < 16; i++) most = block[i] > most ? block[i] : most;
  }
  return (uint)(most >> 32);
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

__kernel void tile_patches(__global const float *view, __global const short4 *boxes /* bins */,
                           __global const float *records, __global const int *sizes, __global const uint *offsets,
                           int count, __global const float *steps, __global const ushort *rims,
                           __global const uint4 *all_nodes, __global const float *twists, int surface, int tiles_x, int tile_count, int bins_x,
                           int bins_y, __global int *touched, __global float *all_planes,
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
  int width = (int)view[WIDTH], height = (int)view[HEIGHT];
  int bin_x = tile % tiles_x * TILE_BINS, bin_y = tile / tiles_x * TILE_BINS;
  to.x = bin_x * BIN; to.y = bin_y * BIN;
  to.slots = slots;
  to.cost = cost;
  int4 whole = (int4)(to.x, to.y, (to.x + TILE < width ? to.x + TILE : width) - 1,
                      (to.y + TILE < height ? to.y + TILE : height) - 1);
#define MISSES(b) (b.x > bin_x + TILE_BINS - 1 || b.z < bin_x || b.y > bin_y + TILE_BINS - 1 || b.w < bin_y)
#define CLIPPED_TO(b) (int4)(max(whole.x, b.x * BIN), max(whole.y, b.y * BIN), min(whole.z, b.z * BIN + BIN - 1), \
                             min(whole.w, b.w * BIN + BIN - 1))
#if VW == 1
  if (item == 0) any = 0;
  for (int i = item; i < TILE_BINS * TILE_BINS; i += GROUP) cost[i] = 0;
  for (int i = item; i < TILE * TILE * 2; i += GROUP) slots[i] = NO_SAMPLE;
  SYNC;
  for (to.round = 0; to.round < ROUNDS; to.round++) {
    for (int k = 0; k < count; k++) {
      short4 b = boxes[k];
      if (MISSES(b)) continue;
      any = 1;
      draw_hit(&to, patches, nodes, k, CLIPPED_TO(b), item);
    }
    SYNC;
  }
#else
  for (int k = 0; k < count;) {
    int hits[HITS], sorted[HITS], found = 0, starts[CLASSES + 1];
    for (; k < count && found < HITS; k++) {
      short4 b = boxes[k];
      hits[found] = k;
      found += !MISSES(b);
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
    for (int i = 0; i < TILE_BINS * TILE_BINS; i++) { farthest[i] = NO_SAMPLE; stale[i] = 0; }
    for (int i = 0; i < found; i++) {
      int p = sorted[i];
      short4 b = boxes[p];
      int x0 = max((int)b.x, bin_x) - bin_x, x1 = min((int)b.z, bin_x + TILE_BINS - 1) - bin_x;
      int y0 = max((int)b.y, bin_y) - bin_y, y1 = min((int)b.w, bin_y + TILE_BINS - 1) - bin_y;
      float layer = (records[(size_t)p * PATCH_STRIDE + PATCH_NEAR] - view[FIRST_DEPTH]) * view[LAYER] - 2.0f;
      layer = layer < 0.0f ? 0.0f : layer > LAST_LAYER ? LAST_LAYER : layer;
      uint key = (uint)layer << 12;
      int shows = 0;
      for (int y = y0; y <= y1 && !shows; y++)
        for (int x = x0; x <= x1 && !shows; x++) {
          int bin = y * TILE_BINS + x;
          if (stale[bin]) { farthest[bin] = farthest_of(slots, bin); stale[bin] = 0; }
          shows = farthest[bin] >= key;
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
      Shown rows[VW / 4];
      int some = 0;
      for (int b = 0; b < VW / 4; b++) {
        if (x + 4 * b >= to.x + TILE) break;
        VU payload = payload_of(&to, SLOT_OF(x - to.x + 4 * b, y - to.y));
        VF px = TO_VF((VI)(x + 4 * b) + (LANE_INDEX & 3)) + 0.5f, py = TO_VF((VI)(y) + (LANE_INDEX >> 2)) + 0.5f;
        Shown s = resolve(view, patches, nodes, payload, px, py);
        s.id = surface;
        some |= any_lane(payload != (VU)(NO_SAMPLE));
#define PIECES(f) for (int r = 0; r < VW / 4; r++) ((float4 *)&rows[r].f)[b] = ((float4 *)&s.f)[r];
        PIECES(depth) PIECES(nx) PIECES(ny) PIECES(nz)
#if FIELD_COLOR >= 0
        PIECES(red) PIECES(green) PIECES(blue)
#endif
#if FIELD_ID >= 0
        PIECES(id)
#endif
#if FIELD_COUNT >= 0
        PIECES(count)
#endif
#if FIELD_LEVEL >= 0
        PIECES(level)
#endif
      }
      int lanes = whole.z + 1 - x < VW ? whole.z + 1 - x : VW;
      for (int r = 0; r < VW / 4 && y + r <= whole.w; r++) {
        if (some) shade_row(frame, shading, &rows[r], width, x, y + r, lanes, out);
        else background_row(shading, width, x, y + r, lanes, out);
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
    if (x >= bins_x || y >= bins_y) continue;
    int bin = y * bins_x + x, was_touched = touched[bin] >= 0;
    __global float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS;
#if VW == 1
    int px = x * BIN + item % BIN, py = y * BIN + item / BIN;
    Shown s = resolve(view, patches, nodes, payload_of(&to, SLOT_OF(px - to.x, py - to.y)), px + 0.5f, py + 0.5f);
    store_block(planes, was_touched, item, &s, surface);
    barrier(CLK_GLOBAL_MEM_FENCE);
    if (item == 0) touched[bin] = (was_touched ? touched[bin] : 0) + cost[b];
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
#endif
}
