// Draw the patches of every tile by subdivision (paper, section 3): every cell becomes points less than a pixel apart,
// which compete for the pixels they fall into; then the winners' depth, normal and colour at the pixels' centres go into
// the planes. SMOOTH = 0: cells are bilinear, 1: C1 over the patch.
//
// The points are the centres of 2^k x 2^l parts of a cell, each part at most a pixel wide and high: so every pixel whose
// centre a patch covers holds a point. Which points there are depends on the cell alone, not on tiles or lanes.
//
// VW > 1: one work-item per tile, lanes over a row of cells (4x4 points of one cell where cells are large).
// VW = 1: one work-group of 64 work-items per tile, each a cell, then a pixel of the bin at hand.
// Twin: tests/reference/render_patch_modes.py, tile_lattice.
#include "render/patch_lanes.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#define TILE (TILE_BINS * BIN)
#ifndef PART
#define PART 0.98f  // pixels across a part: less than 1, for rounding
#endif
#define LARGE 64.0f    // points of a cell from which on it is drawn by itself, its parts outside the tile left out
#define DEEPEST 12     // halvings of a cell that reaches the near plane
#define STACK (3 * DEEPEST + 4)

#if VW == 1
#define GROUP 64
#define LANE_X(pixel) ((pixel) & 7)
#define LANE_Y(pixel) ((pixel) >> 3)
// Two rounds of 32-bit atomics stand for a 64-bit minimum: the least key, then the least payload of that key. One body
// runs in both rounds, so that both round the same way.
#define ROUNDS 2
#define BARRIER barrier(CLK_GLOBAL_MEM_FENCE)
#else
#define GROUP 1
#define LANE_X(first) (LANE_INDEX & 3)
#define LANE_Y(first) (LANE_INDEX >> 2)
#define ROUNDS 1
#define BARRIER
#endif

typedef struct {
  __global const float *view, *h;  // h: the projected patch
  __global uint2 *slots;
  float x0, y0, x1, y1;  // pixels of the tile inside the picture: x0 <= x < x1
  int perspective, round;
  float near;
} Target;

typedef struct { VF x, y, z, w; } Point;

INLINE Point point_at(const Target *to, VF i, VF j, VF d) {
  __global const float *h = to->h;
  Point p;
  p.x = h[HX] + i * h[HX + 1] + j * h[HX + 2] + d * h[HX + 3];
  p.y = h[HY] + i * h[HY + 1] + j * h[HY + 2] + d * h[HY + 3];
  p.z = h[HZ] + i * h[HZ + 1] + j * h[HZ + 2] + d * h[HZ + 3];
  p.w = to->perspective ? p.z : (VF)(1.0f);
  return p;
}

// Points of cells that are named by their first nodes.
INLINE void put_points(const Target *to, Point p, VF border, VU payload, VI live) {
  VF inv = 1.0f / p.w, x = p.x * inv, y = p.y * inv;
  live = live & (p.z > to->near) & (p.w > 0.0f) & (x >= to->x0) & (x < to->x1) & (y >= to->y0) & (y < to->y1);
  if (!any_lane(live)) return;
  VF layer = (p.z - to->view[FIRST_DEPTH]) * to->view[LAYER];
  layer = VMAX(layer, (VF)(0.0f)); layer = VMIN(layer, (VF)(LAST_LAYER));
  VI key = TO_VI(layer) << 12 | (4095 - TO_VI(border));
  VI at = TO_VI(SEL((VF)(0.0f), y - to->y0, live)) * TILE + TO_VI(SEL((VF)(0.0f), x - to->x0, live));
#if VW == 1
  volatile __global uint *slot = (volatile __global uint *)(to->slots + at);
  if (to->round == 0) atomic_min(slot, as_uint(key));
  else if (*slot == as_uint(key)) atomic_min(slot + 1, payload);
#else
  for (int l = 0; l < VW; l++)
    if (((int *)&live)[l]) put_sample(to->slots + ((int *)&at)[l], ((uint *)&key)[l], ((uint *)&payload)[l]);
#endif
}

// Largest |change| of a pixel position (x, y) along a part's side, for a change of node place (di, dj) and of height g.
INLINE void side_px(const Target *to, Point p, VF inv, int along, VF g, VF *x, VF *y) {
  __global const float *h = to->h;
  VF dw = to->perspective ? h[HZ + along] + g * h[HZ + 3] : (VF)(0.0f);
  VF dx = (h[HX + along] + g * h[HX + 3] - p.x * inv * dw) * inv, dy = (h[HY + along] + g * h[HY + 3] - p.y * inv * dw) * inv;
  dx = VMAX(dx, -dx); dy = VMAX(dy, -dy);
  *x = VMAX(*x, dx); *y = VMAX(*y, dy);
}

// The slopes of the cell along its two sides that bound its points' distances: at the corners, and in the middle of the
// sides, where a cubic can be steeper.
INLINE void cell_sides(const Target *to, const Heights *c, const Point *p, const VF *inv, VF *sx, VF *sy, VF *tx, VF *ty) {
  *sx = *sy = *tx = *ty = 0.0f;
  for (int k = 0; k < 4; k++) {
    VF gs = c->d[k | 1] - c->d[k & 2], gt = c->d[k | 2] - c->d[k & 1];
#if SMOOTH
    VF ms = 1.5f * gs - 0.25f * (c->gx[k | 1] + c->gx[k & 2]), mt = 1.5f * gt - 0.25f * (c->gy[k | 2] + c->gy[k & 1]);
    side_px(to, p[k], inv[k], 1, ms, sx, sy); side_px(to, p[k], inv[k], 2, mt, tx, ty);
    gs = c->gx[k]; gt = c->gy[k];
#endif
    side_px(to, p[k], inv[k], 1, gs, sx, sy); side_px(to, p[k], inv[k], 2, gt, tx, ty);
  }
}

// One large cell, recursively: parts outside the tile are left, parts of at most 4x4 points drawn.
INLINE int draw_large(const Target *to, const Heights *cell, float i, float j, const VF *borders, const VF *alphas,
                      uint payload) {
  float u[STACK], v[STACK], bend = 0.0f;
  int level[STACK], top = 1, points = 0;
  u[0] = v[0] = 0.0f; level[0] = 0;
#if SMOOTH
  // How far heights leave the bilinear ones of a part's corners, at most.
  for (int k = 0; k < 4; k++) {
    float a = ((float *)&cell->gx[k])[0] - ((float *)&cell->d[k | 1])[0] + ((float *)&cell->d[k & 2])[0];
    float b = ((float *)&cell->gy[k])[0] - ((float *)&cell->d[k | 2])[0] + ((float *)&cell->d[k & 1])[0];
    bend = fmax(bend, fabs(a) + fabs(b));
  }
#endif
  while (top > 0) {
    top--;
    float part = 1.0f / (1 << level[top]), u0 = u[top], v0 = v[top];
    int deep = level[top], behind = 0, left = 0, right = 0, above = 0, below = 0, front = 0;
    float x[4], y[4], z_low = INFINITY, z_high = -INFINITY, edge = part * bend;
    for (int k = 0; k < 4; k++) {
      VF gs, gt, s = u0 + (k & 1) * part, t = v0 + (k >> 1) * part, d = cell_height(cell, s, t, &gs, &gt);
      Point q = point_at(to, i + s, j + t, d);
      float px = ((float *)&q.x)[0], py = ((float *)&q.y)[0], z = ((float *)&q.z)[0], w = ((float *)&q.w)[0];
      __global const float *h = to->h;
      float wd = to->perspective ? h[HZ + 3] : 0.0f;
      // 1/64 pixel covers the rounding of points on the tile's border.
#define BEYOND(a, b) (a + edge * fabs(b) < 0.0f)
      left += BEYOND(px - (to->x0 - 0.015625f) * w, h[HX + 3] - to->x0 * wd);
      right += BEYOND((to->x1 + 0.015625f) * w - px, to->x1 * wd - h[HX + 3]);
      above += BEYOND(py - (to->y0 - 0.015625f) * w, h[HY + 3] - to->y0 * wd);
      below += BEYOND((to->y1 + 0.015625f) * w - py, to->y1 * wd - h[HY + 3]);
      behind += BEYOND(z - to->near, h[HZ + 3]);
      front += z - edge * fabs(h[HZ + 3]) > to->near && w - edge * fabs(wd) > 0.0f;
      x[k] = px / w; y[k] = py / w;
      z_low = fmin(z_low, w); z_high = fmax(z_high, w);
    }
    if (left == 4 || right == 4 || above == 4 || below == 4 || behind == 4) continue;
    int small = deep >= DEEPEST;
    if (front == 4) {
      float sx = fmax(fabs(x[1] - x[0]), fabs(x[3] - x[2])), sy = fmax(fabs(y[1] - y[0]), fabs(y[3] - y[2]));
      float tx = fmax(fabs(x[2] - x[0]), fabs(x[3] - x[1])), ty = fmax(fabs(y[2] - y[0]), fabs(y[3] - y[1]));
      small = small || fmax(sx + tx, sy + ty) * (z_high / z_low) * (SMOOTH ? 1.25f : 1.0f) <= 4.0f * PART;
    }
    if (!small) {
      for (int k = 3; k >= 0; k--) {
        u[top] = u0 + (k & 1) * 0.5f * part; v[top] = v0 + (k >> 1) * 0.5f * part; level[top++] = deep + 1;
      }
      continue;
    }
    for (int p = 0; p < 16; p += VW) {
      VI number = p + LANE_INDEX;
      VF s = u0 + (TO_VF(number & 3) + 0.5f) * (0.25f * part), t = v0 + (TO_VF(number >> 2) + 0.5f) * (0.25f * part), gs, gt;
      VF d = cell_height(cell, s, t, &gs, &gt);
      VI live = TRUE_LANES;
#if ALPHA_TEST
      live = mixed(alphas[0], alphas[1], alphas[2], alphas[3], s, t) >= 127.5f;
#endif
      put_points(to, point_at(to, i + s, j + t, d), mixed(borders[0], borders[1], borders[2], borders[3], s, t),
                 (VU)(payload), live);
    }
    points += 16;
  }
  return points;
}

// The cells (i0 + lane, j); returns the number of points.
INLINE int draw_row(const Target *to, uint first, int m, int i0, int j, __global const height_t *heights,
                    __global const uchar *cells, __global const float *borders, __global const float2 *slopes,
                    __global const float *twists, __global const uchar *alphas) {
  Heights c;
  VF b[4], a[4], fi;
  VI live;
  VU payload;
  for (int l = 0; l < VW; l++) {
    int i = i0 + l < m - 1 ? i0 + l : m - 2;
    uint at = first + (uint)j * m + i;
    ((uint *)&payload)[l] = at;
    ((float *)&fi)[l] = i;
    ((int *)&live)[l] = i0 + l < m - 1 && cells[at] ? (VW == 1 ? 1 : -1) : 0;
    for (int k = 0; k < 4; k++) {
      uint node = at + (k & 1) + (k >> 1) * m;
      ((float *)&c.d[k])[l] = heights[node];
      ((float *)&b[k])[l] = borders[node];
#if SMOOTH
      ((float *)&c.gx[k])[l] = slopes[node].x;
      ((float *)&c.gy[k])[l] = slopes[node].y;
      ((float *)&c.gxy[k])[l] = twists[node];
#endif
#if ALPHA_TEST
      ((float *)&a[k])[l] = alphas[node];
#endif
    }
  }
  if (!any_lane(live)) return 0;
  Point p[4];
  VF inv[4], x0 = INFINITY, y0 = INFINITY, x1 = -INFINITY, y1 = -INFINITY, sx, sy, tx, ty, w_low = INFINITY, w_high = 0.0f;
  VI front = live;
  for (int k = 0; k < 4; k++) {
    b[k] *= to->view[BORDER_SCALE];
    b[k] = VMIN(b[k], (VF)(4095.0f));
    p[k] = point_at(to, fi + (k & 1), (VF)(j + (k >> 1)), c.d[k]);
    front = front & (p[k].z > to->near) & (p[k].w > 0.0f);
    inv[k] = 1.0f / p[k].w;
    VF x = p[k].x * inv[k], y = p[k].y * inv[k];
    x0 = VMIN(x0, x); x1 = VMAX(x1, x); y0 = VMIN(y0, y); y1 = VMAX(y1, y);
    w_low = VMIN(w_low, p[k].w); w_high = VMAX(w_high, p[k].w);
  }
  cell_sides(to, &c, p, inv, &sx, &sy, &tx, &ty);
  // Cells in front of the near plane and outside the tile; a smooth cell stays within its corners' box grown by its sides.
  VF mx = SMOOTH ? 0.5f * (sx + tx) : (VF)(0.0f), my = SMOOTH ? 0.5f * (sy + ty) : (VF)(0.0f);
  VI outside = (x1 + mx < to->x0) | (x0 - mx >= to->x1) | (y1 + my < to->y0) | (y0 - my >= to->y1);
  live = live & NOT(front & outside);
  if (!any_lane(live)) return 0;
  VF stretch = w_high / w_low, ns = 1.0f, nt = 1.0f;
  sx *= stretch; sy *= stretch; tx *= stretch; ty *= stretch;
  for (int step = 0; step < 7; step++) {
    VI wide = live & front & ((sx + tx > PART) | (sy + ty > PART)) & (ns * nt <= LARGE);
    if (!any_lane(wide)) continue;
    VF s_most = VMAX(sx, sy), t_most = VMAX(tx, ty);
    VI halve_s = wide & (s_most >= t_most), halve_t = wide & (s_most < t_most);
    ns = SEL(ns, 2.0f * ns, halve_s); nt = SEL(nt, 2.0f * nt, halve_t);
    sx = SEL(sx, 0.5f * sx, halve_s); sy = SEL(sy, 0.5f * sy, halve_s);
    tx = SEL(tx, 0.5f * tx, halve_t); ty = SEL(ty, 0.5f * ty, halve_t);
  }
  VI large = live & (NOT(front) | (ns * nt > LARGE));
  int points = 0;
  if (any_lane(large)) {
    for (int l = 0; l < VW; l++) {
      if (!((int *)&large)[l]) continue;
      Heights one;
      VF ob[4], oa[4];
      for (int k = 0; k < 4; k++) {
        one.d[k] = ((float *)&c.d[k])[l];
        ob[k] = ((float *)&b[k])[l];
#if SMOOTH
        one.gx[k] = ((float *)&c.gx[k])[l]; one.gy[k] = ((float *)&c.gy[k])[l]; one.gxy[k] = ((float *)&c.gxy[k])[l];
#endif
#if ALPHA_TEST
        oa[k] = ((float *)&a[k])[l];
#endif
      }
      points += draw_large(to, &one, ((float *)&fi)[l], j, ob, oa, ((uint *)&payload)[l]);
    }
    live = live & NOT(large);
  }
  // The points of the small cells, one of every lane at a time.
  int rows = 0, columns = 0;
  for (int l = 0; l < VW; l++)
    if (((int *)&live)[l]) {
      columns = max(columns, (int)((float *)&ns)[l]);
      rows = max(rows, (int)((float *)&nt)[l]);
    }
  VF ds = 1.0f / ns, dt = 1.0f / nt, t = 0.5f * dt;
  for (int row = 0; row < rows; row++, t += dt) {
    VF e = b[0] + t * (b[2] - b[0]), e_step = ds * (b[1] + t * (b[3] - b[1]) - e);
#if SMOOTH
    VF g[4];
    hermite(t, g);
    VF h0 = c.d[0] * g[0] + c.d[2] * g[1] + c.gy[0] * g[2] + c.gy[2] * g[3];
    VF h1 = c.d[1] * g[0] + c.d[3] * g[1] + c.gy[1] * g[2] + c.gy[3] * g[3] - h0;
    VF q0 = c.gx[0] * g[0] + c.gx[2] * g[1] + c.gxy[0] * g[2] + c.gxy[2] * g[3];
    VF q1 = c.gx[1] * g[0] + c.gx[3] * g[1] + c.gxy[1] * g[2] + c.gxy[3] * g[3];
    VF k2 = 3.0f * h1 - 2.0f * q0 - q1, k3 = q0 + q1 - 2.0f * h1;
#else
    VF d = c.d[0] + t * (c.d[2] - c.d[0]), d_step = ds * (c.d[1] + t * (c.d[3] - c.d[1]) - d);
    d += 0.5f * d_step;
#endif
    e += 0.5f * e_step;
    VF s = 0.5f * ds;
    VI in_row = live & (t < 1.0f);
    for (int column = 0; column < columns; column++) {
#if SMOOTH
      VF d = h0 + s * (q0 + s * (k2 + s * k3));
#endif
      VI shown = in_row & (s < 1.0f);
#if ALPHA_TEST
      shown = shown & (mixed(a[0], a[1], a[2], a[3], s, t) >= 127.5f);
#endif
      put_points(to, point_at(to, fi + s, j + t, d), e, payload, shown);
      s += ds; e += e_step;
#if !SMOOTH
      d += d_step;
#endif
    }
  }
  return points + rows * columns * VW;
}

// The place (s, t) that the ray of a pixel meets a cell at, by Newton's method from its middle; up to half a cell outside,
// since the pixel's centre may lie beside the cell whose point won. Returns the depth there.
INLINE VF seen_place(const Heights *c, const VF *h, int perspective, VF i, VF j, VF px, VF py, VF *s, VF *t, VF *gs, VF *gt) {
  VF x = 0.5f, y = 0.5f, d, det;
  // x w - px w and y w - py w are linear in place and height.
  VF ax[4], ay[4];
  for (int k = 0; k < 4; k++) {
    VF w = perspective ? h[HZ + k] : (VF)(k ? 0.0f : 1.0f);
    ax[k] = h[HX + k] - px * w; ay[k] = h[HY + k] - py * w;
  }
  ax[0] += i * ax[1] + j * ax[2]; ay[0] += i * ay[1] + j * ay[2];
  for (int step = 0; step < 3; step++) {
    d = cell_height(c, x, y, gs, gt);
    VF fx = ax[0] + x * ax[1] + y * ax[2] + d * ax[3], fy = ay[0] + x * ay[1] + y * ay[2] + d * ay[3];
    VF xs = ax[1] + *gs * ax[3], xt = ax[2] + *gt * ax[3], ys = ay[1] + *gs * ay[3], yt = ay[2] + *gt * ay[3];
    det = xs * yt - xt * ys;
    VF inv = SEL((VF)(0.0f), 1.0f / det, (det > 1e-20f) | (det < -1e-20f));
    x -= (fx * yt - fy * xt) * inv; y -= (fy * xs - fx * ys) * inv;
    x = VMAX(x, (VF)(-0.5f)); x = VMIN(x, (VF)(1.5f)); y = VMAX(y, (VF)(-0.5f)); y = VMIN(y, (VF)(1.5f));
  }
  d = cell_height(c, x, y, gs, gt);
  *s = x; *t = y;
  return h[HZ] + (i + x) * h[HZ + 1] + (j + y) * h[HZ + 2] + d * h[HZ + 3];
}

// What the winners of one block (VW = 1: one pixel) show goes into the planes. Returns the number of hits.
INLINE int resolve_block(__global const float *view, __global const uint2 *slots, __global const float *records,
                         __global const int *sizes, __global const uint *offsets, int count,
                         __global const height_t *heights, __global const float2 *slopes, __global const float *twists,
                         __global const uchar *colors, __global const float *linear, __global const float4 *lit,
                         __global float *planes, int was_touched, int surface, int bin_x, int bin_y, int tile_x,
                         int tile_y, VI lane_x, VI lane_y, int at_pixel) {
  VI hit = 0;
  VF i = 0.0f, j = 0.0f, h[PATCH_FLOATS], rgb[3];
  Heights c;
  int patch = -1, hits = 0;
  for (int f = 0; f < PATCH_FLOATS; f++) h[f] = 0.0f;
  for (int k = 0; k < 4; k++) c.d[k] = c.gx[k] = c.gy[k] = c.gxy[k] = 0.0f;
  VI levels = 0;
  uint nodes[VW];
  int widths[VW];
  for (int l = 0; l < VW; l++) {
    int x = bin_x * BIN + ((int *)&lane_x)[l] - tile_x, y = bin_y * BIN + ((int *)&lane_y)[l] - tile_y;
    uint node = slots[y * TILE + x].y;
    nodes[l] = 0; widths[l] = 0;
    if (node == NO_SAMPLE) continue;
    if (patch < 0 || node < offsets[patch] || (patch + 1 < count && node >= offsets[patch + 1])) {
      int low = 0, high = count;
      while (high - low > 1) {
        int middle = (low + high) / 2;
        if (offsets[middle] <= node) low = middle; else high = middle;
      }
      patch = low;
    }
    int m = sizes[2 * patch], place = node - offsets[patch];
    hits++;
    ((int *)&hit)[l] = VW == 1 ? 1 : -1;
    nodes[l] = node; widths[l] = m;
    ((float *)&j)[l] = place / m; ((float *)&i)[l] = place % m;
    __global const float *record = records + (size_t)patch * PATCH_FLOATS;
    for (int f = 0; f < 21; f++) ((float *)&h[f])[l] = record[f];
    for (int k = 0; k < 4; k++) {
      uint corner = node + (k & 1) + (k >> 1) * m;
      ((float *)&c.d[k])[l] = heights[corner];
      ((float *)&c.gx[k])[l] = slopes[corner].x;
      ((float *)&c.gy[k])[l] = slopes[corner].y;
#if CURVED
      ((float *)&c.gxy[k])[l] = twists[corner];
#endif
    }
  }
  VF before = EMPTY_DEPTH, depth = EMPTY_DEPTH;
  if (was_touched) before = load_plane(planes, FIELD_DEPTH, at_pixel);
  if (!hits) {
    if (!was_touched) store_plane(planes, FIELD_DEPTH, at_pixel, before);
    return 0;
  }
  VF px = TO_VF(lane_x) + (bin_x * BIN + 0.5f), py = TO_VF(lane_y) + (bin_y * BIN + 0.5f), s, t, gs, gt;
  int perspective = view[PERSPECTIVE] > 0.0f;
  depth = seen_place(&c, h, perspective, i, j, px, py, &s, &t, &gs, &gt);
  hit = hit & (depth > view[NEAR]);
  VI closer = hit & (depth < before);
  store_plane(planes, FIELD_DEPTH, at_pixel, SEL(before, depth, closer));
#if CURVED
  smooth_height(&c, s, t, &gs, &gt);
#else
  gs = mixed(c.gx[0], c.gx[1], c.gx[2], c.gx[3], s, t);
  gt = mixed(c.gy[0], c.gy[1], c.gy[2], c.gy[3], s, t);
#endif
  VF nx = h[NX] - gs * h[NX + 1] - gt * h[NX + 2], ny = h[NY] - gs * h[NY + 1] - gt * h[NY + 2];
  VF nz = h[NZ] - gs * h[NZ + 1] - gt * h[NZ + 2], ex = 0.0f, ey = 0.0f;
  if (perspective) { ex = (view[CX] - px) / view[FX]; ey = (py - view[CY]) / view[FY]; }
  VF side = SEL((VF)(1.0f), (VF)(-1.0f), nx * ex + ny * ey + nz < 0.0f);
  merge_plane(planes, FIELD_NORMAL, at_pixel, side * nx, closer);
  merge_plane(planes, FIELD_NORMAL + 1, at_pixel, side * ny, closer);
  merge_plane(planes, FIELD_NORMAL + 2, at_pixel, side * nz, closer);
#if FIELD_COLOR >= 0
  // Depth and normals are carried on beyond the cell, colours are not: they could leave their range.
  s = VMAX(s, (VF)(0.0f)); s = VMIN(s, (VF)(1.0f)); t = VMAX(t, (VF)(0.0f)); t = VMIN(t, (VF)(1.0f));
  for (int k = 0; k < 3; k++) {
#if LIT_NODES || CHANNELS
    VF corner[4];
    for (int q = 0; q < 4; q++) corner[q] = 0.0f;
    for (int l = 0; l < VW; l++) {
      if (!widths[l]) continue;
      for (int q = 0; q < 4; q++) {
        uint node = nodes[l] + (q & 1) + (q >> 1) * widths[l];
#if LIT_NODES
        ((float *)&corner[q])[l] = ((__global const float *)(lit + node))[k];
#else
        ((float *)&corner[q])[l] = linear[colors[(size_t)CHANNELS * node + k]];
#endif
      }
    }
    rgb[k] = mixed(corner[0], corner[1], corner[2], corner[3], s, t);
#else
    rgb[k] = view[PATCH_COLOR + k];
#endif
#if LIT_NODES
    rgb[k] = -VMAX(rgb[k], (VF)(0.0f));  // the sign says that light is in it
#endif
    merge_plane(planes, FIELD_COLOR + k, at_pixel, rgb[k], closer);
  }
#endif
#if FIELD_ID >= 0
  merge_plane(planes, FIELD_ID, at_pixel, AS_VF((VI)(surface)), closer);
#endif
#if FIELD_COUNT >= 0
  merge_plane(planes, FIELD_COUNT, at_pixel, AS_VF((VI)(1)), closer);
#endif
#if FIELD_LEVEL >= 0
  merge_plane(planes, FIELD_LEVEL, at_pixel, AS_VF(levels), closer);
#endif
  return hits;
}

__kernel void tile_lattice(__global const float *view, __global const int4 *rectangles, __global const float *records,
                           __global const int *sizes, __global const uint *offsets, int count,
                           __global const height_t *heights, __global const uchar *cells, __global const float *borders,
                           __global const float2 *slopes, __global const float *twists, __global const uchar *alphas,
                           __global const uchar *colors, __global const float *linear, __global const float4 *lit,
                           int surface, int tiles_x, int tile_count, int bins_x, int bins_y,
                           __global uint2 *all_slots, __global int *touched, __global float *all_planes) {
#if VW == 1
  __local int group_hits;
  int tile = get_group_id(0), item = get_local_id(0);
#else
  int tile = get_global_id(0), item = 0;
#endif
  if (tile >= tile_count) return;
  int tile_x = tile % tiles_x * TILE, tile_y = tile / tiles_x * TILE;
  Target to;
  to.view = view; to.perspective = view[PERSPECTIVE] > 0.0f; to.near = view[NEAR];
  to.slots = all_slots + (size_t)tile * TILE * TILE;
  to.x0 = tile_x; to.y0 = tile_y;
  to.x1 = fmin((float)(tile_x + TILE), view[WIDTH]); to.y1 = fmin((float)(tile_y + TILE), view[HEIGHT]);
  for (int i = item; i < TILE * TILE; i += GROUP) to.slots[i] = (uint2)(NO_SAMPLE, NO_SAMPLE);
  BARRIER;
  int any = 0;
  for (int round = 0; round < ROUNDS; round++) {
    to.round = round;
    for (int k = 0; k < count; k++) {
      int4 r = rectangles[k];
      // A point of a patch may be half a pixel off the pixels whose centres it covers.
      if (r.x - 1 > tile_x + TILE - 1 || r.z + 1 < tile_x || r.y - 1 > tile_y + TILE - 1 || r.w + 1 < tile_y || r.x > r.z)
        continue;
      any = 1;
      int m = sizes[2 * k], n = sizes[2 * k + 1];
      uint first = offsets[k];
      to.h = records + (size_t)k * PATCH_FLOATS;
#if VW == 1
      for (int cell = item; cell < (m - 1) * (n - 1); cell += GROUP)
        draw_row(&to, first, m, cell % (m - 1), cell / (m - 1), heights, cells, borders, slopes, twists, alphas);
#else
      for (int j = 0; j < n - 1; j++)
        for (int i = 0; i < m - 1; i += VW)
          draw_row(&to, first, m, i, j, heights, cells, borders, slopes, twists, alphas);
#endif
    }
    BARRIER;
  }
  if (!any) return;
  for (int b = 0; b < TILE_BINS * TILE_BINS; b++) {
    int bin_x = tile_x / BIN + b % TILE_BINS, bin_y = tile_y / BIN + b / TILE_BINS;
    if (bin_x >= bins_x || bin_y >= bins_y) continue;
    int bin = bin_y * bins_x + bin_x, was_touched = touched[bin] >= 0, hits = 0;
    __global float *planes = all_planes + (size_t)bin * BIN_PIXELS * FIELDS;
#define RESOLVE(lane_x, lane_y, at) resolve_block(view, to.slots, records, sizes, offsets, count, heights, slopes, twists, \
    colors, linear, lit, planes, was_touched, surface, bin_x, bin_y, tile_x, tile_y, lane_x, lane_y, at)
#if VW == 1
    if (item == 0) group_hits = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    int mine = RESOLVE(LANE_X(item), LANE_Y(item), item);
    atomic_add(&group_hits, mine);
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    hits = group_hits;
#else
    for (int part = 0; part < 64 / VW; part++) {
      int quarter = part / (16 / VW), qx = (quarter & 1) * 4, qy = (quarter >> 1) * 4 + part % (16 / VW) * (VW / 4);
      hits += RESOLVE(qx + LANE_X(0), qy + LANE_Y(0), qy * BIN + qx);
    }
#endif
    if (item == 0 && (hits || was_touched)) touched[bin] = (was_touched ? touched[bin] : 0) + hits;
  }
}
