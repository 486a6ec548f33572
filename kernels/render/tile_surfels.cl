// Draw the surfels of every bin into its depth and attributes: perspective-correct discs, normals from their maps.
//
// Pass 1 finds the frontmost disc of every pixel; of a base surfel its inner part counts, of an inner surfel where its
// map is covered, which trims silhouettes and holes. Where that is seen from behind and the rest of a disc seen from the
// front lies before it, the latter is taken: a closed surface shows its inside through gaps only. Pass 2 blends what
// lies about as deep and is seen from the same side, weighted by (1 - t^2)^3, which is close to a Gaussian of the
// distance t from the disc's middle over its radius. What a surface shows does not depend on others in the planes: they
// only spare it discs that could not come to lie in front of them.
//
// VW > 1: one work-item per tile of TILE_BINS^2 bins, lanes over blocks of 4x4 pixels (8 lanes: 4x2, 4: 4x1).
// VW = 1: one work-group of 64 work-items per tile, each a pixel of the bin at hand.
// Twin: tests/reference/surfels.py, tile_surfels.
#include "common/surfel.clh"
#include "common/bins.clh"
#include "common/planes.clh"
#include "common/clip.clh"
#include "common/rims.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#ifndef IS_PERSPECTIVE
#define IS_PERSPECTIVE 1
#endif
#ifndef MAPS
#define MAPS 1        // 0: every surfel is a whole disc with one normal, as in QSplat
#endif
#ifndef ONE_COLOR
#define ONE_COLOR 0   // of all surfels
#endif
#ifndef COLOR_MAPS
#define COLOR_MAPS 0
#endif

#if VW == 1
#define LANE_X(pixel) ((pixel) & 7)
#define LANE_Y(pixel) ((pixel) >> 3)
#define PAIRS __global const uint2 *
#define SKIP(pair, bits) if (!((pair).y & (bits))) continue;
#define KEEP(pair)
#define KEEP_REST(from, to)
#else
#define LANE_X(first) (LANE_INDEX & 3)
#define LANE_Y(first) (LANE_INDEX >> 2)
// The pairs of one block, a segment of the bin's list at a time: what remains has no unpredictable branch.
#define PAIRS uint2 *
#define SKIP(pair, bits)
// Pass 1 leaves those that pass 2 may blend.
#define KEEP(pair) pairs[kept++] = pair;
#define KEEP_REST(from, to) for (int rest = from; rest < to; rest++) pairs[kept++] = pairs[rest];
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

// Records are scattered: asking for all of a bin's at once, for what pass 1 needs, hides their latency.
INLINE void fetch_ahead(__global const uint2 *pairs, int count, __global const float *records) {
#ifdef HAS_PREFETCH
  for (int e = 0; e < count; e++)
    __builtin_prefetch((const void *)(size_t)(records + (size_t)INDEX_OF(pairs[e]) * RECORD_FLOATS));
#endif
}

typedef struct { VF weight, depth, x, y, z, red, green, blue; VI number; } Blend;

// The disc under the pixels (x, y) past its reference: K, and the place in units where the disc is |place|^2 < *one.
INLINE VF see(__global const float *k, VF x, VF y, VF *u, VF *v, VF *one) {
  VF near = k[K0] + k[KX] * x + k[KY] * y;
  *u = k[U0] + k[UX] * x + k[UY] * y;
  *v = k[V0] + k[VX] * x + k[VY] * y;
  *one = IS_PERSPECTIVE ? near * near : (VF)(1.0f);
  return near;
}

// Texels of the lanes `use` at place (u, v) / one of the map of surfel `k`.
INLINE VI texels_at(__global const float *k, VF u, VF v, VF inverse) {
  int size = as_int(k[FLAGS]) & MAP_SIZE_BITS;
  float half_size = 0.5f * size;
  VF top = size - 0.5f, low = 0.0f;
  VF x = (u * inverse + 1.0f) * half_size, y = (v * inverse + 1.0f) * half_size;
  x = VMIN(VMAX(x, low), top); y = VMIN(VMAX(y, low), top);  // NaN: 0
  return TO_VI(x) + TO_VI(y) * size + as_int(k[MAP]);
}

// Ask for what pass 2 needs of a disc that it may blend: the rest of its record, and the texels under a block's corners.
// Dragon 1024x1024, PoCL on AVX2: 12.2 to 11.4 ms.
INLINE void fetch_for_blend(__global const float *k, VF u, VF v, VF where, __global const uint *atlas) {
#if defined(HAS_PREFETCH) && VW == 16
  __builtin_prefetch((const void *)(size_t)(k + LINE));
  if (!MAPS || (as_int(k[FLAGS]) & (IS_BASE | IS_PLAIN)) != IS_PLAIN) return;
  int size = as_int(k[FLAGS]) & MAP_SIZE_BITS;
  float half_size = 0.5f * size, low = 0.0f, top = size - 0.5f;
  float4 inverse = IS_PERSPECTIVE ? 1.0f / where.s03cf : (float4)(1.0f);
  float4 x = (u.s03cf * inverse + 1.0f) * half_size, y = (v.s03cf * inverse + 1.0f) * half_size;
  x = x > low ? x : low; y = y > low ? y : low;
  x = x < top ? x : top; y = y < top ? y : top;
  int4 texel = __builtin_convertvector(x, int4) + __builtin_convertvector(y, int4) * size + as_int(k[MAP]);
  __builtin_prefetch((const void *)(size_t)(atlas + texel.x));
  __builtin_prefetch((const void *)(size_t)(atlas + texel.y));
  __builtin_prefetch((const void *)(size_t)(atlas + texel.z));
  __builtin_prefetch((const void *)(size_t)(atlas + texel.w));
#endif
}

// Pass 1: the largest K between `smallest` and `largest`, its side and its surfel; what has K under `behind` cannot show.
// (rx, ry, rz) are the rays, model space. Of private pairs those remain whose discs lie over a pixel, `*total` of them.
INLINE int frontmost(PAIRS pairs, int *total, uint block, float bucket, __global const float *records,
                     __global const uint *atlas, VF px, VF py, VF rx, VF ry, VF rz, VF smallest, VF largest,
                     VF behind, VF *best, VF *at, VF *facing, VI *nearest, VF *whole /* frontmost disc seen from its front, rest and
                     all */, VI *whole_nearest, int *cost) {
  int more = 1, count = *total, kept = 0;
  for (int e = 0; e < count; e++) {
    uint2 pair = pairs[e];
    float near = near_of_key(pair.y) - bucket;
    // A disc seen from behind lets one before it show that is there already.
    VI open = IS_PERSPECTIVE ? (near * *best < 1.0f) & ((near * behind < 1.0f) | (*whole > behind))
                             : (near < -*best) & ((near < -behind) | (*whole > behind));
    if (!any_lane(open)) { KEEP_REST(e, count) count = 0; more = 0; continue; }  // PoCL is slower with a break
    SKIP(pair, block)
    __global const float *k = records + (size_t)INDEX_OF(pair) * RECORD_FLOATS;
    VF u, v, one, where = see(k, px - k[XR], py - k[YR], &u, &v, &one);
    VF away2 = u * u + v * v;
    *cost += 1;
    if (!any_lane(away2 < one)) continue;
    KEEP(pair)
    fetch_for_blend(k, u, v, where, atlas);
    VF key = where;
    if (k[FACE] < 0.0f) key = IS_PERSPECTIVE ? where - k[BIAS] * where * where : where - k[BIAS];
    VI good = (away2 < k[CORE2] * one) & (where < largest) & (key > *best);
    VI some = (away2 < one) & (where < largest) & (where > *whole);
    if (IS_PERSPECTIVE) good = good & (where > 0.0f);
#if CLIP_PLANES
    good = good & (where > smallest);
    some = some & (where > smallest);
#endif
    if (k[FACE] < 0.0f) some = (VI)(0);
    if (!any_lane(good | some)) continue;
    if (MAPS && !(as_int(k[FLAGS]) & IS_PLAIN)) {
      VF inverse = IS_PERSPECTIVE ? 1.0f / where : (VF)(1.0f);
      VU code = gather_words(atlas, SEL((VI)(as_int(k[MAP])), texels_at(k, u, v, inverse), good | some));
      good = good & (AS_VI(code) < 0);  // the highest bit: covered
      // Past its silhouette the surface has bent away below the disc, which there is seen beside it: of a round surface
      // from where its normal faces the eye half as much as the disc's.
      VF nx, ny, nz;
      decode_normal(code, &nx, &ny, &nz);
      some = some & (AS_VI(code) < 0) & (nx * rx + ny * ry + nz * rz < 0.0f);
      nx -= TRIM * k[NX]; ny -= TRIM * k[NY]; nz -= TRIM * k[NZ];
      good = good & (k[FACE] * (nx * rx + ny * ry + nz * rz) < 0.0f);
    }
    *best = SEL(*best, key, good);
    *at = SEL(*at, where, good);
    *facing = SEL(*facing, (VF)(k[FACE]), good);
#if FIELD_LEVEL >= 0
    *nearest = SEL(*nearest, (VI)(as_int(k[ID])), good);
    *whole_nearest = SEL(*whole_nearest, (VI)(as_int(k[ID])), some);
#endif
    *whole = SEL(*whole, where, some);
  }
  *total = kept;
  return more;
}

INLINE float farthest(VF depth) {
  const float *lane = (const float *)&depth;
  float most = lane[0];
  for (int i = 1; i < VW; i++) most = lane[i] > most ? lane[i] : most;
  return most;
}

// Pass 2: add the discs about as deep as `hit`, seen from the same side. Returns whether pairs further back may still
// matter: those whose nearest point lies in front of `deepest`.
INLINE int blend(PAIRS pairs, int count, uint block, float deepest, __global const float *records,
                 __global const uint *atlas, __global const uint *color_atlas, __global const float4 *colors, VF px, VF py,
                 VF hit, VF facing, Blend *sum, int *cost) {
  int more = 1;
  for (int e = 0; e < count; e++) {
    uint2 pair = pairs[e];
    if (near_of_key(pair.y) > deepest) { count = 0; more = 0; continue; }
    SKIP(pair, block)
    __global const float *k = records + (size_t)INDEX_OF(pair) * RECORD_FLOATS;
    VF u, v, one, where = see(k, px - k[XR], py - k[YR], &u, &v, &one);
    VF apart = IS_PERSPECTIVE ? hit * where - 1.0f : hit + where;
    VI inside = (u * u + v * v < one) & (apart < k[SLAB]) & (apart > -k[SLAB]) & (facing == k[FACE]);
    if (IS_PERSPECTIVE) inside = inside & (where > 0.0f);
    if (!any_lane(inside)) continue;
    int flags = as_int(k[FLAGS]);
    VF safe = SEL((VF)(1.0f), where, inside);
    VF inverse = IS_PERSPECTIVE ? 1.0f / safe : (VF)(1.0f), depth = IS_PERSPECTIVE ? inverse : -safe;
    VI texel = 0;
    VF nx = k[NX], ny = k[NY], nz = k[NZ];
    if (!(flags & IS_BASE) && (MAPS || COLOR_MAPS)) {
      texel = SEL((VI)(as_int(k[MAP])), texels_at(k, u, v, inverse), inside);
      VU code = gather_words(atlas, texel);
      if (MAPS) {
        inside = inside & (AS_VI(code) < 0);
        decode_normal(code, &nx, &ny, &nz);
      }
    }
    VF g = 1.0f - (u * u + v * v) * inverse * inverse;
    VF weight = SEL((VF)(0.0f), g * g * g, inside & (g > 0.0f));
    sum->weight += weight;
    sum->depth += weight * depth;
    sum->x += weight * nx; sum->y += weight * ny; sum->z += weight * nz;
#if FIELD_COLOR >= 0
    if (COLOR_MAPS && !(flags & IS_BASE)) {
      VU code = gather_words(color_atlas, texel);
      sum->red += weight * light_of(code & 255u);
      sum->green += weight * light_of(code >> 8 & 255u);
      sum->blue += weight * light_of(code >> 16 & 255u);
    } else {
      float4 color = colors[ONE_COLOR ? 0 : as_int(k[ID])];
      sum->red += weight * color.x; sum->green += weight * color.y; sum->blue += weight * color.z;
    }
#endif
#if FIELD_COUNT >= 0
    sum->number += SEL((VI)(0), (VI)(1), weight > 0.0f);
#endif
    *cost += 1;
  }
  return more;
}

// One block (VW = 1: one pixel) of a bin.
INLINE int draw_block(__global const float *view, __global const uint2 *pairs, int count, uint quarter,
                      __global const float *records, __global const uint *atlas, __global const uint *color_atlas,
                      __global const float4 *colors, __global const int *levels, __global float *planes, int was_touched,
                      int surface, float slack, VI lane_x, VI lane_y, int bin_x, int bin_y, int at) {
  VF px = TO_VF(lane_x) + (bin_x * BIN + 0.5f), py = TO_VF(lane_y) + (bin_y * BIN + 0.5f);
  VF before = EMPTY_DEPTH, infinite = INFINITY;
  if (was_touched) before = load_plane(planes, FIELD_DEPTH, at);
  // In front of `largest` nothing is drawn, nor behind `smallest`.
  VF low = view[NEAR], high = infinite, largest, smallest;
  clip_range(view, px, py, &low, &high);
  if (IS_PERSPECTIVE) {
    largest = SEL(infinite, 1.0f / low, low > 0.0f);
    smallest = SEL(infinite, 1.0f / high, high > 0.0f);
  } else { largest = -low; smallest = -high; }
  VF best = IS_PERSPECTIVE ? 0.0f : -infinite, first = 0.0f, facing = 0.0f;
  VF behind = IS_PERSPECTIVE ? 1.0f / (before + slack) : -(before + slack);
  VF rx = 0.0f, ry = 0.0f;
  if (IS_PERSPECTIVE) { rx = (px - view[CX]) * (1.0f / view[FX]); ry = (view[CY] - py) * (1.0f / view[FY]); }
  VF ray_x = view[0] * rx + view[3] * ry - view[6], ray_y = view[1] * rx + view[4] * ry - view[7];
  VF ray_z = view[2] * rx + view[5] * ry - view[8];
  VF whole = best;
  VI nearest = 0, whole_nearest = 0;
  int cost = 0;
  Blend sum;
  sum.weight = sum.depth = sum.x = sum.y = sum.z = sum.red = sum.green = sum.blue = 0.0f;
  sum.number = 0;
#if VW == 1
  int all = count;
  frontmost(pairs, &all, 1u << quarter, view[BUCKET_DEPTH], records, atlas, px, py, ray_x, ray_y, ray_z, smallest,
            largest, behind, &best, &first, &facing, &nearest, &whole, &whole_nearest, &cost);
#else
  uint2 kept[SEGMENT];
  int more = 1, n = 0;
  for (int from = 0; from < count && more; from += SEGMENT) {
    n = filtered(pairs + from, count - from < SEGMENT ? count - from : SEGMENT, quarter, kept);
    more = frontmost(kept, &n, 0u, view[BUCKET_DEPTH], records, atlas, px, py, ray_x, ray_y, ray_z, smallest, largest,
                     behind, &best, &first, &facing, &nearest, &whole, &whole_nearest, &cost);
  }
#endif
  VI through = (facing < 0.0f) & (whole > first);
  first = SEL(first, whole, through);
  facing = SEL(facing, (VF)(1.0f), through);
  nearest = SEL(nearest, whole_nearest, through);
  VI found = facing != 0.0f;
  if (was_touched && !any_lane(found)) return cost;
  if (!any_lane(found)) { store_plane(planes, FIELD_DEPTH, at, before); return cost; }
  VF hit = IS_PERSPECTIVE ? 1.0f / SEL((VF)(1.0f), first, found) : -first;
  float deepest = farthest(SEL(-infinite, hit, found)) + slack;
#if VW == 1
  blend(pairs, count, 1u << quarter, deepest, records, atlas, color_atlas, colors, px, py, hit, facing, &sum, &cost);
#else
  more = 1;
  for (int from = 0; from < count && more; from += SEGMENT) {
    if (count > SEGMENT) n = filtered(pairs + from, count - from < SEGMENT ? count - from : SEGMENT, quarter, kept);
    more = blend(kept, n, 0u, deepest, records, atlas, color_atlas, colors, px, py, hit, facing, &sum, &cost);
  }
#endif
  VF depth = sum.depth / sum.weight;
  VI closer = found & (sum.weight > 0.0f) & (depth < before);
  store_plane(planes, FIELD_DEPTH, at, SEL(before, depth, closer));
  if (!any_lane(closer)) return cost;
  // The normal in view space, on the side of the eye.
  VF nx = facing * (view[0] * sum.x + view[1] * sum.y + view[2] * sum.z);
  VF ny = facing * (view[3] * sum.x + view[4] * sum.y + view[5] * sum.z);
  VF nz = facing * (view[6] * sum.x + view[7] * sum.y + view[8] * sum.z);
  outward_at_rims(rx, ry, facing, &nx, &ny, &nz);
  // Finer normals may point away where the disc still faces the eye: they graze then.
  VF away = (nx * rx + ny * ry - nz) / (rx * rx + ry * ry + 1.0f);
  away = VMAX(away, (VF)(0.0f)) * 1.0001f;
  nx -= away * rx; ny -= away * ry; nz += away;
  merge_plane(planes, FIELD_NORMAL, at, nx, closer);
  merge_plane(planes, FIELD_NORMAL + 1, at, ny, closer);
  merge_plane(planes, FIELD_NORMAL + 2, at, nz, closer);
#if FIELD_COLOR >= 0
  VF inv = 1.0f / sum.weight;
  merge_plane(planes, FIELD_COLOR, at, sum.red * inv, closer);
  merge_plane(planes, FIELD_COLOR + 1, at, sum.green * inv, closer);
  merge_plane(planes, FIELD_COLOR + 2, at, sum.blue * inv, closer);
#endif
#if FIELD_ID >= 0
  merge_plane(planes, FIELD_ID, at, AS_VF((VI)(surface)), closer);
#endif
#if FIELD_COUNT >= 0
  merge_plane(planes, FIELD_COUNT, at, AS_VF(sum.number), closer);
#endif
#if FIELD_LEVEL >= 0
  VI level;
  for (int i = 0; i < VW; i++) ((int *)&level)[i] = levels[((int *)&nearest)[i]];
  merge_plane(planes, FIELD_LEVEL, at, AS_VF(level), closer);
#endif
  merge_no_differentials(planes, at, closer);
  return cost;
}

__kernel void tile_surfels(__global const float *view, __global const uint2 *pairs, __global const uint *offsets,
                           __global const float *records, __global const uint *atlas, __global const uint *color_atlas,
                           __global const float4 *colors, __global const int *levels, int surface,
                           float slack /* discs are blended that lie less apart in depth, and a bucket */, int tiles_x,
                           int tile_count, int bins_x, int bins_y,
                           __global int *touched /* pixel evaluations so far, -1: none */,
                           __global float *tile_planes) {
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
    int mine = draw_block(view, pairs + begin, count, quarter, records, atlas, color_atlas, colors, levels, planes,
                          was_touched, surface, slack, LANE_X(pixel), LANE_Y(pixel), bin_x, bin_y, pixel);
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
      cost += draw_block(view, pairs + begin, count, (uint)quarter, records, atlas, color_atlas, colors, levels, planes,
                         was_touched, surface, slack, qx + LANE_X(0), qy + LANE_Y(0), bin_x, bin_y, qy * BIN + qx);
    }
    touched[bin] = (was_touched ? touched[bin] : 0) + cost * VW;
#endif
  }
}
