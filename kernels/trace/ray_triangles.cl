// Single rays against triangles, without leaks: Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1),
// 2013. A ray that meets an edge or a vertex exactly is thought moved aside by (e, e^2), e -> 0, in the plane across it, so
// that it crosses exactly one of the triangles that share an edge, and closed meshes an even number of times. One
// work-item traces `batch` rays. Twin: tests/reference/trace_rays.py, ray_triangles.
//
// A bottom node has a block of 9 vectors of 16 floats: the corners A, B, C of the triangle in each slot, x, y, z each.
#include "trace/ray_walk.clh"

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

// 1 or -1: the side of the ray that the edge from p to q passes on; 0 for an edge of no length. The products are compared,
// not subtracted: rounding keeps their order, so an edge has opposite signs from its two ends.
INLINE VF edge_side(VF px, VF py, VF qx, VF qy) {
  VF a = qx * py, b = qy * px;
  VF zero = 0.0f, one = 1.0f;
  VF side = SEL(SEL(zero, -one, a < b), one, a > b);
  VI tie = a == b;
  if (!any_lane(tie)) return side;
  // What rounding took from the products, by halves of 12 bits (no fma, which is slow on PoCL), then (e, e^2).
#define HIGH_HALF(v) (AS_VF(AS_VI(v) & (VI)0xfffff000))
  VF qxh = HIGH_HALF(qx), qxl = qx - qxh, pyh = HIGH_HALF(py), pyl = py - pyh;
  VF qyh = HIGH_HALF(qy), qyl = qy - qyh, pxh = HIGH_HALF(px), pxl = px - pxh;
  VF ra = ((qxh * pyh - a) + qxh * pyl + qxl * pyh) + qxl * pyl;
  VF rb = ((qyh * pxh - b) + qyh * pxl + qyl * pxh) + qyl * pxl;
  VF rest = SEL(SEL(zero, -one, ra < rb), one, ra > rb);
  VF up = SEL(SEL(zero, -one, qy < py), one, qy > py);
  VF across = SEL(SEL(zero, -one, px < qx), one, px > qx);
  rest = SEL(rest, SEL(up, across, up == 0.0f), rest == 0.0f);
  return SEL(side, rest, tie);
}

typedef struct { float t; int slot; } Nearest;

INLINE VF lesser(VF a, VF b) { return VMIN(a, b); }
INLINE VF greater(VF a, VF b) { return VMAX(a, b); }

// Take the triangle of a bottom node that the ray meets first behind (low, low_slot), in front of found.
INLINE void block_hit(const Shear *s, __global const float *block, float low, int low_slot, int slot, Nearest *found) {
  for (int part = 0; part < WIDE / VW; part++, slot += VW) {
    __global const float *k = block + part * VW;
    VF az = FIELD(A_X + s->z) - s->oz, bz = FIELD(B_X + s->z) - s->oz, cz = FIELD(C_X + s->z) - s->oz;
    VF ax = FIELD(A_X + s->x) - s->ox - s->sx * az, ay = FIELD(A_X + s->y) - s->oy - s->sy * az;
    VF bx = FIELD(B_X + s->x) - s->ox - s->sx * bz, by = FIELD(B_X + s->y) - s->oy - s->sy * bz;
    VF cx = FIELD(C_X + s->x) - s->ox - s->sx * cz, cy = FIELD(C_X + s->y) - s->oy - s->sy * cz;
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
    VF t = z * s->sz;
#if MODE == NEXT
    VI slots = LANE_INDEX + slot;
    in = in & ((t > low) | ((t == low) & (slots > low_slot))) & (t <= found->t);
#else
    in = in & (t > low) & (t <= found->t);
#endif
    t = SEL((VF)(INFINITY), t, in);
    float least = lane_min(t);
    if (least == INFINITY) continue;
    int at = slot + FIRST_BIT(bits_of(t == least));
    if (least < found->t || at < found->slot) { found->t = least; found->slot = at; }  // of equals the first slot
  }
}

__kernel void ray_triangles(int count, int batch, int roots, int first_bottom, __global const float *boxes,
                            __global const float *blocks, __global const int *order, __global const float *rays,
                            __global float *hits) {
  int begin = get_global_id(0) * batch, end = begin + batch < count ? begin + batch : count;
  for (int i = begin; i < end; i++) {
    Ray r = load_ray(rays + (size_t)i * RAY_FLOATS);
    __global float *out = hits + (size_t)i * HIT_FLOATS;
    float low = r.low;
    int low_slot = -1;
#if MODE == NEXT
    if (out[HIT_T] == INFINITY) continue;
    low = out[HIT_LOW] > low ? out[HIT_LOW] : low;
    low_slot = as_int(out[HIT_STATE]);
#endif
    Shear s = shear_of(&r);
    Nearest found;
    found.t = r.far; found.slot = -1;
    Waiting w;
    float enters[WIDE] __attribute__((aligned(64)));
    w.node[0] = 0; w.enters[0] = low; w.count = 1;
    while (w.count > 0) {
      w.count--;
      if (w.enters[w.count] > found.t) continue;
      int node = w.node[w.count];
      if (node < first_bottom) {
        uint bits = children_along(&r, boxes + (size_t)node * BOX_FLOATS, low, found.t, enters);
        push_children(&w, bits, enters, first_child(node, roots));
      } else {
        int bottom = node - first_bottom;
        block_hit(&s, blocks + (size_t)bottom * (FIELDS * WIDE), low, low_slot, bottom * WIDE, &found);
        if (MODE == ANY && found.slot >= 0) w.count = 0;
      }
    }
    out[HIT_T] = found.slot < 0 ? INFINITY : found.t;
    out[HIT_LOW] = found.t;
    out[HIT_STATE] = as_float(found.slot);
    out[HIT_PRIMITIVE] = as_float(found.slot < 0 ? -1 : order[found.slot]);
    if (found.slot >= 0) {
      __global const float *k = blocks + (size_t)(found.slot / WIDE) * (FIELDS * WIDE) + found.slot % WIDE;
      float a[3], e[3], f[3];
      for (int j = 0; j < 3; j++) {
        a[j] = k[j * WIDE];
        e[j] = k[(3 + j) * WIDE] - a[j];
        f[j] = k[(6 + j) * WIDE] - a[j];
      }
      float x = e[1] * f[2] - e[2] * f[1], y = e[2] * f[0] - e[0] * f[2], z = e[0] * f[1] - e[1] * f[0];
      float side = x * r.dx + y * r.dy + z * r.dz > 0.0f ? -1.0f : 1.0f;
      out[HIT_NORMAL] = side * x; out[HIT_NORMAL + 1] = side * y; out[HIT_NORMAL + 2] = side * z;
      out[HIT_SIDE] = side;
    }
  }
}
