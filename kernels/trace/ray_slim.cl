// Single rays against a SLIM surface, by the rules of the tile renderer (common/visibility.clh). One work-item traces
// `batch` rays: with 16 lanes in turns (slim_pairs.clh), otherwise one after the other (slim_one.clh). Twin:
// tests/reference/trace_rays.py, ray_slim.
//
// The boxes of a bottom node are those of its surfels' pieces. It also has a list of the bottom nodes whose balls reach
// into its pieces: groups near_first[bottom] to near_first[bottom + 1] - 1, each 16 boxes of balls as a node has them,
// and the 16 bottom nodes (clsurf/trace/ray_slim.py).
#include "trace/slim_surfels.clh"

#define BALL_FLOATS 64  // of a bottom node: 4 vectors of 16, centre and radius of its balls

typedef struct { float low, low_front, low_back; } Goal;  // hits of either side are looked for behind these
typedef struct { float key, t, side; int slot; } Found;
typedef struct {
  __global const float *boxes, *records, *balls;
  __global const int *near_first;
  __global const float *near_boxes;
  __global const int *near_nodes;
  int first_bottom;
} Model;

INLINE Found nothing_found() {
  Found f;
  f.key = INFINITY; f.t = INFINITY; f.side = 0.0f; f.slot = -1;
  return f;
}

typedef struct { float weight, step, x, y, z, last; } Sum;

INLINE Sum no_sum() {
  Sum sum;
  sum.weight = sum.step = sum.x = sum.y = sum.z = sum.last = 0.0f;
  return sum;
}

INLINE void add_share(Sum *sum, const Shares *s, int lane) {
  sum->weight += LANE_OF(s->weight, lane);
  sum->step += LANE_OF(s->step, lane);
  sum->x += LANE_OF(s->x, lane);
  sum->y += LANE_OF(s->y, lane);
  sum->z += LANE_OF(s->z, lane);
#if MODE == NEXT
  float reach = LANE_OF(s->reach, lane);
  sum->last = reach > sum->last ? reach : sum->last;
#endif
}

// The slots (bits) of a bottom node whose ball holds the point q.
INLINE uint balls_around(Model m, int bottom, const float *q) {
  uint bits = 0;
  for (int part = 0; part < WIDE; part += VW) {
    __global const float *k = m.balls + (size_t)bottom * BALL_FLOATS + part;
    VF x = q[0] - PART(k, 0), y = q[1] - PART(k, WIDE), z = q[2] - PART(k, 2 * WIDE), r = PART(k, 3 * WIDE);
    bits |= bits_of(x * x + y * y + z * z < r * r) << part;
  }
  return bits;
}

INLINE Goal goal_of(__global const float *ray, __global const float *out) {
  Goal g;
  g.low = g.low_front = g.low_back = ray[3];
#if MODE == NEXT
  // A hit from the same side less than a radius behind the last one is of the same sheet.
  float low = out[HIT_LOW] > g.low ? out[HIT_LOW] : g.low, sheet = out[HIT_STATE] > low ? out[HIT_STATE] : low;
  g.low = low;
  g.low_front = out[HIT_SIDE] > 0.0f ? sheet : low;
  g.low_back = out[HIT_SIDE] < 0.0f ? sheet : low;
#endif
  return g;
}

INLINE void look_behind(Goal *g, float t) {
  g->low = t;
  g->low_front = g->low_front > t ? g->low_front : t;
  g->low_back = g->low_back > t ? g->low_back : t;
}

INLINE void store_miss(__global float *out) {
  for (int i = 0; i < HIT_FLOATS; i++) out[i] = 0.0f;
  out[HIT_T] = INFINITY;
  out[HIT_PRIMITIVE] = as_float(-1);
}

// What a hit is without blending.
INLINE void store_any(__global float *out, Found hit, __global const float *records, __global const int *order) {
  if (hit.slot < 0) return;
  __global const float *k = records + (size_t)hit.slot * SURFEL_FLOATS;
  out[HIT_T] = hit.t; out[HIT_SIDE] = hit.side; out[HIT_PRIMITIVE] = as_float(order[hit.slot]);
  for (int i = 0; i < 3; i++) out[HIT_NORMAL + i] = hit.side * k[OF_NORMAL + i];
}

// Returns the weight that the hit is supported by.
INLINE float store_blend(__global float *out, Found hit, const Sum *sum, __global const float *records,
                         __global const int *order) {
  if (!(sum->weight > 0.0f)) return SUPPORT;
  out[HIT_T] = hit.t + sum->step / sum->weight;
  out[HIT_NORMAL] = sum->x; out[HIT_NORMAL + 1] = sum->y; out[HIT_NORMAL + 2] = sum->z;
  out[HIT_PRIMITIVE] = as_float(order[hit.slot]);
  out[HIT_SIDE] = sum->weight < SUPPORT ? WEAK * hit.side : hit.side;
#if MODE == NEXT
  out[HIT_LOW] = hit.t + sum->last;
  out[HIT_STATE] = hit.t + records[(size_t)hit.slot * SURFEL_FLOATS + OF_SIZE];
#endif
  return sum->weight;
}

INLINE void hit_point(__global const float *ray, float t, float *q) {
  for (int i = 0; i < 3; i++) q[i] = ray[i] + t * ray[4 + i];
}

#if VW == 16
#define LEAF_HITS leaf_hits
#include "trace/slim_pairs.clh"
#else
#include "trace/slim_one.clh"
#include "trace/ray_one.clh"
#endif

__kernel void ray_slim(int count, int batch /* with 16 lanes at most BATCH */, int roots, int first_bottom,
                       __global const float *boxes, __global const float *records, __global const float *balls,
                       __global const int *order, __global const int *near_first, __global const float *near_boxes,
                       __global const int *near_nodes, __global const float *rays, __global float *hits) {
  int begin = get_global_id(0) * batch, end = begin + batch < count ? begin + batch : count;
  if (begin >= count) return;
  Model model = {boxes, records, balls, near_first, near_boxes, near_nodes, first_bottom};
  rays += (size_t)begin * RAY_FLOATS;
  hits += (size_t)begin * HIT_FLOATS;
#if VW == 16
  Walks w;
  uchar todo[BATCH], active[BATCH];
  int left = 0;
  for (int q = 0; q < end - begin; q++) {
    __global float *out = hits + q * HIT_FLOATS;
    w.goal[q] = goal_of(rays + q * RAY_FLOATS, out);
    todo[left] = q; left += !(MODE == NEXT && out[HIT_T] == INFINITY);
    store_miss(out);
  }
  for (int attempt = 0; attempt < TRIES && left; attempt++) {
    for (int a = 0; a < left; a++) {
      int q = todo[a];
      active[a] = q;
      w.ray[q] = load_ray(rays + q * RAY_FLOATS);
      w.found[q] = nothing_found();
    }
    walk_batch(&w, active, left, roots, first_bottom, boxes, model);
#if MODE == ANY
    for (int a = 0; a < left; a++) store_any(hits + todo[a] * HIT_FLOATS, w.found[todo[a]], records, order);
    left = 0;
#else
    left = blend_batch(&w, todo, left, model, order, rays, hits);
#endif
  }
#else
  for (int q = 0; q < end - begin; q++) {
    __global const float *ray = rays + q * RAY_FLOATS;
    __global float *out = hits + q * HIT_FLOATS;
    Goal goal = goal_of(ray, out);
    int gone = MODE == NEXT && out[HIT_T] == INFINITY;
    store_miss(out);
    if (gone) continue;
    Ray r = load_ray(ray);
    float weight = 0.0f;
    for (int attempt = 0; attempt < TRIES && weight < SUPPORT; attempt++) {
      Found hit = nothing_found();
      walk_one(&r, &goal, model, roots, first_bottom, boxes, &hit);
      weight = SUPPORT;
      if (hit.slot < 0) continue;
#if MODE == ANY
      store_any(out, hit, records, order);
#else
      Sum sum = blended(ray, hit, model);
      weight = store_blend(out, hit, &sum, records, order);
      look_behind(&goal, hit.t);
#endif
    }
  }
#endif
}
