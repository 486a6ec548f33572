// Single rays against scale maps: the surface |p| = rho(p / |p|) over the net of texels, interpolated within each cell as
// clsurf/surface/cube.py says. A bottom node holds 16 blocks of 4 x 4 cells; the lanes are the cells of one block.
//
// A cell is a cone from the centre with four plane sides, on which the ray is inside for one interval of t. There
// f = |p| - rho is followed from three points and, where they have one sign, the lowest point of their parabola; a root
// is closed in by false position. Intervals overlap a little, so that no ray slips between cells. Twin:
// tests/reference/scale_map.py, ray_scale_map.
#include "trace/ray_walk.clh"
#include "common/cube.clh"

#define CELLS 16
#define BLOCK_FLOATS 32  // face, row and column of the first cell, layer, then 5 x 5 distances, -1: a hole
#define OVERLAP 1e-5f    // of intervals; and how far behind a hit the next one is looked for
#define STEPS 24         // of false position, at most
#define CLOSE 5e-7f      // radii: what a root may be off along the radius

typedef struct { float low; } Goal;  // hits are looked for behind t = low
typedef struct { float key; int slot; } Found;
typedef struct { __global const float *boxes, *blocks; int first_bottom, size; } Model;

// A ray in a face's frame, and the cells of a block.
typedef struct { float w0, s0, t0, w1, s1, t1; } Frame;
typedef struct { VF row, column, corner[4]; } Cells;

INLINE Frame frame_of(const Ray *r, int face) {
  Frame f;
  face_frame(face, r->ox, r->oy, r->oz, &f.w0, &f.s0, &f.t0);
  face_frame(face, r->dx, r->dy, r->dz, &f.w1, &f.s1, &f.t1);
  return f;
}

INLINE VF outside(VF w, VF s, VF t, int size, const Cells *k) {
  VF inverse = 1.0f / w, u, v;
  net_coordinates(s * inverse, t * inverse, size, &u, &v);
  u -= k->column - 1.0f; v -= k->row - 1.0f;  // the net counts from the first texel, cells from the border before it
  // Near the centre the overlap of intervals reaches far out of the cell.
  u = VMIN(VMAX(u, (VF)(-0.5f)), (VF)(1.5f)); v = VMIN(VMAX(v, (VF)(-0.5f)), (VF)(1.5f));
  VF upper = k->corner[0] + u * (k->corner[1] - k->corner[0]), lower = k->corner[2] + u * (k->corner[3] - k->corner[2]);
  return VSQRT(w * w + s * s + t * t) - (upper + v * (lower - upper));
}

INLINE VF outside_at(const Frame *f, VF t, int size, const Cells *k) {
  return outside(f->w0 + t * f->w1, f->s0 + t * f->s1, f->t0 + t * f->t1, size, k);
}

// Keep the part of [in, out] where g0 + g1 t >= 0.
INLINE void clip(VF g0, VF g1, VF *in, VF *out) {
  VF t = -g0 / SEL(g1, (VF)(1e-20f), g1 == 0.0f);
  VI up = g1 > 0.0f, down = g1 < 0.0f;
  *in = SEL(*in, VMAX(*in, t), up);
  *out = SEL(*out, VMIN(*out, t), down);
  *out = SEL(*out, (VF)(-INFINITY), (g1 == 0.0f) & (g0 < 0.0f));
}

// The side of a cell at node `line` (0: the border) across the coordinate s, `border` where it lies in the outer half
// texel of the other coordinate t, on its side `end` (-1, 1); `toward` 1 keeps larger s.
INLINE void clip_side(VF line, VF border, VF end, float toward, float s0, float s1, float t0, float t1, float w0,
                      float w1, int size, VF *in, VF *out) {
  const float h = 1.0f / size, inner = 1.0f - h, fan = 0.5f * h / (1.0f - 0.5f * h);
  VF one = 1.0f, zero = 0.0f, a = (2.0f * line - 1.0f) * h - 1.0f;
  VI face_edge = (line < 0.5f) | (line > size + 0.5f);
  a = SEL(a, SEL(one, -one, line < 0.5f), face_edge);
  VI fanned = (border > 0.5f) & NOT(face_edge);
  VF along = SEL(one, (VF)(1.0f - fan * inner * size), fanned), across = SEL(zero, end * (fan * size), fanned);
  clip((s0 - a * (along * w0 + across * t0)) * toward, (s1 - a * (along * w1 + across * t1)) * toward, in, out);
}

// The first root of each cell of VW behind `low`, INFINITY: none.
INLINE VF first_roots(const Frame *f, __global const float *block, int part, int size, float low, float far) {
  Cells k;
  VF lane_row, lane_column;
#if VW == 1
  lane_row = part >> 2; lane_column = part & 3;
#else
  lane_row = TO_VF((LANE_INDEX + part) >> 2); lane_column = TO_VF((LANE_INDEX + part) & 3);
#endif
  k.row = block[1] + lane_row; k.column = block[2] + lane_column;
  for (int c = 0; c < 4; c++)
    for (int lane = 0; lane < VW; lane++) {
      int cell = part + lane;
      ((float *)&k.corner[c])[lane] = block[4 + ((cell >> 2) + (c >> 1)) * 5 + (cell & 3) + (c & 1)];
    }
  VF none = INFINITY, in = low, out = far, zero = 0.0f, one = 1.0f;
  VI whole = (k.corner[0] >= 0.0f) & (k.corner[1] >= 0.0f) & (k.corner[2] >= 0.0f) & (k.corner[3] >= 0.0f);
  VF last = size, row_edge = SEL(zero, one, (k.row < 0.5f) | (k.row > last - 0.5f));
  VF column_edge = SEL(zero, one, (k.column < 0.5f) | (k.column > last - 0.5f));
  VF row_end = SEL(one, -one, k.row < 0.5f), column_end = SEL(one, -one, k.column < 0.5f);
  clip_side(k.column, row_edge, row_end, 1.0f, f->s0, f->s1, f->t0, f->t1, f->w0, f->w1, size, &in, &out);
  clip_side(k.column + one, row_edge, row_end, -1.0f, f->s0, f->s1, f->t0, f->t1, f->w0, f->w1, size, &in, &out);
  clip_side(k.row, column_edge, column_end, 1.0f, f->t0, f->t1, f->s0, f->s1, f->w0, f->w1, size, &in, &out);
  clip_side(k.row + one, column_edge, column_end, -1.0f, f->t0, f->t1, f->s0, f->s1, f->w0, f->w1, size, &in, &out);
  in = VMAX(in - OVERLAP, (VF)(low)); out = VMIN(out + OVERLAP, (VF)(far));
  VI met = whole & (in < out);
  if (!any_lane(met)) return none;
  VF middle = 0.5f * (in + out);
  VF f0 = outside_at(f, in, size, &k), f1 = outside_at(f, middle, size, &k), f2 = outside_at(f, out, size, &k);
  // The lowest (of points outside) or highest point of the parabola through the three.
  VF bend = f0 - 2.0f * f1 + f2, half_width = 0.5f * (out - in);
  VF vertex = middle + half_width * (0.5f * (f0 - f2)) / SEL(bend, (VF)(1e-20f), bend == 0.0f);
  VI within = (vertex > in) & (vertex < out);
  vertex = SEL(middle, vertex, within);
  VF fv = outside_at(f, vertex, size, &k);
  // The first of [in, a], [a, b], [b, out] that has a change of sign, a and b being middle and vertex in order.
  VI swap = vertex < middle;
  VF a = SEL(middle, vertex, swap), fa = SEL(f1, fv, swap), b = SEL(vertex, middle, swap), fb = SEL(fv, f1, swap);
  VI out0 = f0 > 0.0f, out_a = fa > 0.0f, out_b = fb > 0.0f, out2 = f2 > 0.0f;
#define DIFFER(x, y) (((x) & NOT(y)) | (NOT(x) & (y)))
  VI one_ = DIFFER(out0, out_a), two = DIFFER(out_a, out_b), three = DIFFER(out_b, out2);
  met = met & (one_ | two | three);
  if (!any_lane(met)) return none;
  VF l = SEL(SEL(b, a, two), in, one_), fl = SEL(SEL(fb, fa, two), f0, one_);
  VF r = SEL(SEL(out, b, two), a, one_), fr = SEL(SEL(f2, fb, two), fa, one_);
  VF t = l, settled = l;
  VI open = met;
  for (int i = 0; i < STEPS && any_lane(open); i++) {  // false position that halves what stays (Illinois)
    VF apart = fr - fl;
    t = l - fl * (r - l) / SEL(apart, (VF)(1e-20f), apart == 0.0f);
    VF ft = outside_at(f, t, size, &k);
    VI left = NOT(DIFFER(ft > 0.0f, fl > 0.0f));
    fr = SEL(SEL(fr, 0.5f * fr, left), ft, NOT(left));
    fl = SEL(SEL(fl, 0.5f * fl, NOT(left)), ft, left);
    l = SEL(l, t, left); r = SEL(t, r, left);
    settled = SEL(settled, t, open);
    open = open & ((ft > CLOSE) | (ft < -CLOSE));
  }
  return SEL(none, settled, met & (settled > low) & (settled <= far));
}

INLINE void leaf_hit(const Ray *r, const Goal *goal, Model model, int bottom, Found *found) {
  float enters[WIDE] __attribute__((aligned(64)));
  float far = found->key < r->far ? found->key : r->far;
  uint bits = children_along(r, model.boxes + (size_t)(model.first_bottom + bottom) * BOX_FLOATS, goal->low, far, enters);
  for (; bits; bits &= bits - 1u) {
    int slot = FIRST_BIT(bits);
    if (enters[slot] > found->key) continue;
    __global const float *block = model.blocks + (size_t)(bottom * WIDE + slot) * BLOCK_FLOATS;
    Frame f = frame_of(r, (int)block[0]);
    for (int part = 0; part < CELLS; part += VW) {
      VF t = first_roots(&f, block, part, model.size, goal->low, far);
      float least = lane_min(t);
      if (least == INFINITY) continue;
      int at = (bottom * WIDE + slot) * CELLS + part + FIRST_BIT(bits_of(t == least));
      if (least < found->key || (least == found->key && at < found->slot)) { found->key = least; found->slot = at; }
    }
  }
}

#if VW == 16
#include "trace/ray_batch.clh"
#else
#include "trace/ray_one.clh"
#endif

INLINE Goal goal_of(__global const float *ray, __global const float *out) {
  Goal g;
  g.low = ray[3];
#if MODE == NEXT
  float behind = as_int(out[HIT_STATE]) < 0 ? g.low : out[HIT_LOW] + OVERLAP;
  g.low = behind > g.low ? behind : g.low;
#endif
  return g;
}

INLINE Found nothing_found(const Ray *r) {
  Found f;
  f.key = r->far; f.slot = -1;
  return f;
}

INLINE void store(__global float *out, const Ray *r, Found found, Model model) {
  out[HIT_T] = found.slot < 0 ? INFINITY : found.key;
  out[HIT_LOW] = found.key;
  out[HIT_STATE] = as_float(found.slot);
  out[HIT_PRIMITIVE] = as_float(-1);
  if (found.slot < 0) return;
  __global const float *block = model.blocks + (size_t)(found.slot / CELLS) * BLOCK_FLOATS;
  int cell = found.slot % CELLS, size = model.size, face = (int)block[0];
  int row = (int)block[1] + (cell >> 2), column = (int)block[2] + (cell & 3);
  Cells k;
  k.row = row; k.column = column;
  for (int c = 0; c < 4; c++) k.corner[c] = block[4 + ((cell >> 2) + (c >> 1)) * 5 + (cell & 3) + (c & 1)];
  float x = r->ox + found.key * r->dx, y = r->oy + found.key * r->dy, z = r->oz + found.key * r->dz, n[3];
  for (int axis = 0; axis < 3; axis++) {
    float d = 0.05f / size, value[2];
    for (int i = 0; i < 2; i++) {
      float step = i ? d : -d, w, s, t;
      face_frame(face, x + (axis == 0 ? step : 0), y + (axis == 1 ? step : 0), z + (axis == 2 ? step : 0), &w, &s, &t);
      VF all = outside((VF)(w), (VF)(s), (VF)(t), size, &k);
      value[i] = LANE_OF(all, 0);
    }
    n[axis] = value[1] - value[0];
  }
  float side = n[0] * r->dx + n[1] * r->dy + n[2] * r->dz > 0.0f ? -1.0f : 1.0f;
  for (int axis = 0; axis < 3; axis++) out[HIT_NORMAL + axis] = side * n[axis];
  out[HIT_SIDE] = side;
  row = row > 0 ? row - 1 : 0; column = column > 0 ? column - 1 : 0;
  out[HIT_PRIMITIVE] = as_float((((int)block[3] * 6 + face) * size + row) * size + column);
}

__kernel void ray_scale_map(int count, int batch /* with 16 lanes at most BATCH */, int size, int roots, int first_bottom,
                            __global const float *boxes, __global const float *blocks, __global const float *rays,
                            __global float *hits) {
  int begin = get_global_id(0) * batch, end = begin + batch < count ? begin + batch : count;
  if (begin >= count) return;
  rays += (size_t)begin * RAY_FLOATS;
  hits += (size_t)begin * HIT_FLOATS;
  Model model = {boxes, blocks, first_bottom, size};
#if VW == 16
  Walks w;
  uchar todo[BATCH], active[BATCH];
  int left = 0;
  for (int q = 0; q < end - begin; q++) {
    if (MODE == NEXT && hits[q * HIT_FLOATS + HIT_T] == INFINITY) continue;
    w.ray[q] = load_ray(rays + q * RAY_FLOATS);
    w.goal[q] = goal_of(rays + q * RAY_FLOATS, hits + q * HIT_FLOATS);
    w.found[q] = nothing_found(&w.ray[q]);
    active[left] = q;
    todo[left++] = q;
  }
  walk_batch(&w, active, left, roots, first_bottom, boxes, model);
  for (int a = 0; a < left; a++) {
    int q = todo[a];
    store(hits + q * HIT_FLOATS, &w.ray[q], w.found[q], model);
  }
#else
  for (int q = 0; q < end - begin; q++) {
    __global float *out = hits + q * HIT_FLOATS;
    if (MODE == NEXT && out[HIT_T] == INFINITY) continue;
    Ray r = load_ray(rays + q * RAY_FLOATS);
    Goal goal = goal_of(rays + q * RAY_FLOATS, out);
    Found found = nothing_found(&r);
    walk_one(&r, &goal, model, roots, first_bottom, boxes, &found);
    store(out, &r, found, model);
  }
#endif
}
