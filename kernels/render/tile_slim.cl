// Draw the surfels of every bin into its depth and attribute planes: the two passes of the paper's section 3.
//
// Pass 1 finds the frontmost hit of the alpha-shrunken balls, pass 2 blends all surfels whose ball holds that point:
// depth and gradient weighted by G(|q_i - c| / r) = (1 - t^2)^3. A point whose weights add up to less than SUPPORT is
// the rim of a piece that overshoots; then the pixel looks behind it, up to TRIES times, and keeps the last hit.
//
// VW > 1: one work-item per tile of TILE_BINS^2 bins, lanes over blocks of 4x4 pixels (8 lanes: 4x2, 4: 4x1).
// VW = 1: one work-group of 64 work-items per tile, each a pixel of the bin at hand.
// Twin: tests/reference/render.py, tile_slim.
#include "common/visibility.clh"
#include "common/bins.clh"
#include "common/planes.clh"
#include "common/view.clh"
#include "common/clip.clh"
#include "render/differentials.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#ifndef FUNCTION
#define FUNCTION 0  // 1: normals and curvature of the blended function in place of blended ones, equation 8, right
#endif

#if VW == 1
#define LANE_X(pixel) ((pixel) & 7)
#define LANE_Y(pixel) ((pixel) >> 3)
#else
#define LANE_X(first) (LANE_INDEX & 3)
#define LANE_Y(first) (LANE_INDEX >> 2)
#endif

typedef struct {
  VF depth, weight, fx, fy, ft, red, green, blue, facing;
  VI nearest, number;
#if DERIVATIVES || FUNCTION
  Jet jet;
#endif
} Blend;

#if VW == 1
#define PAIRS __global const uint2 *
#define AT_ONCE 1
#define SKIP(pair, bits) if (!((pair).y & (bits))) continue;
#else
// The pairs of one block, a segment of the bin's list at a time: what remains has no unpredictable branch.
#define PAIRS const uint2 *
#ifndef AT_ONCE
#define AT_ONCE 2
#endif
#define SKIP(pair, bits)
#define SEGMENT 256
INLINE int filtered(__global const uint2 *pairs, int count, uint shift, uint2 *kept) {
  int n = 0;
  for (int e = 0; e < count; e++) {
    uint2 pair = pairs[e];
    kept[n] = pair;
    n += pair.y >> shift & 1u;
  }
  return n;
}
#endif

#if FUNCTION
#include "render/blend_function.clh"
#endif

// Records are scattered: asking for all of a bin's at once hides their latency (8.0 -> 6.8 ms of a dragon frame).
INLINE void fetch_ahead(__global const uint2 *pairs, int count, __global const float *records) {
#ifdef HAS_PREFETCH
  for (int e = 0; e < count; e++) {
    size_t record = (size_t)(records + (size_t)INDEX_OF(pairs[e]) * RECORD_FLOATS);
    __builtin_prefetch((const void *)record);
    __builtin_prefetch((const void *)(record + 64));
  }
#endif
}

// Take the root of one side where it is a hit nearer than `z`.
INLINE void frontmost_root(__global const float *k, RayPoly p, uint index, float side, VF u, VF v, VF w, VF du, VF dv,
                           VF dw, VF low, VF high, VF *z, VF *hit, VF *facing, VI *nearest) {
  VF s, slope;
  VI good = ray_root(p, (VF)(side), &s, &slope);
  u += s * du; v += s * dv; w += s * dw;
  VF t = s + k[T_REF];
  VF key = t;
  if (ORIENTED && side < 0.0f) key = t + k[BIAS];
  good = good & (u * u + v * v + w * w < ALPHA * ALPHA) & (t > low) & (key < *z);
#if CLIP_PLANES
  good = good & (t < high);
#endif
  uint lo = as_uint(k[FOOT_LO]), hi = as_uint(k[FOOT_HI]);
  if ((lo & hi) != 0xffffffffu) good = good & inside_footprint(lo, hi, u, v);
  *z = SEL(*z, key, good);
  *hit = SEL(*hit, t, good);
  *facing = SEL(*facing, (VF)(side), good);
#if FIELD_LEVEL >= 0
  *nearest = SEL(*nearest, (VI)((int)index), good);
#endif
}

// Pass 1: depth of the frontmost hit behind `low` and in front of `high` and `z` (in), its side (1, -1) and surfel. Returns whether
// pairs further back may still matter.
INLINE int frontmost(PAIRS pairs, int count, uint block, float bucket, __global const float *records, VF px, VF py,
                     VF low, VF high, VF *z, VF *hit, VF *facing, VI *nearest, int *cost) {
  int more = 1;
  for (int e = 0; e < count; e += AT_ONCE) {
    float near = near_of_key(pairs[e].y);
    if (!any_lane(near - bucket < *z)) { count = 0; more = 0; continue; }  // PoCL is slower with a break
    // The test waits for the hits before it; one test for two pairs lets their arithmetic overlap.
    for (int i = 0; i < AT_ONCE; i++) {
      uint2 pair = pairs[e + i < count ? e + i : e];
      SKIP(pair, block)
      __global const float *k = records + (size_t)INDEX_OF(pair) * RECORD_FLOATS;
      VF x = px - k[XR], y = py - k[YR];
      VF u = k[U0] + k[UX] * x + k[UY] * y, v = k[V0] + k[VX] * x + k[VY] * y, w = k[W0] + k[WX] * x + k[WY] * y;
      VF du = k[DU] + k[INV_T] * u, dv = k[DV] + k[INV_T] * v, dw = k[DW] + k[INV_T] * w;
      RayPoly p = ray_poly(k, u, v, w, du, dv, dw);
#define ROOT_OF(side) frontmost_root(k, p, INDEX_OF(pair), side, u, v, w, du, dv, dw, low, high, z, hit, facing, nearest)
      if (pair.x & SEEN_FRONT) ROOT_OF(1.0f);
      if (pair.x & SEEN_BACK) ROOT_OF(-1.0f);
      *cost += 1;
    }
  }
  return more;
}

// Pass 2: add the surfels whose ball holds the point at depth `hit` (INFINITY: no point).
INLINE void blend(PAIRS pairs, int count, uint block, __global const float *records, __global const float4 *colors,
                  VF px, VF py, VF hit, VF facing, Blend *sum, int *cost) {
  for (int e = 0; e < count; e++) {
    uint2 pair = pairs[e];
    SKIP(pair, block)
    uint index = INDEX_OF(pair);
    __global const float *k = records + (size_t)index * RECORD_FLOATS;
    VF s = hit - k[T_REF];
    if (!any_lane((s < k[REACH]) & (s > -k[REACH]))) continue;
    VF x = px - k[XR], y = py - k[YR], step, slope;
    VF u = k[U0] + k[UX] * x + k[UY] * y, v = k[V0] + k[VX] * x + k[VY] * y, w = k[W0] + k[WX] * x + k[WY] * y;
    VF du = k[DU] + k[INV_T] * u, dv = k[DV] + k[INV_T] * v, dw = k[DW] + k[INV_T] * w;
    u += s * du; v += s * dv; w += s * dw;
    VI inside = u * u + v * v + w * w < 1.0f;
    if (!any_lane(inside)) continue;
    RayPoly p = ray_poly(k, u, v, w, du, dv, dw);
#if ORIENTED
    VF side = facing;
#else
    VF side = SEL((VF)(-1.0f), (VF)(1.0f), p.b < 0.0f);  // the root nearer to the point
#endif
    inside = inside & ray_root(p, side, &step, &slope);
    step = SEL((VF)(0.0f), step, inside);  // no NaN may reach the sums
    u += step * du; v += step * dv; w += step * dw;
    VF g = 1.0f - (u * u + v * v + w * w), gu, gv;
    inside = inside & (g > 0.0f);
    VF weight = SEL((VF)(0.0f), g * g * g, inside);
    height_slope(k, u, v, &gu, &gv);
    VF tilt = weight * side * k[RADIUS_PX];
    sum->weight += weight;
    sum->depth += weight * step;
    sum->fx += tilt * (k[WX] - gu * k[UX] - gv * k[VX]);
    sum->fy += tilt * (k[WY] - gu * k[UY] - gv * k[VY]);
    sum->ft -= weight * k[RADIUS] * SEL((VF)(0.0f), slope, inside);
#if DERIVATIVES
    add_jet(&sum->jet, k, ORIENTED ? weight : weight * side, u, v, du, dv, p, step);
#endif
#if HAS_COLOR
    float4 color = colors[index];
    sum->red += weight * color.x; sum->green += weight * color.y; sum->blue += weight * color.z;
#endif
#if FIELD_COUNT >= 0
    sum->number += SEL((VI)(0), (VI)(1), inside);
#endif
    *cost += 1;
  }
}

#if FUNCTION
// Put the derivatives of the blended function at the pixels' places where the blended ones are.
INLINE void use_function(__global const uint2 *pairs, int count, uint quarter, __global const float *records, VF px,
                         VF py, Blend *best) {
  Sums weights, functions;
  clear_sums(&weights);
  clear_sums(&functions);
#if VW == 1
  sum_functions(pairs, count, 1u << quarter, records, px, py, best->depth, best->facing, &weights, &functions);
#else
  uint2 kept[SEGMENT];
  for (int first = 0; first < count; first += SEGMENT) {
    int n = filtered(pairs + first, count - first < SEGMENT ? count - first : SEGMENT, quarter, kept);
    sum_functions(kept, n, 0u, records, px, py, best->depth, best->facing, &weights, &functions);
  }
#endif
  VI some = weights.value > 1e-6f;  // a place between the surfels' roots may lie outside all their balls
  divide_sums(&weights, &functions);
  best->fx = SEL(best->fx, best->facing * functions.x, some);
  best->fy = SEL(best->fy, best->facing * functions.y, some);
  best->ft = SEL(best->ft, best->facing * functions.t, some);
#define USE_SECOND(d) best->jet.d = SEL(best->jet.d, functions.second.d, some);
  EACH_SECOND(USE_SECOND)
}
#endif

// One block (VW = 1: one pixel) of a bin.
INLINE int draw_block(__global const float *view, __global const uint2 *pairs, int count, uint quarter,
                      __global const float *records, __global const float4 *colors, __global const int *levels,
                      __global float *planes, int was_touched, int surface, VI lane_x, VI lane_y, int bin_x, int bin_y,
                      int at) {
  VF px = TO_VF(lane_x) + (bin_x * BIN + 0.5f), py = TO_VF(lane_y) + (bin_y * BIN + 0.5f);
  VF before = EMPTY_DEPTH;
  if (was_touched) before = load_plane(planes, FIELD_DEPTH, at);
  VF low = view[NEAR], high = INFINITY, infinite = INFINITY;
  clip_range(view, px, py, &low, &high);
  VI active = TRUE_LANES, any_hit = 0;
  Blend best;
  best.depth = infinite;
  best.weight = best.fx = best.fy = best.ft = best.red = best.green = best.blue = best.facing = 1.0f;
  best.nearest = 0; best.number = 0;
#if DERIVATIVES || FUNCTION
#define CLEAR_BEST(d) best.jet.d = 0.0f;
  EACH_DERIVATIVE(CLEAR_BEST)
#endif
  int cost = 0;
  for (int attempt = 0; attempt < TRIES; attempt++) {
    VF z = SEL(-infinite, before, active), hit = infinite, facing = 0.0f;
    VI nearest = 0;
#if VW == 1
    frontmost(pairs, count, 16u << quarter, view[BUCKET_DEPTH], records, px, py, low, high, &z, &hit, &facing, &nearest,
              &cost);
#else
    uint2 kept[SEGMENT];
    int more = 1;
    for (int first = 0; first < count && more; first += SEGMENT) {
      int n = filtered(pairs + first, count - first < SEGMENT ? count - first : SEGMENT, quarter + 4, kept);
      more = frontmost(kept, n, 0u, view[BUCKET_DEPTH], records, px, py, low, high, &z, &hit, &facing, &nearest, &cost);
    }
#endif
    VI found = hit < infinite;
    if (!any_lane(found)) break;
    Blend sum;
    sum.depth = sum.weight = sum.fx = sum.fy = sum.ft = sum.red = sum.green = sum.blue = 0.0f;
    sum.nearest = 0; sum.number = 0;
#if DERIVATIVES || FUNCTION
#define CLEAR_SUM(d) sum.jet.d = 0.0f;
    EACH_DERIVATIVE(CLEAR_SUM)
#endif
#if VW == 1
    blend(pairs, count, 1u << quarter, records, colors, px, py, hit, facing, &sum, &cost);
#else
    for (int first = 0; first < count; first += SEGMENT) {
      int n = filtered(pairs + first, count - first < SEGMENT ? count - first : SEGMENT, quarter, kept);
      blend(kept, n, 0u, records, colors, px, py, hit, facing, &sum, &cost);
    }
#endif
    found = found & (sum.weight > 0.0f);
    sum.depth = hit + sum.depth / sum.weight;
#define KEEP(x) best.x = SEL(best.x, sum.x, found)
    KEEP(depth); KEEP(weight); KEEP(fx); KEEP(fy); KEEP(ft); KEEP(number);
    best.nearest = SEL(best.nearest, nearest, found);
#if HAS_COLOR
    KEEP(red); KEEP(green); KEEP(blue);
#endif
#if DERIVATIVES || FUNCTION
#define KEEP_DERIVATIVE(d) KEEP(jet.d);
    EACH_DERIVATIVE(KEEP_DERIVATIVE)
#endif
    best.facing = SEL(best.facing, ORIENTED ? facing : (VF)(1.0f), found);
    any_hit = any_hit | found;
    active = found & (sum.weight < SUPPORT);
    low = SEL(low, hit, active);
    if (!any_lane(active)) break;
  }
  VI closer = any_hit & (best.depth < before);
  if (was_touched && !any_lane(closer)) return cost;
  store_plane(planes, FIELD_DEPTH, at, SEL(before, best.depth, closer));
  if (!any_lane(closer)) return cost;
#if FUNCTION
  use_function(pairs, count, quarter, records, px, py, &best);
#endif
  float fx = view[FX], fy = view[FY];
  VF gx = best.fx * fx, gy = -best.fy * fy;
  VF gz = view[PERSPECTIVE] > 0.0f ? gx * ((px - view[CX]) / fx) + gy * ((view[CY] - py) / fy) - best.ft : -best.ft;
  VF nx = gx, ny = gy, nz = gz;
#if ORIENTED
  VF rx = 0.0f, ry = 0.0f;
  if (view[PERSPECTIVE] > 0.0f) { rx = (px - view[CX]) / fx; ry = (view[CY] - py) / fy; }
  outward_at_rims(rx, ry, best.facing, &nx, &ny, &nz);
#endif
  merge_plane(planes, FIELD_NORMAL, at, nx, closer);
  merge_plane(planes, FIELD_NORMAL + 1, at, ny, closer);
  merge_plane(planes, FIELD_NORMAL + 2, at, nz, closer);
#if FIELD_COLOR >= 0
  VF inv = 1.0f / best.weight;
  merge_plane(planes, FIELD_COLOR, at, best.red * inv, closer);
  merge_plane(planes, FIELD_COLOR + 1, at, best.green * inv, closer);
  merge_plane(planes, FIELD_COLOR + 2, at, best.blue * inv, closer);
#endif
#if FIELD_ID >= 0
  merge_plane(planes, FIELD_ID, at, AS_VF((VI)(surface)), closer);
#endif
#if FIELD_COUNT >= 0
  merge_plane(planes, FIELD_COUNT, at, AS_VF(best.number), closer);
#endif
#if FIELD_LEVEL >= 0
  VI level;
  for (int i = 0; i < VW; i++) ((int *)&level)[i] = levels[((int *)&best.nearest)[i]];
  merge_plane(planes, FIELD_LEVEL, at, AS_VF(level), closer);
#endif
#if DERIVATIVES
  merge_differentials(view, planes, at, &best.jet, gx, gy, gz, px, py, best.facing, closer);
#endif
  return cost;
}

__kernel void tile_slim(__global const float *view, __global const uint2 *pairs, __global const uint *offsets,
                        __global const float *records, __global const float4 *colors, __global const int *levels,
                        int surface, int tiles_x, int tile_count, int bins_x, int bins_y,
                        __global int *touched /* pixel evaluations so far, -1: none */, __global float *tile_planes) {
#if VW == 1
  __local int cost;
  int tile = get_group_id(0), pixel = get_local_id(0);
#else
  int tile = get_global_id(0);
#endif
  if (tile >= tile_count) return;
  tile = spread_tile(tile, tile_count);
  int x0 = tile % tiles_x * TILE_BINS, y0 = tile / tiles_x * TILE_BINS;
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) {
    int bin_x = x0 + i % TILE_BINS, bin_y = y0 + i / TILE_BINS;
    if (bin_x >= bins_x || bin_y >= bins_y) continue;
    int bin = bin_y * bins_x + bin_x;
    int begin = offsets[bin], count = offsets[bin + 1] - begin;
    if (count == 0) continue;
    __global float *planes = tile_planes + (size_t)bin * BIN_PIXELS * FIELDS;
    int was_touched = touched[bin] >= 0;
#if VW == 1
    uint quarter = (pixel & 7) >> 2 | (pixel >> 5) << 1;
    int mine = draw_block(view, pairs + begin, count, quarter, records, colors, levels, planes, was_touched, surface,
                          LANE_X(pixel), LANE_Y(pixel), bin_x, bin_y, pixel);
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (pixel == 0) cost = was_touched ? touched[bin] : 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    atomic_add(&cost, mine);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (pixel == 0) touched[bin] = cost;
#else
    int cost = 0;
    fetch_ahead(pairs + begin, count, records);
    for (int b = 0; b < 64 / VW; b++) {
      int quarter = b / (16 / VW), part = b % (16 / VW);
      int qx = (quarter & 1) * 4, qy = (quarter >> 1) * 4 + part * (VW / 4);
      cost += draw_block(view, pairs + begin, count, (uint)quarter, records, colors, levels, planes, was_touched, surface,
                         qx + LANE_X(0), qy + LANE_Y(0), bin_x, bin_y, qy * BIN + qx);
    }
    touched[bin] = (was_touched ? touched[bin] : 0) + cost * VW;
#endif
  }
}
