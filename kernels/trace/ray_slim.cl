// Single rays against a SLIM surface, by the rules of the tile renderer (kernels/render/tile_slim.cl): the frontmost hit
// of the balls shrunk by ALPHA, then the blend of all surfels whose ball holds that point; where its weights add up to
// less than SUPPORT, the ray looks behind it, up to TRIES times, and keeps the last hit. One work-item traces `batch`
// rays, one after the other. Twin: tests/reference/trace_rays.py, ray_slim.
//
// A bottom node has a block of FIELDS vectors of 16 floats, one lane for each slot (clsurf/trace/ray_slim.py).
#include "common/slim.clh"
#include "trace/ray_walk.clh"

#ifndef ALPHA
#define ALPHA 0.8f
#endif
#ifndef SUPPORT
#define SUPPORT 0.3f
#endif
#ifndef TRIES
#define TRIES 4
#endif
#ifndef BACK_BIAS
#define BACK_BIAS 0.25f  // radii that a hit from behind is set back by
#endif
#ifndef ORIENTED
#define ORIENTED 1
#endif

enum { AT_X, AT_Y, AT_Z, N_X, N_Y, N_Z,
       TURN,    // -1 / (sign of n_z + n_z), of the frame of the normal (common/frame.clh)
       SHRINK,  // 1 / radius
       SIZE,    // radius
       C0, C1, C2, C3, C4, C5, C6, C7, C8, C9 };  // C4 is half the coefficient of u v
#define FIELDS (9 + COEFFICIENT_COUNT)

#define FIELD(name) PART(k, (name) * WIDE)

typedef struct { VF u, v, w; } Spot;

INLINE VF signed_by(VF x, VI sign) { return AS_VF(AS_VI(x) ^ sign); }

// A vector in the frames of the surfels, by the algebra of common/frame.clh: u = (1 + s x^2 a, s x y a, -s x) and so on.
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

INLINE VI inside_footprint(VU lo, VU hi, VF u, VF v) {
  const float unit = 1.0f / 255.0f, half_root = 0.70710678f;
  VF a = (u + v) * half_root, b = (v - u) * half_root;
#define SIDE_OF(word, shift) (TO_VF(AS_VI((word) >> (shift) & 255u)) * unit)
  return (u <= SIDE_OF(lo, 0)) & (a <= SIDE_OF(lo, 8)) & (v <= SIDE_OF(lo, 16)) & (b <= SIDE_OF(lo, 24))
       & (-u <= SIDE_OF(hi, 0)) & (-a <= SIDE_OF(hi, 8)) & (-v <= SIDE_OF(hi, 16)) & (-b <= SIDE_OF(hi, 24));
}

typedef struct { float key, t, side; int slot; } Front;

// Take the frontmost hit of the surfels of one bottom node where it is nearer than found->key. A hit from the front lies
// behind `low`, one from the back behind `low_back`.
INLINE void block_hit(const Ray *r, __global const float *block, __global const uint *feet, int limited, float low,
                      float low_back, int slot, Front *found) {
  for (int part = 0; part < WIDE / VW; part++, slot += VW) {
    __global const float *k = block + part * VW;
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
    front = front & (length2(p1) < ALPHA * ALPHA) & (s1 > low) & (s1 < r->far) & (k1 < found->key);
    back = back & (length2(p2) < ALPHA * ALPHA) & (s2 > low_back) & (s2 < r->far) & (k2 < found->key);
    if (!any_lane(front | back)) continue;
    if (limited) {
      VU lo = *(__global const VU *)(feet + part * VW), hi = *(__global const VU *)(feet + WIDE + part * VW);
      VI free = (lo & hi) == 0xffffffffu;
      front = front & (free | inside_footprint(lo, hi, p1.u, p1.v));
      back = back & (free | inside_footprint(lo, hi, p2.u, p2.v));
    }
    k1 = SEL((VF)(INFINITY), k1, front); k2 = SEL((VF)(INFINITY), k2, back);
    VI behind = k2 < k1;
    VF key = SEL(k1, k2, behind), root = SEL(s1, s2, behind);
    VF side = SEL((VF)(1.0f), (VF)(-1.0f), behind);
    float least = lane_min(key);
    if (least < found->key) {
      int lane = FIRST_BIT(bits_of(key == least));
      found->key = least; found->t = LANE_OF(root, lane); found->side = LANE_OF(side, lane); found->slot = slot + lane;
    }
  }
}

INLINE Front frontmost(const Ray *r, int roots, int first_bottom, __global const float *boxes,
                       __global const float *blocks, __global const uint *feet, __global const uchar *limited,
                       float low, float low_front, float low_back) {
  Front found;
  found.key = INFINITY; found.t = INFINITY; found.side = 0.0f; found.slot = -1;
  Waiting w;
  float enters[WIDE] __attribute__((aligned(64)));
  w.node[0] = 0; w.enters[0] = low; w.count = 1;
  while (w.count > 0) {
    w.count--;
    if (w.enters[w.count] >= found.key) continue;
    int node = w.node[w.count];
    if (node < first_bottom) {
      float most = found.key < r->far ? found.key : r->far;
      uint bits = children_along(r, boxes + (size_t)node * BOX_FLOATS, low, most, enters);
      push_children(&w, bits, enters, first_child(node, roots));
    } else {
      int bottom = node - first_bottom;
      block_hit(r, blocks + (size_t)bottom * (FIELDS * WIDE), feet + (size_t)bottom * (2 * WIDE), limited[bottom],
                low_front, low_back, bottom * WIDE, &found);
      if (MODE == ANY && found.slot >= 0) w.count = 0;
    }
  }
  return found;
}

typedef struct { VF weight, step, x, y, z, last; } Blend;

// Add the surfels of a bottom node whose ball holds the point q of the ray.
INLINE void block_blend(const Ray *r, __global const float *block, float qx, float qy, float qz, float facing,
                        Blend *sum) {
  for (int part = 0; part < WIDE / VW; part++) {
    __global const float *k = block + part * VW;
    VF shrink = FIELD(SHRINK);
    Spot p = turned(k, (qx - FIELD(AT_X)) * shrink, (qy - FIELD(AT_Y)) * shrink, (qz - FIELD(AT_Z)) * shrink);
    VI inside = length2(p) < 1.0f;
    if (!any_lane(inside)) continue;
    Spot d = turned(k, r->dx, r->dy, r->dz);
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

INLINE Blend blended(const Ray *r, int roots, int first_bottom, __global const float *balls,
                     __global const float *blocks, Front hit) {
  Blend sum;
  sum.weight = sum.step = sum.x = sum.y = sum.z = sum.last = 0.0f;
  float x = r->ox + hit.t * r->dx, y = r->oy + hit.t * r->dy, z = r->oz + hit.t * r->dz;
  int stack[STACK], count = 1;
  stack[0] = 0;
  while (count > 0) {
    int node = stack[--count];
    if (node < first_bottom) {
      uint bits = children_around(balls + (size_t)node * BOX_FLOATS, x, y, z);
      int first = first_child(node, roots);
      while (bits) {
        stack[count++] = first + FIRST_BIT(bits);
        bits &= bits - 1u;
      }
    } else
      block_blend(r, blocks + (size_t)(node - first_bottom) * (FIELDS * WIDE), x, y, z, hit.side, &sum);
  }
  return sum;
}

INLINE float of_slot(__global const float *blocks, int slot, int field) {
  return blocks[(size_t)(slot / WIDE) * (FIELDS * WIDE) + field * WIDE + slot % WIDE];
}

__kernel void ray_slim(int count, int batch, int roots, int first_bottom, __global const float *boxes,
                       __global const float *balls, __global const float *blocks, __global const uint *feet,
                       __global const uchar *limited, __global const int *order, __global const float *rays,
                       __global float *hits) {
  int begin = get_global_id(0) * batch, end = begin + batch < count ? begin + batch : count;
  for (int i = begin; i < end; i++) {
    Ray r = load_ray(rays + (size_t)i * RAY_FLOATS);
    __global float *out = hits + (size_t)i * HIT_FLOATS;
    float low = r.low, low_front = r.low, low_back = r.low;
#if MODE == NEXT
    if (out[HIT_T] == INFINITY) continue;
    // A hit from the same side less than a radius behind the last one is of the same sheet.
    low = out[HIT_LOW] > low ? out[HIT_LOW] : low;
    low_front = out[HIT_SIDE] > 0.0f && out[HIT_STATE] > low ? out[HIT_STATE] : low;
    low_back = out[HIT_SIDE] < 0.0f && out[HIT_STATE] > low ? out[HIT_STATE] : low;
#endif
    float t = INFINITY, x = 0.0f, y = 0.0f, z = 0.0f, side = 0.0f, last = 0.0f, state = 0.0f;
    int slot = -1;
    for (int attempt = 0; attempt < TRIES; attempt++) {
      Front hit = frontmost(&r, roots, first_bottom, boxes, blocks, feet, limited, low, low_front, low_back);
      if (hit.slot < 0) break;
#if MODE == ANY
      t = hit.t; side = hit.side; slot = hit.slot;
      x = side * of_slot(blocks, slot, N_X); y = side * of_slot(blocks, slot, N_Y); z = side * of_slot(blocks, slot, N_Z);
      break;
#else
      Blend sum = blended(&r, roots, first_bottom, balls, blocks, hit);
      float weight = lane_sum(sum.weight);
      if (!(weight > 0.0f)) break;
      t = hit.t + lane_sum(sum.step) / weight; side = hit.side; slot = hit.slot;
      x = lane_sum(sum.x); y = lane_sum(sum.y); z = lane_sum(sum.z);
#if MODE == NEXT
      last = hit.t - lane_min(-sum.last);
      state = hit.t + of_slot(blocks, slot, SIZE);
#endif
      if (weight >= SUPPORT) break;
      low = hit.t;
      low_front = low_front > low ? low_front : low;
      low_back = low_back > low ? low_back : low;
#endif
    }
    out[HIT_T] = t;
    out[HIT_NORMAL] = x; out[HIT_NORMAL + 1] = y; out[HIT_NORMAL + 2] = z;
    out[HIT_PRIMITIVE] = as_float(slot < 0 ? -1 : order[slot]);
    out[HIT_SIDE] = side; out[HIT_LOW] = last; out[HIT_STATE] = state;
  }
}
