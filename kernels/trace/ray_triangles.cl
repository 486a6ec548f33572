// Single rays against triangles, without leaks: Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1),
// 2013. A ray that meets an edge or a vertex exactly is thought moved aside by (e, e^2), e -> 0, in the plane across
// it, so that it crosses exactly one of the triangles that share an edge, and closed meshes an even number of times.
// One work-item traces `batch` rays: with 16 lanes in turns (ray_batch.clh), otherwise one after the other. Twin:
// tests/reference/trace_rays.py, ray_triangles.
//
// A bottom node has a block of 9 vectors of 16 floats: the corners A, B, C of the triangle in each slot, x, y, z each.
#include "trace/ray_walk.clh"
#include "common/edge_side.clh"

enum { A_X, B_X = 3, C_X = 6 };
#define FIELDS 9
#define FIELD(plane) PART(k, (plane) * WIDE)

// The ray's frame: z along the axis where its direction is longest, x and y sheared across the ray.
typedef struct { int x, y, z; float sx, sy, sz, ox, oy, oz; } Shear;

INLINE Shear shear_of(const Ray *r) {
  float ax = r->dx < 0.0f ? -r->dx : r->dx, ay = r->dy < 0.0f ? -r->dy : r->dy, az = r->dz < 0.0f ? -r->dz : r->dz;
  Shear s;
  s.z = ax > ay ? (ax > az ? 0 : 2) : (ay > az ? 1 : 2);
  s.x = s.z == 2 ? 0 : s.z + 1;
  s.y = s.x == 2 ? 0 : s.x + 1;
  const float d[3] = {r->dx, r->dy, r->dz}, o[3] = {r->ox, r->oy, r->oz};
  s.sz = 1.0f / d[s.z]; s.sx = d[s.x] * s.sz; s.sy = d[s.y] * s.sz;
  s.ox = o[s.x]; s.oy = o[s.y]; s.oz = o[s.z];
  return s;
}

typedef struct { float low; int slot; } Goal;  // hits are looked for behind t = low; at it in slots behind `slot`
typedef struct { float key; int slot; } Found;
typedef __global const float *Model;

INLINE VF lesser(VF a, VF b) { return VMIN(a, b); }
INLINE VF greater(VF a, VF b) { return VMAX(a, b); }

// Take the triangle of a bottom node that the ray meets first, in front of found->key; of equals that in the first
// slot.
INLINE void leaf_hit(const Ray *r, const Goal *goal, Model blocks, int bottom, Found *found) {
  Shear s = shear_of(r);
  for (int part = 0; part < WIDE; part += VW) {
    __global const float *k = blocks + (size_t)bottom * (FIELDS * WIDE) + part;
    VF az = FIELD(A_X + s.z) - s.oz, bz = FIELD(B_X + s.z) - s.oz, cz = FIELD(C_X + s.z) - s.oz;
    VF ax = FIELD(A_X + s.x) - s.ox - s.sx * az, ay = FIELD(A_X + s.y) - s.oy - s.sy * az;
    VF bx = FIELD(B_X + s.x) - s.ox - s.sx * bz, by = FIELD(B_X + s.y) - s.oy - s.sy * bz;
    VF cx = FIELD(C_X + s.x) - s.ox - s.sx * cz, cy = FIELD(C_X + s.y) - s.oy - s.sy * cz;
    // Where all corners lie on one side of the ray, none of its edges need be looked at.
    VF low_x = lesser(lesser(ax, bx), cx), high_x = greater(greater(ax, bx), cx);
    VF low_y = lesser(lesser(ay, by), cy), high_y = greater(greater(ay, by), cy);
    VI near = (low_x <= 0.0f) & (high_x >= 0.0f) & (low_y <= 0.0f) & (high_y >= 0.0f);
    if (!any_lane(near)) continue;
    VF u = edge_side(bx, by, cx, cy), v = edge_side(cx, cy, ax, ay), w = edge_side(ax, ay, bx, by);
    VI in = near & (u == v) & (v == w) & (u != 0.0f);
    if (!any_lane(in)) continue;
    VF eu = cx * by - cy * bx, ev = ax * cy - ay * cx, ew = bx * ay - by * ax;
    VF z = (eu * az + ev * bz + ew * cz) / (eu + ev + ew);
    // A sliver's quotient may be anything; its hit lies between its corners.
    VF first = lesser(lesser(az, bz), cz), last = greater(greater(az, bz), cz);
    z = SEL((VF)(0.5f) * (first + last), z, z == z);
    z = lesser(greater(z, first), last);
    VF t = z * s.sz;
#if MODE == NEXT
    VI slots = LANE_INDEX + (bottom * WIDE + part);
    in = in & ((t > goal->low) | ((t == goal->low) & (slots > goal->slot))) & (t <= found->key);
#else
    in = in & (t > goal->low) & (t <= found->key);
#endif
    t = SEL((VF)(INFINITY), t, in);
    float least = lane_min(t);
    if (least == INFINITY) continue;
    int at = bottom * WIDE + part + FIRST_BIT(bits_of(t == least));
    if (least < found->key || at < found->slot) { found->key = least; found->slot = at; }  // of equals the first slot
  }
}

#if VW == 16
#include "trace/ray_batch.clh"
#else
#include "trace/ray_one.clh"
#endif

INLINE Goal goal_of(__global const float *ray, __global const float *out) {
  Goal g;
  g.low = ray[3]; g.slot = -1;
#if MODE == NEXT
  g.low = out[HIT_LOW] > g.low ? out[HIT_LOW] : g.low;
  g.slot = as_int(out[HIT_STATE]);
#endif
  return g;
}

INLINE Found nothing_found(const Ray *r) {
  Found f;
  f.key = r->far; f.slot = -1;
  return f;
}

INLINE void store(__global float *out, const Ray *r, Found found, Model blocks, __global const int *order) {
  out[HIT_T] = found.slot < 0 ? INFINITY : found.key;
  out[HIT_LOW] = found.key;
  out[HIT_STATE] = as_float(found.slot);
  out[HIT_PRIMITIVE] = as_float(found.slot < 0 ? -1 : order[found.slot]);
  if (found.slot < 0) return;
  __global const float *k = blocks + (size_t)(found.slot / WIDE) * (FIELDS * WIDE) + found.slot % WIDE;
  float a[3], e[3], f[3];
  for (int j = 0; j < 3; j++) {
    a[j] = k[j * WIDE];
    e[j] = k[(3 + j) * WIDE] - a[j];
    f[j] = k[(6 + j) * WIDE] - a[j];
  }
  float x = e[1] * f[2] - e[2] * f[1], y = e[2] * f[0] - e[0] * f[2], z = e[0] * f[1] - e[1] * f[0];
  float side = x * r->dx + y * r->dy + z * r->dz > 0.0f ? -1.0f : 1.0f;
  out[HIT_NORMAL] = side * x; out[HIT_NORMAL + 1] = side * y; out[HIT_NORMAL + 2] = side * z;
  out[HIT_SIDE] = side;
}

__kernel void ray_triangles(int count, int batch /* with 16 lanes at most BATCH */, int roots, int first_bottom,
                            __global const float *boxes, __global const float *blocks, __global const int *order,
                            __global const float *rays, __global float *hits) {
  int begin = get_global_id(0) * batch, end = begin + batch < count ? begin + batch : count;
  if (begin >= count) return;
  rays += (size_t)begin * RAY_FLOATS;
  hits += (size_t)begin * HIT_FLOATS;
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
  walk_batch(&w, active, left, roots, first_bottom, boxes, blocks);
  for (int a = 0; a < left; a++) {
    int q = todo[a];
    store(hits + q * HIT_FLOATS, &w.ray[q], w.found[q], blocks, order);
  }
#else
  for (int q = 0; q < end - begin; q++) {
    __global float *out = hits + q * HIT_FLOATS;
    if (MODE == NEXT && out[HIT_T] == INFINITY) continue;
    Ray r = load_ray(rays + q * RAY_FLOATS);
    Goal goal = goal_of(rays + q * RAY_FLOATS, out);
    Found found = nothing_found(&r);
    walk_one(&r, &goal, blocks, roots, first_bottom, boxes, &found);
    store(out, &r, found, blocks, order);
  }
#endif
}
