// Single rays against the base surfels of a hierarchy: what the tile renderer sees of the finest level. First the
// frontmost inner disc (where that is seen from behind, the rest of a disc before it that is seen from its front), then
// a blend of the discs about as deep that are seen from the same side, in depth and normal.
// One work-item traces `batch` rays one after the other. Twin: tests/reference/surfels.py, ray_surfels.
//
// A bottom node has a block of 7 vectors of 16 floats: position, normal and radius of the surfel in each slot.
#include "trace/ray_walk.clh"

enum { D_X, D_Y, D_Z, D_NX, D_NY, D_NZ, D_RADIUS, FIELDS };
#define FIELD(plane) PART(k, (plane) * WIDE)
// kernels/common/surfel.clh, kernels/render/project_surfels.cl, clsurf/render/surfels.py
#define CORE 0.85f
#define BACK 0.25f
#define SLAB 0.3f
#define LEAN 0.25f

#ifndef PIECES
#define PIECES 0  // 1: the discs are some of a surface's; hits that count only before a disc seen from behind say so
#endif

// What a walk looks for: the frontmost disc, only its side where that lies past the ray's end, or the blend.
enum { FRONTMOST, PAST_END, BLENDED };
typedef struct { float low, hit, face; int aim; } Goal;
// `key` orders the hits: those from behind are set back. `whole` is the frontmost disc seen from its front, rest and all.
// The sums are of the blend, `last` its deepest disc.
typedef struct { float key; int slot; float t, face, whole; int whole_slot; float weight, depth, x, y, z, last; } Found;
typedef __global const float *Model;

INLINE VF magnitude(VF x) { return VMAX(x, -x); }

INLINE void leaf_hit(const Ray *r, const Goal *goal, Model blocks, int bottom, Found *found) {
  for (int part = 0; part < WIDE; part += VW) {
    __global const float *k = blocks + (size_t)bottom * (FIELDS * WIDE) + part;
    VF x = FIELD(D_X) - r->ox, y = FIELD(D_Y) - r->oy, z = FIELD(D_Z) - r->oz;
    VF nx = FIELD(D_NX), ny = FIELD(D_NY), nz = FIELD(D_NZ), radius = FIELD(D_RADIUS);
    VF along = nx * r->dx + ny * r->dy + nz * r->dz;
    VF t = (nx * x + ny * y + nz * z) / along;
    x -= t * r->dx; y -= t * r->dy; z -= t * r->dz;
    VF away2 = x * x + y * y + z * z;  // infinite or not a number along the plane: no hit
    VI front = along < 0.0f;
    if (goal->aim == BLENDED) {
      VF steep = magnitude(along);
      VF apart = magnitude(t - goal->hit) * VMAX(steep, (VF)(LEAN));
      VI in = (away2 < radius * radius) & (apart < SLAB * radius) & (goal->face > 0.0f ? front : NOT(front));
      if (!any_lane(in)) continue;
      VF g = 1.0f - away2 / (radius * radius);
      g = SEL((VF)(0.0f), g * g * g, in);
      VF safe = SEL((VF)(0.0f), t, in);
      found->weight += lane_sum(g); found->depth += lane_sum(g * safe);
      found->x += lane_sum(g * nx); found->y += lane_sum(g * ny); found->z += lane_sum(g * nz);
      float last = -lane_min(SEL((VF)(INFINITY), -t, in));
      found->last = last > found->last ? last : found->last;
      continue;
    }
    VI all = (away2 < radius * radius) & (t > goal->low) & (t <= r->far);
    if (!any_lane(all)) continue;
    VF before = SEL((VF)(INFINITY), t, all & front);
    float first = lane_min(before);
    if (first < found->whole) {
      found->whole = first;
      found->whole_slot = bottom * WIDE + part + FIRST_BIT(bits_of(before == first));
    }
    VI in = all & (away2 < CORE * CORE * radius * radius);
    if (!any_lane(in)) continue;
    VF key = SEL((VF)(INFINITY), SEL(t + BACK * radius, t, front), in);
    float least = lane_min(key);
    if (least >= found->key) continue;
    int lane = FIRST_BIT(bits_of(key == least));
    found->key = least;
    if (goal->aim == FRONTMOST) found->slot = bottom * WIDE + part + lane;
    found->t = LANE_OF(t, lane); found->face = LANE_OF(along, lane) < 0.0f ? 1.0f : -1.0f;
  }
}

#include "trace/ray_one.clh"

// `largest` is the radius of the largest disc.
__kernel void ray_surfels(int count, int batch, int roots, int first_bottom, float largest, __global const float *boxes,
                          __global const float *blocks, __global const int *order, __global const float *rays,
                          __global float *hits) {
  const float slack = 1.01f * SLAB / LEAN * largest;
  int begin = get_global_id(0) * batch, end = begin + batch < count ? begin + batch : count;
  for (int q = begin; q < end; q++) {
    __global float *out = hits + (size_t)q * HIT_FLOATS;
    if (MODE == NEXT && out[HIT_T] == INFINITY) continue;
    Ray r = load_ray(rays + (size_t)q * RAY_FLOATS);
    Goal goal;
    goal.low = r.low; goal.hit = goal.face = 0.0f; goal.aim = FRONTMOST;
    if (MODE == NEXT && out[HIT_LOW] > goal.low) goal.low = out[HIT_LOW];
    // The ray's end cuts hits off, not the discs that decide on them: those past it hide others that are seen from
    // behind and set back past them, and a blend may lie before its frontmost disc.
    Ray way = r;
    if (MODE != ANY && r.low <= r.far) way.far = r.far + slack + BACK * largest;
    Found found;
    found.key = MODE == ANY ? INFINITY : way.far;
    found.whole = INFINITY; found.slot = found.whole_slot = -1;
    found.t = found.face = found.weight = found.depth = found.x = found.y = found.z = 0.0f;
    walk_one(&way, &goal, blocks, roots, first_bottom, boxes, &found);
    int waits = 0;  // for what other pieces have behind
    if (PIECES && MODE != ANY) {
      waits = found.slot < 0 && found.whole < INFINITY;
      if (waits) { found.slot = found.whole_slot; found.t = found.whole; found.face = 1.0f; }
    } else if (found.slot < 0 && found.whole < INFINITY) {  // a gap if the disc past the end is seen from behind
      way.far = FARTHEST; found.key = INFINITY; goal.aim = PAST_END;
      walk_one(&way, &goal, blocks, roots, first_bottom, boxes, &found);
    }
    if (found.face < 0.0f && found.whole < found.t) {
      found.slot = found.whole_slot; found.t = found.whole; found.face = 1.0f;
    }
    if (found.slot < 0) { out[HIT_T] = INFINITY; out[HIT_PRIMITIVE] = as_float(-1); continue; }
    int slot = found.slot;
    float t = found.t;
    found.last = t;
#if MODE != ANY
    Ray near = r;
    near.far = t + slack;
    goal.low = t - slack; goal.hit = t; goal.face = found.face; goal.aim = BLENDED;
    found.key = t + slack;
    walk_one(&near, &goal, blocks, roots, first_bottom, boxes, &found);
    if (found.weight > 0.0f) t = found.depth / found.weight;
    if (t > r.far) { out[HIT_T] = INFINITY; out[HIT_PRIMITIVE] = as_float(-1); continue; }
#else
    __global const float *k = blocks + (size_t)(slot / WIDE) * (FIELDS * WIDE) + slot % WIDE;
    found.x = k[D_NX * WIDE]; found.y = k[D_NY * WIDE]; found.z = k[D_NZ * WIDE];
#endif
    out[HIT_T] = t;
    out[HIT_NORMAL] = found.face * found.x; out[HIT_NORMAL + 1] = found.face * found.y;
    out[HIT_NORMAL + 2] = found.face * found.z;
    out[HIT_PRIMITIVE] = as_float(order[slot]);
    out[HIT_SIDE] = waits ? WAITS : found.face;
    out[HIT_LOW] = found.last > t ? found.last : t; out[HIT_STATE] = 0.0f;
  }
}
