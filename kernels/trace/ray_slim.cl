// Single rays against a SLIM surface, by the rules of the tile renderer (kernels/render/tile_slim.cl): the frontmost
// hit of the balls shrunk by ALPHA, then the blend of all surfels whose ball holds that point; where its weights add up
// to less than SUPPORT, the ray looks behind it, up to TRIES times, and keeps the last hit. One work-item traces
// `batch` rays: with 16 lanes in turns (ray_batch.clh), otherwise one after the other. Twin:
// tests/reference/trace_rays.py, ray_slim.
//
// A bottom node has a block of FIELDS vectors of 16 floats, one lane for each slot, and a list of the bottom nodes
// whose balls reach into its piece of surface: groups near_first[bottom] to near_first[bottom + 1] - 1, each 16 boxes
// of balls as a node has them, and the 16 bottom nodes (clsurf/trace/ray_slim.py).
#include "common/visibility.clh"
#include "trace/ray_walk.clh"

enum { AT_X, AT_Y, AT_Z, N_X, N_Y, N_Z,
       TURN,    // -1 / (sign of n_z + n_z), of the frame of the normal (common/frame.clh)
       SHRINK,  // 1 / radius
       SIZE,    // radius
       C0, C1, C2, C3, C4, C5, C6, C7, C8, C9 };  // C4 is half the coefficient of u v
#define FIELDS (9 + COEFFICIENT_COUNT)

#define FIELD(name) PART(k, (name) * WIDE)

typedef struct { VF u, v, w; } Spot;

INLINE VF signed_by(VF x, VI sign) { return AS_VF(AS_VI(x) ^ sign); }

// A vector in the frames of the surfels, by the algebra of common/frame.clh: u = (1 + s x^2 a, s x y a, -s x) and so
// on.
INLINE Spot turned(__global const float *k, VF x, VF y, VF z) {
  VI sign = AS_VI(FIELD(N_Z)) & (VI)0x80000000;
  VF m = FIELD(N_X) * x + FIELD(N_Y) * y, h = FIELD(TURN) * m - z;
  Spot s;
  s.u = x + signed_by(FIELD(N_X), sign) * h;
  s.v = signed_by(y, sign) + FIELD(N_Y) * h;
  s.w = m + FIELD(N_Z) * z;
  return s;
}
INLINE Spot moved(Spot p, VF s, Spot d) { p.u += s * d.u; p.v += s * d.v; p.w += s * d.w; return p; }
INLINE VF length2(Spot p) { return p.u * p.u + p.v * p.v + p.w * p.w; }

// Gradient of the height polynomial at (u, v).
INLINE void slope_at(__global const float *k, Spot p, VF *gu, VF *gv) {
#if DEGREE == 1
  *gu = 0.0f; *gv = 0.0f;
#elif DEGREE == 2
  *gu = FIELD(C1) + 2.0f * (FIELD(C3) * p.u + FIELD(C4) * p.v);
  *gv = FIELD(C2) + 2.0f * (FIELD(C4) * p.u + FIELD(C5) * p.v);
#else
  *gu = FIELD(C1) + p.u * (2.0f * FIELD(C3) + 3.0f * FIELD(C6) * p.u + 2.0f * FIELD(C7) * p.v)
        + p.v * (2.0f * FIELD(C4) + FIELD(C8) * p.v);
  *gv = FIELD(C2) + p.v * (2.0f * FIELD(C5) + 3.0f * FIELD(C9) * p.v + 2.0f * FIELD(C8) * p.u)
        + p.u * (2.0f * FIELD(C4) + FIELD(C7) * p.u);
#endif
}

// f along the ray from p in direction d.
INLINE RayPoly poly_at(__global const float *k, Spot p, Spot d) {
  RayPoly f;
#if DEGREE == 1
  f.c = p.w - FIELD(C0); f.b = d.w; f.a = 0.0f; f.d = 0.0f;
#elif DEGREE == 2
  VF hu = FIELD(C3) * p.u + FIELD(C4) * p.v, hv = FIELD(C4) * p.u + FIELD(C5) * p.v;
  VF lu = FIELD(C1) + hu, lv = FIELD(C2) + hv;
  f.c = (p.w - FIELD(C0)) - p.u * lu - p.v * lv;
  f.b = d.w - d.u * (lu + hu) - d.v * (lv + hv);
  f.a = -d.u * (FIELD(C3) * d.u + FIELD(C4) * d.v) - d.v * (FIELD(C4) * d.u + FIELD(C5) * d.v);
  f.d = 0.0f;
#else
  VF gu, gv;
  slope_at(k, p, &gu, &gv);
  VF h = FIELD(C0) + p.u * (FIELD(C1) + p.u * (FIELD(C3) + FIELD(C6) * p.u + FIELD(C7) * p.v)
                            + p.v * (2.0f * FIELD(C4) + FIELD(C8) * p.v))
         + p.v * (FIELD(C2) + p.v * (FIELD(C5) + FIELD(C9) * p.v));
  VF huu = FIELD(C3) + 3.0f * FIELD(C6) * p.u + FIELD(C7) * p.v;
  VF huv = FIELD(C4) + FIELD(C7) * p.u + FIELD(C8) * p.v;
  VF hvv = FIELD(C5) + FIELD(C8) * p.u + 3.0f * FIELD(C9) * p.v;
  f.c = p.w - h;
  f.b = d.w - d.u * gu - d.v * gv;
  f.a = -d.u * (huu * d.u + 2.0f * huv * d.v) - d.v * d.v * hvv;
  f.d = -d.u * d.u * (FIELD(C6) * d.u + FIELD(C7) * d.v) - d.v * d.v * (FIELD(C8) * d.u + FIELD(C9) * d.v);
#endif
  return f;
}

INLINE VI inside_footprints(VU lo, VU hi, VF u, VF v) {
  const float unit = 1.0f / 255.0f, half_root = 0.70710678f;
  VF a = (u + v) * half_root, b = (v - u) * half_root;
#define SIDE_OF(word, shift) (TO_VF(AS_VI((word) >> (shift) & 255u)) * unit)
  return (u <= SIDE_OF(lo, 0)) & (a <= SIDE_OF(lo, 8)) & (v <= SIDE_OF(lo, 16)) & (b <= SIDE_OF(lo, 24))
       & (-u <= SIDE_OF(hi, 0)) & (-a <= SIDE_OF(hi, 8)) & (-v <= SIDE_OF(hi, 16)) & (-b <= SIDE_OF(hi, 24));
}

typedef struct { float low, low_front, low_back; } Goal;  // hits of either side are looked for behind these
typedef struct { float key, t, side; int slot; } Found;
typedef struct {
  __global const float *blocks;
  __global const uint *feet;     // footprints: 2 words a slot, as 2 vectors of 16
  __global const uchar *limited; // whether any slot of a bottom node has one
} Model;

INLINE __global const float *block_of(__global const float *blocks, int bottom) {
  return blocks + (size_t)bottom * (FIELDS * WIDE);
}

// Take the frontmost hit of the surfels of a bottom node where it is nearer than found->key.
INLINE void leaf_hit(const Ray *r, const Goal *goal, Model m, int bottom, Found *found) {
  for (int part = 0; part < WIDE; part += VW) {
    __global const float *k = block_of(m.blocks, bottom) + part;
    VF x = r->ox - FIELD(AT_X), y = r->oy - FIELD(AT_Y), z = r->oz - FIELD(AT_Z);
    // From the point next to the centre, where nothing cancels.
    VF t = -(x * r->dx + y * r->dy + z * r->dz), shrink = FIELD(SHRINK);
    x += t * r->dx; y += t * r->dy; z += t * r->dz;
    Spot p = turned(k, x * shrink, y * shrink, z * shrink), d = turned(k, r->dx, r->dy, r->dz);
    RayPoly f = poly_at(k, p, d);
    VF s1, s2, slope;
    VI front = ray_root(f, (VF)(1.0f), &s1, &slope);
    VI back = ray_root(f, (VF)(-1.0f), &s2, &slope);
    Spot p1 = moved(p, s1, d), p2 = moved(p, s2, d);
    s1 = t + s1 * FIELD(SIZE); s2 = t + s2 * FIELD(SIZE);
    VF k1 = s1, k2 = ORIENTED ? s2 + BACK_BIAS * FIELD(SIZE) : s2;
    front = front & (length2(p1) < ALPHA * ALPHA) & (s1 > goal->low_front) & (s1 < r->far) & (k1 < found->key);
    back = back & (length2(p2) < ALPHA * ALPHA) & (s2 > goal->low_back) & (s2 < r->far) & (k2 < found->key);
    if (!any_lane(front | back)) continue;
    if (m.limited[bottom]) {
      __global const uint *feet = m.feet + (size_t)bottom * (2 * WIDE) + part;
      VU lo = *(__global const VU *)feet, hi = *(__global const VU *)(feet + WIDE);
      VI free = (lo & hi) == 0xffffffffu;
      front = front & (free | inside_footprints(lo, hi, p1.u, p1.v));
      back = back & (free | inside_footprints(lo, hi, p2.u, p2.v));
    }
    k1 = SEL((VF)(INFINITY), k1, front); k2 = SEL((VF)(INFINITY), k2, back);
    VI behind = k2 < k1;
    VF key = SEL(k1, k2, behind), at = SEL(s1, s2, behind), side = SEL((VF)(1.0f), (VF)(-1.0f), behind);
    float least = lane_min(key);
    if (least < found->key) {
      int lane = FIRST_BIT(bits_of(key == least));
      found->key = least; found->t = LANE_OF(at, lane); found->side = LANE_OF(side, lane);
      found->slot = bottom * WIDE + part + lane;
    }
  }
}

INLINE Found nothing_found() {
  Found f;
  f.key = INFINITY; f.t = INFINITY; f.side = 0.0f; f.slot = -1;
  return f;
}

typedef struct { VF weight, step, x, y, z, last; } Blend;

INLINE Blend no_blend() {
  Blend sum;
  sum.weight = sum.step = sum.x = sum.y = sum.z = sum.last = 0.0f;
  return sum;
}

// Whether the ball of any surfel of a bottom node holds the point q.
INLINE int holds(__global const float *block, const float *q) {
  int any = 0;
  for (int part = 0; part < WIDE; part += VW) {
    __global const float *k = block + part;
    VF x = q[0] - FIELD(AT_X), y = q[1] - FIELD(AT_Y), z = q[2] - FIELD(AT_Z), r = FIELD(SIZE);
    any |= any_lane(x * x + y * y + z * z < r * r) ? 1 : 0;
  }
  return any;
}

// Add the surfels of a bottom node whose ball holds the point q, which a ray along (dx, dy, dz) hit from `facing`.
INLINE void block_blend(__global const float *block, const float *q, float dx, float dy, float dz, float facing,
                        Blend *sum) {
  for (int part = 0; part < WIDE; part += VW) {
    __global const float *k = block + part;
    VF shrink = FIELD(SHRINK);
    Spot p = turned(k, (q[0] - FIELD(AT_X)) * shrink, (q[1] - FIELD(AT_Y)) * shrink, (q[2] - FIELD(AT_Z)) * shrink);
    Spot d = turned(k, dx, dy, dz);
    VI inside = length2(p) < 1.0f;
    RayPoly f = poly_at(k, p, d);
    VF step, slope, gu, gv;
#if ORIENTED
    VF side = facing;
#else
    VF side = SEL((VF)(-1.0f), (VF)(1.0f), f.b < 0.0f);  // the root nearer to the point
#endif
    inside = inside & ray_root(f, side, &step, &slope);
    step = SEL((VF)(0.0f), step, inside);  // no NaN may reach the sums
    p = moved(p, step, d);
    VF g = 1.0f - length2(p);
    inside = inside & (g > 0.0f);
    VF weight = SEL((VF)(0.0f), g * g * g, inside);
    slope_at(k, p, &gu, &gv);
    step *= FIELD(SIZE);
    VF tilt = weight * side;
    VI sign = AS_VI(FIELD(N_Z)) & (VI)0x80000000;
    VF lift = gu * signed_by(FIELD(N_X), sign) + gv * FIELD(N_Y), turn = lift * FIELD(TURN);
    sum->weight += weight;
    sum->step += weight * step;
    sum->x += tilt * (FIELD(N_X) - gu - turn * FIELD(N_X));
    sum->y += tilt * (FIELD(N_Y) - signed_by(gv, sign) - turn * FIELD(N_Y));
    sum->z += tilt * (FIELD(N_Z) + lift);
#if MODE == NEXT
    VF reach = SEL((VF)(0.0f), step, inside);
    sum->last = VMAX(sum->last, reach);
#endif
  }
}

INLINE float of_slot(__global const float *blocks, int slot, int field) {
  return block_of(blocks, slot / WIDE)[field * WIDE + slot % WIDE];
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
INLINE void store_any(__global float *out, Found hit, __global const float *blocks, __global const int *order) {
  if (hit.slot < 0) return;
  out[HIT_T] = hit.t; out[HIT_SIDE] = hit.side; out[HIT_PRIMITIVE] = as_float(order[hit.slot]);
  for (int i = 0; i < 3; i++) out[HIT_NORMAL + i] = hit.side * of_slot(blocks, hit.slot, N_X + i);
}

// Returns the weight that the hit is supported by.
INLINE float store_blend(__global float *out, Found hit, const Blend *sum, __global const float *blocks,
                         __global const int *order) {
  float weight = lane_sum(sum->weight);
  if (!(weight > 0.0f)) return SUPPORT;
  out[HIT_T] = hit.t + lane_sum(sum->step) / weight;
  out[HIT_NORMAL] = lane_sum(sum->x); out[HIT_NORMAL + 1] = lane_sum(sum->y); out[HIT_NORMAL + 2] = lane_sum(sum->z);
  out[HIT_PRIMITIVE] = as_float(order[hit.slot]);
  out[HIT_SIDE] = hit.side;
#if MODE == NEXT
  out[HIT_LOW] = hit.t - lane_min(-sum->last);
  out[HIT_STATE] = hit.t + of_slot(blocks, hit.slot, SIZE);
#endif
  return weight;
}

INLINE void hit_point(__global const float *ray, float t, float *q) {
  for (int i = 0; i < 3; i++) q[i] = ray[i] + t * ray[4 + i];
}

INLINE Blend blended(__global const float *ray, Found hit, __global const float *blocks,
                     __global const int *near_first, __global const float *near_boxes, __global const int *near_nodes) {
  Blend sum = no_blend();
  int bottom = hit.slot / WIDE;
  float q[3];
  hit_point(ray, hit.t, q);
  for (int g = near_first[bottom]; g < near_first[bottom + 1]; g++) {
    uint bits = children_around(near_boxes + (size_t)g * BOX_FLOATS, q[0], q[1], q[2]);
    while (bits) {
      __global const float *block = block_of(blocks, near_nodes[g * WIDE + FIRST_BIT(bits)]);
      bits &= bits - 1u;
      if (holds(block, q)) block_blend(block, q, ray[4], ray[5], ray[6], hit.side, &sum);
    }
  }
  return sum;
}

#if VW != 16
#include "trace/ray_one.clh"
#else
#include "trace/ray_batch.clh"
#define PAIRS 1024

// Blend the hits of `todo` rays; those with too little support stay in it. Returns how many.
INLINE int blend_batch(Walks *w, uchar *todo, int left, __global const float *blocks, __global const int *near_first,
                       __global const float *near_boxes, __global const int *near_nodes, __global const int *order,
                       __global const float *rays, __global float *hits) {
  int pairs[PAIRS], first_pair[BATCH + 1], again = 0;
  float points[BATCH][3];
  uchar at[BATCH];
  for (int start = 0; start < left;) {
    // Ask first which bottom nodes matter to which hit, so that the blending itself runs without branches.
    int pair_count = 0, count = 0;
    for (; start < left; start++) {
      int q = todo[start];
      Found hit = w->found[q];
      if (hit.slot < 0) continue;
      int bottom = hit.slot / WIDE, first = near_first[bottom], end = near_first[bottom + 1];
      if (pair_count + (end - first) * WIDE > PAIRS) {
        if (pair_count) break;
        Blend sum = blended(rays + q * RAY_FLOATS, hit, blocks, near_first, near_boxes, near_nodes);
        float weight = store_blend(hits + q * HIT_FLOATS, hit, &sum, blocks, order);
        look_behind(&w->goal[q], hit.t);
        todo[again] = q; again += weight < SUPPORT;
        continue;
      }
      float *point = points[count];
      hit_point(rays + q * RAY_FLOATS, hit.t, point);
      first_pair[count] = pair_count;
      for (int g = first; g < end; g++) {
        uint bits = children_around(near_boxes + (size_t)g * BOX_FLOATS, point[0], point[1], point[2]);
        while (bits) {
          pairs[pair_count++] = near_nodes[g * WIDE + FIRST_BIT(bits)];
          bits &= bits - 1u;
        }
      }
      at[count++] = q;
    }
    first_pair[count] = pair_count;
    int kept = 0;
    for (int h = 0, e = 0; h < count; h++) {
      first_pair[h] = kept;
      for (; e < first_pair[h + 1]; e++) {
        pairs[kept] = pairs[e];
        kept += holds(block_of(blocks, pairs[e]), points[h]);
      }
    }
    first_pair[count] = kept;
    for (int h = 0; h < count; h++) {
      int q = at[h];
      Found hit = w->found[q];
      __global const float *ray = rays + q * RAY_FLOATS;
      Blend sum = no_blend();
      for (int e = first_pair[h]; e < first_pair[h + 1]; e++)
        block_blend(block_of(blocks, pairs[e]), points[h], ray[4], ray[5], ray[6], hit.side, &sum);
      float weight = store_blend(hits + q * HIT_FLOATS, hit, &sum, blocks, order);
      look_behind(&w->goal[q], hit.t);
      todo[again] = q; again += weight < SUPPORT;
    }
  }
  return again;
}
#endif

__kernel void ray_slim(int count, int batch /* with 16 lanes at most BATCH */, int roots, int first_bottom,
                       __global const float *boxes, __global const float *blocks, __global const uint *feet,
                       __global const uchar *limited, __global const int *order, __global const int *near_first,
                       __global const float *near_boxes, __global const int *near_nodes, __global const float *rays,
                       __global float *hits) {
  int begin = get_global_id(0) * batch, end = begin + batch < count ? begin + batch : count;
  if (begin >= count) return;
  Model model = {blocks, feet, limited};
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
    for (int a = 0; a < left; a++) store_any(hits + todo[a] * HIT_FLOATS, w.found[todo[a]], blocks, order);
    left = 0;
#else
    left = blend_batch(&w, todo, left, blocks, near_first, near_boxes, near_nodes, order, rays, hits);
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
      store_any(out, hit, blocks, order);
#else
      Blend sum = blended(ray, hit, blocks, near_first, near_boxes, near_nodes);
      weight = store_blend(out, hit, &sum, blocks, order);
      look_behind(&goal, hit.t);
#endif
    }
  }
#endif
}
