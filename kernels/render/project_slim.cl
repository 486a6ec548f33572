// Cut, cull and project: the record of every surfel that is drawn, the blocks of 4x4 pixels it may touch, and its order
// from front to back. One work-item handles VW surfels. Twin: tests/reference/render.py, project_slim.
//
// The blocks bound the piece of surface inside the ball, a disc in (u, v) times LOW <= w <= HIGH, not the ball: seen
// edge-on that is much less. Near the eye's plane those bounds grow without limit; there the tangents from the eye to the
// ball bound it too. (Without these the thousands of surfels along that plane, most of them far to the sides, gave every
// bin of a view from close over a survey thousands of pairs: such frames took 16 to 35 s.)
#include "common/visibility.clh"
#include "common/select_slim.clh"
#include "common/bins.clh"
#include "common/blocks.clh"

#ifndef BALLS
#define BALLS 0  // 1: bound the balls themselves, at their own size, for tile_balls
#endif
#ifndef INTERNAL_SCALE
#define INTERNAL_SCALE 1.5f  // radius that internal surfels are drawn with over their own
#endif

INLINE VF lesser(VF a, VF b) { return VMIN(a, b); }
INLINE VF greater(VF a, VF b) { return VMAX(a, b); }
INLINE VF magnitude(VF x) { return VMAX(x, -x); }
INLINE VF root_of(VF x) { return VSQRT(VMAX(x, (VF)(0.0f))); }

// Bounds of x / depth over the part in front of the eye's plane of a disc around (x, depth); 1e9 stands for infinity.
INLINE void tangents(VF x, VF depth, VF radius, VF *lo, VF *hi) {
  VF all = 1e9f, distance2 = x * x + depth * depth, tangent = root_of(distance2 - radius * radius);
  VF below = depth * tangent + x * radius, above = depth * tangent - x * radius;
  VI around = (distance2 <= radius * radius);
  *lo = SEL((x * tangent - depth * radius) / below, -all, around | (below <= 1e-6f * distance2));
  *hi = SEL((x * tangent + depth * radius) / above, all, around | (above <= 1e-6f * distance2));
}

// Extent [lo, hi] along a direction m, m2 = |m|^2 and mn = m . n, of the disc times [low, high] inside a ball of `radius`.
INLINE void extent(VF m2, VF mn, float radius, VF low, VF high, VF *lo, VF *hi) {
  VF flat = radius * root_of(m2 - mn * mn), ball = radius * root_of(m2);
  VF a = mn * low, b = mn * high;
  *lo = greater(lesser(a, b) - flat, -ball);
  *hi = lesser(greater(a, b) + flat, ball);
}

__kernel void project_slim(__global const float *view, __global const float *surfels, int stride, int count,
                           __global const uchar *flags, __global const uint *footprint,
                           __global const uchar *visited, int visited_end,
                           __global float *records, __global short4 *full, __global short4 *core, __global uint *keys,
                           __global ushort *buckets) {
  int first = get_global_id(0) * VW;
  if (first >= count) return;
  int lanes = count - first < VW ? count - first : VW;
  __global const VF *plane = (__global const VF *)(surfels + first);
  int step = stride / VW;
  VF x = plane[0], y = plane[step], z = plane[2 * step];
  VF depth = depth_of(view, x, y, z);
  VF size_radius = plane[SIZE_RADIUS * step];
  VI small_lanes = is_small(view, depth, size_radius);
  const int *small = (const int *)&small_lanes;
  int drawn[VW];
  int any = 0;
  for (int i = 0; i < lanes; i++) {
    int flag = flags[first + i];
    int seen = first + i < visited_end || (flag & IS_ROOT) || visited[first + i];
    any |= drawn[i] = seen && ((flag & IS_LEAF) || small[i]);
  }
  if (!any) {
    for (int i = 0; i < lanes; i++) full[first + i] = (short4)(1, 1, 0, 0);
    return;
  }
  // The ball in view space.
  float scale = view[SCALE];
  VF X = scale * (view[0] * x + view[1] * y + view[2] * z) + view[OFFSET];
  VF Y = scale * (view[3] * x + view[4] * y + view[5] * z) + view[OFFSET + 1];
  VF r = scale * plane[BALL_RADIUS * step];
#if BALLS
  for (int i = 0; i < lanes; i++)
    if (!(flags[first + i] & IS_LEAF)) ((float *)&r)[i] *= 1.0f / INTERNAL_SCALE;
#endif
  VF inv_r = 1.0f / r;
  // The frame of the stored normal (common/frame.clh in lanes), turned into view space.
  VF nx = plane[NORMAL * step], ny = plane[(NORMAL + 1) * step], nz = plane[(NORMAL + 2) * step];
  VF sign = SIGN_OF(nz);
  VF a = -1.0f / (sign + nz), b = nx * ny * a;
  VF ax = 1.0f + sign * nx * nx * a, ay = sign * b, az = -sign * nx;
  VF bx = b, by = sign + ny * ny * a, bz = -ny;
#define TURNED(row, p, q, s) (view[3 * row] * p + view[3 * row + 1] * q + view[3 * row + 2] * s)
  VF uX = TURNED(0, ax, ay, az), uY = TURNED(1, ax, ay, az), uZ = TURNED(2, ax, ay, az);
  VF vX = TURNED(0, bx, by, bz), vY = TURNED(1, bx, by, bz), vZ = TURNED(2, bx, by, bz);
  VF nX = TURNED(0, nx, ny, nz), nY = TURNED(1, nx, ny, nz), nZ = TURNED(2, nx, ny, nz);

  int perspective = view[PERSPECTIVE] > 0.0f;
  float fx = view[FX], fy = view[FY];
  VF t_ref = perspective ? greater(depth, 0.25f * r) : depth;
  VF inv_t = perspective ? 1.0f / t_ref : (VF)(0.0f);
  VF dX = X * inv_t, dY = Y * inv_t;  // the ray through the reference point is (dX, dY, -1)
  VF xr = view[CX] + fx * (perspective ? dX : X), yr = view[CY] - fy * (perspective ? dY : Y);
  VF away = (depth - t_ref) * inv_r;  // from the centre to the reference point along view z
  VF unit = perspective ? t_ref * inv_r : inv_r;
  VF u0 = uZ * away, v0 = vZ * away, w0 = nZ * away;
  VF du = (uX * dX + uY * dY - uZ) * inv_r - inv_t * u0;
  VF dv = (vX * dX + vY * dY - vZ) * inv_r - inv_t * v0;
  VF nd = nX * dX + nY * dY - nZ;
  VF dw = nd * inv_r - inv_t * w0;

  // Depth and screen bounds of the piece of surface.
  VF low = plane[LOW * step], high = plane[HIGH * step], slope = plane[SLOPE * step];
  if (BALLS) { low = SEL((VF)(-1.0f), low, low > high); high = SEL((VF)(1.0f), high, low > high); }
  VF front, back, one = 1.0f;
  extent(one, -nZ, 1.0f, low, high, &front, &back);
  VF near = depth + r * front, far = depth + r * back;
  // The bounds below need centre and piece in front of the eye's plane.
  VI crosses = perspective ? (lesser(near, depth) < 1e-3f * r) : (VI)(0);
  VI close = perspective ? (near < 0.5f * depth) | crosses : (VI)(0);
  VF inv_near = perspective ? 1.0f / greater(near, 1e-3f * r) : one;
  VF inv_far = perspective ? 1.0f / greater(far, 1e-3f * r) : one;
  VF safe_t = perspective ? 1.0f / greater(depth, 1e-3f * r) : (VF)(0.0f);
  VF gX = X * safe_t, gY = Y * safe_t;
  VF middle_x = view[CX] + fx * (perspective ? gX : X), middle_y = view[CY] - fy * (perspective ? gY : Y);
  // x - middle = fx (m . p) / depth(p) with m = (1, 0, X / depth); the picture's y runs down.
  VF mnx = nX + nZ * gX, mny = -(nY + nZ * gY), mx2 = 1.0f + gX * gX, my2 = 1.0f + gY * gY;
  VI visible = (far > view[NEAR]) & (low <= high);
  VI block[8];
  for (int pass = 0; pass < 2; pass++) {
    float disc = pass ? ALPHA : 1.0f;
    VF lo_x, hi_x, lo_y, hi_y;
    extent(mx2, mnx, disc, low, high, &lo_x, &hi_x);
    extent(my2, mny, disc, low, high, &lo_y, &hi_y);
    // 1/32 pixel covers float rounding.
    lo_x = middle_x + fx * r * lo_x * SEL(inv_far, inv_near, lo_x < 0.0f) - 0.03125f;
    hi_x = middle_x + fx * r * hi_x * SEL(inv_near, inv_far, hi_x < 0.0f) + 0.03125f;
    lo_y = middle_y + fy * r * lo_y * SEL(inv_far, inv_near, lo_y < 0.0f) - 0.03125f;
    hi_y = middle_y + fy * r * hi_y * SEL(inv_near, inv_far, hi_y < 0.0f) + 0.03125f;
    VF all = 1e9f;
    lo_x = SEL(lo_x, -all, crosses); hi_x = SEL(hi_x, all, crosses);
    lo_y = SEL(lo_y, -all, crosses); hi_y = SEL(hi_y, all, crosses);
    if (any_lane(close)) {
      VF left, right, under, over, ball = r * (disc * (1.0f + 1e-4f));
      tangents(X, depth, ball, &left, &right);
      tangents(Y, depth, ball, &under, &over);
      lo_x = SEL(lo_x, greater(lo_x, view[CX] + fx * left - 0.03125f), close);
      hi_x = SEL(hi_x, lesser(hi_x, view[CX] + fx * right + 0.03125f), close);
      lo_y = SEL(lo_y, greater(lo_y, view[CY] - fy * over - 0.03125f), close);
      hi_y = SEL(hi_y, lesser(hi_y, view[CY] - fy * under + 0.03125f), close);
    }
    block_range(lo_x, hi_x, view[WIDTH], &block[4 * pass], &block[4 * pass + 2]);
    block_range(lo_y, hi_y, view[HEIGHT], &block[4 * pass + 1], &block[4 * pass + 3]);
  }
  // Which sides can be seen: over the unit disc f' along the ray of the reference point is its value there plus a linear
  // form (and for degree 3 a bounded rest). The ray of another point p of the ball differs, up to a positive factor, by
  // p less the reference point, over t_ref: at most REACH / t_ref, also at the eye's plane.
  __global const VF *k = plane + COEFFICIENTS * step;
  VF ud = uX * dX + uY * dY - uZ, vd = vX * dX + vY * dY - vZ, at_centre = nd, spread = 0.0f;
#if DEGREE >= 2
  VF su = k[3 * step] * ud + k[4 * step] * vd, sv = k[4 * step] * ud + k[5 * step] * vd;
  at_centre -= k[step] * ud + k[2 * step] * vd;
  spread = 2.0f * root_of(su * su + sv * sv);
#endif
#if DEGREE >= 3
  VF cu = 3.0f * (k[6 * step] * ud) + k[7 * step] * vd, cm = k[7 * step] * ud + k[8 * step] * vd;
  VF cv = k[8 * step] * ud + 3.0f * (k[9 * step] * vd);
  spread += magnitude(cu) + magnitude(cm) + magnitude(cv);
#endif
  VF off = t_ref - depth;
  if (perspective) spread += (r + off) * inv_t * (1.0f + slope);
  VI enters = at_centre - spread < 0.0f, leaves = at_centre + spread > 0.0f;
  VU bits = AS_VU(near);
  VU ordered = bits ^ SEL((VU)(0x80000000u), (VU)(0xffffffffu), AS_VI(bits) < 0);
  ordered = (ordered & 0xffffff00u) | AS_VU(SEL((VI)(0), (VI)(1), enters) | SEL((VI)(0), (VI)(2), leaves));
  VF bucket = (near - view[FIRST_DEPTH]) * (1.0f / view[BUCKET_DEPTH]);
  bucket = lesser(greater(bucket, (VF)(0.0f)), (VF)(DEPTH_BUCKETS - 1));
  VI bucket_number = TO_VI(bucket);

  VF px = unit / fx, py = -unit / fy;
  VF field[RECORD_FLOATS];
  const float *lane = (const float *)field;
  field[XR] = xr; field[YR] = yr; field[T_REF] = t_ref; field[INV_T] = inv_t;
  field[UX] = uX * px; field[UY] = uY * py; field[VX] = vX * px; field[VY] = vY * py;
  field[WX] = nX * px; field[WY] = nY * py; field[U0] = u0; field[V0] = v0; field[W0] = w0;
  field[DU] = du; field[DV] = dv; field[DW] = dw;
  field[RADIUS] = r; field[RADIUS_PX] = perspective ? r * inv_t : r;
  field[BIAS] = BACK_BIAS * r; field[REACH] = r + off;
  field[FOOT_LO] = 0.0f; field[FOOT_HI] = 0.0f;
  field[K0] = k[0];
  for (int i = 1; i < 6; i++) field[K0 + i] = DEGREE >= 2 ? k[i * step] : (VF)(0.0f);
  for (int i = 6; i < 10; i++) field[K6 + i - 6] = DEGREE >= 3 ? k[i * step] : (VF)(0.0f);
  const int *box = (const int *)block, *show = (const int *)&visible;
  const int *bucket_of = (const int *)&bucket_number;
  const uint *key = (const uint *)&ordered;
  for (int i = 0; i < lanes; i++) {
    int at = first + i;
    short4 blocks = (short4)(box[i], box[VW + i], box[2 * VW + i], box[3 * VW + i]);
    if (!drawn[i] || !show[i] || blocks.x > blocks.z || blocks.y > blocks.w) {
      full[at] = (short4)(1, 1, 0, 0);
      continue;
    }
    full[at] = blocks;
    core[at] = (short4)(box[4 * VW + i], box[5 * VW + i], box[6 * VW + i], box[7 * VW + i]);
    keys[at] = key[i];
    buckets[at] = (ushort)bucket_of[i];
    __global float *record = records + (size_t)at * RECORD_FLOATS;
    for (int f = 0; f < RECORD_FLOATS; f++) record[f] = lane[f * VW + i];
    record[FOOT_LO] = as_float(footprint[2 * at]);
    record[FOOT_HI] = as_float(footprint[2 * at + 1]);
  }
}
