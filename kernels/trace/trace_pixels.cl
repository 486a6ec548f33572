// Primary rays with blending: for every bin of 8x8 pixels the depth and attribute planes, as tile_slim writes them.
//
// The visibility is that of kernels/render/tile_slim.cl: the frontmost hit of the shrunken balls, then all surfels
// whose ball holds that point, and, where those weigh too little, a look behind it. The first is a walk of the tree
// with the packet, front to back, the second a walk with the hits' own box.
// VW = 16: a work-item per TILE_BINS^2 bins; VW = 1: one per pixel. Twin: tests/reference/trace.py, trace_pixels.
#include "trace/packet.clh"
#include "common/bins.clh"
#include "common/planes.clh"
#include "common/view.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif

typedef struct { VF depth, weight, fx, fy, ft, red, green, blue, facing; VI number, slot; } Blend;
typedef struct { VF px, py, low, z, hit, facing; VI slot; } Ray;

// Pass 1: depth of every active ray's frontmost hit behind `low` and in front of `z`, and its side.
INLINE void frontmost(__global const float *boxes, int roots, int first_bottom, __global const float *surfels,
                      __global const float *tails, const Packet *packet, const BlockBounds *bounds, float near, Ray *ray,
                      int *cost) {
  Sieve sieve;
  Waiting waiting;
  set_sieve(packet, &sieve);
  start_walk(&waiting);
  float far = INFINITY, block_far[BLOCKS];
  for (int b = 0; b < BLOCKS; b++) block_far[b] = largest_lane(ray[b].z);
  while (waiting.count > 0) {
    far = -INFINITY;
    for (int b = 0; b < BLOCKS; b++) far = VMAX(far, block_far[b]);
    uint slots = 0;
    int node = next_bottom(boxes, roots, first_bottom, &sieve, near, far, &waiting, &slots);
    if (node < 0) continue;
    int slot = first_slot(node, first_bottom);
    for (int part = 0; part < WIDE; part += VW) {
      if (VW == 1 && !(slots >> part & 1u)) continue;
      Projected projected;
      Piece piece;
      project_surfels(surfels + (size_t)slot * SURFEL_FLOATS, part, packet, &projected, &piece);
      uint enters = mask_of(piece.enters), leaves = mask_of(piece.leaves);
      for (int b = 0; b < BLOCKS; b++) {
        uint bits = pieces_in_block(&piece, bounds, b, near, block_far[b]) & slots >> part;
        if (!bits) continue;
        Ray own_ray = ray[b];
        while (bits) {
          int j = lowest_bit(bits);
          bits &= bits - 1;
          const float *own = (const float *)projected.field + j;
          __global const float *k = tails + (size_t)(slot + part + j) * TAIL_FLOATS - K0;
          VF u, v, w, du, dv, dw, t;
          place_ray(own, own_ray.px, own_ray.py, &u, &v, &w, &du, &dv, &dw);
          RayPoly p = ray_poly(k, u, v, w, du, dv, dw);
          if (enters >> j & 1u) {
            VI good = piece_root(k, own, p, 1.0f, u, v, w, du, dv, dw, &t);
            good = good & (t > own_ray.low) & (t < own_ray.z);
            own_ray.z = SEL(own_ray.z, t, good);
            own_ray.hit = SEL(own_ray.hit, t, good);
            own_ray.facing = SEL(own_ray.facing, (VF)(1.0f), good);
#if FIELD_SLOT >= 0
            own_ray.slot = SEL(own_ray.slot, (VI)(slot + part + j), good);
#endif
          }
          if (leaves >> j & 1u) {
            VI good = piece_root(k, own, p, -1.0f, u, v, w, du, dv, dw, &t);
            VF key = ORIENTED ? t + BACK_BIAS * OWN(OWN_RADIUS) : t;
            good = good & (t > own_ray.low) & (key < own_ray.z);
            own_ray.z = SEL(own_ray.z, key, good);
            own_ray.hit = SEL(own_ray.hit, t, good);
            own_ray.facing = SEL(own_ray.facing, (VF)(-1.0f), good);
#if FIELD_SLOT >= 0
            own_ray.slot = SEL(own_ray.slot, (VI)(slot + part + j), good);
#endif
          }
          *cost += 1;
        }
        ray[b] = own_ray;
        block_far[b] = largest_lane(own_ray.z);
      }
    }
  }
}

// The surfels of a bottom node whose balls reach into a box (of hits, in the packet's axes).
INLINE uint balls_in_box(__global const float *surfels, int part, const Packet *p, const float *box) {
  __global const VF *plane = (__global const VF *)(surfels + part);
  const float *t = p->turn;
  VF x = SURFEL(CENTER), y = SURFEL(CENTER + 1), z = SURFEL(CENTER + 2), r = p->scale * SURFEL(BALL_RADIUS), sum = 0.0f;
  for (int a = 0; a < 3; a++) {
    VF at = p->scale * (t[3 * a] * x + t[3 * a + 1] * y + t[3 * a + 2] * z) + p->zero[a];
    VF over = VMAX(VMAX(box[a] - at, at - box[3 + a]), (VF)(0.0f));
    sum += over * over;
  }
  return mask_of((sum <= r * r * 1.0001f) & (SURFEL(LOW) <= SURFEL(HIGH)));
}

// Pass 2: add the surfels whose ball holds the rays' hits (depth INFINITY: none).
INLINE void blend(__global const float *balls, int roots, int first_bottom, __global const float *surfels,
                  __global const float *tails, __global const float4 *colors, const Packet *packet, const Ray *ray,
                  Blend *sum, int *cost) {
  Sieve sieve;
  Waiting waiting;
  Packet own_packet = *packet;
  BlockBounds bounds;
  float box[BLOCKS][6], near = INFINITY, far = -INFINITY, none = 1e30f;
  int use = 0;
  for (int b = 0; b < BLOCKS; b++) {
    VF t = ray[b].hit;
    VI is = t < INFINITY;
    VF X = packet->perspective ? ray[b].px * t : ray[b].px, Y = packet->perspective ? ray[b].py * t : ray[b].py;
    box[b][0] = least_lane(SEL((VF)(none), X, is)); box[b][3] = largest_lane(SEL((VF)(-none), X, is));
    box[b][1] = least_lane(SEL((VF)(none), Y, is)); box[b][4] = largest_lane(SEL((VF)(-none), Y, is));
    box[b][2] = least_lane(SEL((VF)(none), t, is)); box[b][5] = largest_lane(SEL((VF)(-none), t, is));
    use |= bound_block(ray[b].px, ray[b].py, is, b, &bounds);
    near = VMIN(near, box[b][2]); far = VMAX(far, box[b][5]);
  }
  if (!use) return;
  bound_packet(&bounds, &own_packet);
  set_sieve(&own_packet, &sieve);
  float slack = 1e-6f * (far - near + VMAX(far, -far));
  near -= slack; far += slack;
  start_walk(&waiting);
  while (waiting.count > 0) {
    uint slots = 0;
    int node = next_bottom(balls, roots, first_bottom, &sieve, near, far, &waiting, &slots);
    if (node < 0) continue;
    int slot = first_slot(node, first_bottom);
    __global const float *own_surfels = surfels + (size_t)slot * SURFEL_FLOATS;
    for (int part = 0; part < WIDE; part += VW) {
      if (VW == 1 && !(slots >> part & 1u)) continue;
      uint held[BLOCKS], any = 0;
      for (int b = 0; b < BLOCKS; b++) any |= held[b] = balls_in_box(own_surfels, part, packet, box[b]);
      if (!any) continue;
      Projected projected;
      project_surfels(own_surfels, part, packet, &projected, 0);
      for (int b = 0; b < BLOCKS; b++) {
        uint bits = held[b];
        if (!bits) continue;
        VF px = ray[b].px, py = ray[b].py, hit = ray[b].hit, facing = ray[b].facing;
        Blend s = sum[b];
        while (bits) {
          int j = lowest_bit(bits);
          bits &= bits - 1;
          const float *own = (const float *)projected.field + j;
          VF u, v, w, du, dv, dw, step, slope;
          place_ray(own, px, py, &u, &v, &w, &du, &dv, &dw);
          VF on = hit - OWN(T_REF);
          u += on * du; v += on * dv; w += on * dw;
          VI inside = u * u + v * v + w * w < 1.0f;
          if (!any_lane(inside)) continue;
          __global const float *k = tails + (size_t)(slot + part + j) * TAIL_FLOATS - K0;
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
          VF tilt = weight * side * OWN(OWN_SPREAD);
          s.weight += weight;
          s.depth += weight * step;
          s.fx += tilt * (OWN(WX) - gu * OWN(UX) - gv * OWN(VX));
          s.fy += tilt * (OWN(WY) - gu * OWN(UY) - gv * OWN(VY));
          s.ft -= weight * OWN(OWN_RADIUS) * SEL((VF)(0.0f), slope, inside);
#if HAS_COLOR
          float4 color = colors[slot + part + j];
          s.red += weight * color.x; s.green += weight * color.y; s.blue += weight * color.z;
#endif
#if FIELD_COUNT >= 0
          s.number += SEL((VI)(0), (VI)(1), inside);
#endif
          *cost += 1;
        }
        sum[b] = s;
      }
    }
  }
}

// One bin (VW = 1: one pixel). Returns the surfel evaluations, -1 where a whole bin shows nothing of this surface.
INLINE int trace_bin(__global const float *view, __global const float *boxes, __global const float *balls, int roots,
                     int first_bottom, __global const float *surfels, __global const float *tails,
                     __global const float4 *colors, int surface, int bin_x, int bin_y, int pixel, int was_touched,
                     __global float *planes) {
  Packet packet;
  BlockBounds bounds;
  Ray ray[BLOCKS];
  Blend best[BLOCKS];
  VF before[BLOCKS];
  VI active[BLOCKS], any_hit[BLOCKS];
  int cost = 0, at[BLOCKS];
  packet.perspective = view[PERSPECTIVE] > 0.0f;
  packet.scale = view[SCALE];
  for (int i = 0; i < 9; i++) packet.turn[i] = i < 6 ? view[ROTATION + i] : -view[ROTATION + i];
  packet.zero[0] = view[OFFSET]; packet.zero[1] = view[OFFSET + 1]; packet.zero[2] = -view[OFFSET + 2];
  float inv_fx = 1.0f / view[FX], inv_fy = 1.0f / view[FY], near = view[NEAR];
  for (int b = 0; b < BLOCKS; b++) {
#if VW == 1
    int x = pixel & 7, y = pixel >> 3;
    at[b] = pixel;
#else
    VI x = (LANE_INDEX & 3) + (b & 1) * 4, y = (LANE_INDEX >> 2) + (b >> 1) * 4;
    at[b] = (b >> 1) * 4 * BIN + (b & 1) * 4;
#endif
    ray[b].px = (TO_VF(x) + (bin_x * BIN + 0.5f) - view[CX]) * inv_fx;
    ray[b].py = (view[CY] - (TO_VF(y) + (bin_y * BIN + 0.5f))) * inv_fy;
    ray[b].low = near;
    before[b] = EMPTY_DEPTH;
    if (was_touched) before[b] = load_plane(planes, FIELD_DEPTH, at[b]);
    active[b] = TRUE_LANES; any_hit[b] = 0;
    best[b].depth = INFINITY;
    best[b].weight = best[b].fx = best[b].fy = best[b].ft = best[b].facing = 1.0f;
    best[b].red = best[b].green = best[b].blue = 1.0f;
    best[b].number = best[b].slot = 0;
  }
  int going = 1;
  for (int attempt = 0; attempt < TRIES; attempt++) {
    if (!going) continue;
    float least_low = INFINITY;
    for (int b = 0; b < BLOCKS; b++) {
      bound_block(ray[b].px, ray[b].py, active[b], b, &bounds);
      ray[b].z = SEL((VF)(-INFINITY), before[b], active[b]);
      ray[b].hit = INFINITY; ray[b].facing = 0.0f; ray[b].slot = 0;
      least_low = VMIN(least_low, least_lane(ray[b].low));
    }
    bound_packet(&bounds, &packet);
    frontmost(boxes, roots, first_bottom, surfels, tails, &packet, &bounds, least_low, ray, &cost);
    Blend sum[BLOCKS];
    int any = 0;
    for (int b = 0; b < BLOCKS; b++) {
      any |= any_lane(ray[b].hit < INFINITY);
      sum[b].depth = sum[b].weight = sum[b].fx = sum[b].fy = sum[b].ft = sum[b].red = sum[b].green = sum[b].blue = 0.0f;
      sum[b].number = 0;
    }
    going = 0;
    if (!any) continue;
    blend(balls, roots, first_bottom, surfels, tails, colors, &packet, ray, sum, &cost);
    for (int b = 0; b < BLOCKS; b++) {
      VI found = (ray[b].hit < INFINITY) & (sum[b].weight > 0.0f);
      sum[b].depth = ray[b].hit + sum[b].depth / sum[b].weight;
#define KEEP(x) best[b].x = SEL(best[b].x, sum[b].x, found)
      KEEP(depth); KEEP(weight); KEEP(fx); KEEP(fy); KEEP(ft); KEEP(number);
      best[b].facing = SEL(best[b].facing, ray[b].facing, found);
#if FIELD_SLOT >= 0
      best[b].slot = SEL(best[b].slot, ray[b].slot, found);
#endif
#if HAS_COLOR
      KEEP(red); KEEP(green); KEEP(blue);
#endif
      any_hit[b] = any_hit[b] | found;
      active[b] = found & (sum[b].weight < SUPPORT);
      ray[b].low = SEL(ray[b].low, ray[b].hit, active[b]);
      going |= any_lane(active[b]);
    }
  }
  int hits = 0;
  for (int b = 0; b < BLOCKS; b++) hits |= any_lane(any_hit[b]);
  if (VW > 1 && !hits) return -1;
  for (int b = 0; b < BLOCKS; b++) {
    VI closer = any_hit[b] & (best[b].depth < before[b]);
    if (was_touched && !any_lane(closer)) continue;
    store_plane(planes, FIELD_DEPTH, at[b], SEL(before[b], best[b].depth, closer));
    if (!any_lane(closer)) continue;
    VF gx = best[b].fx, gy = best[b].fy;
    VF gz = packet.perspective ? gx * ray[b].px + gy * ray[b].py - best[b].ft : -best[b].ft;
#if ORIENTED
    VF upright = 0.0f;
    outward_at_rims(packet.perspective ? ray[b].px : upright, packet.perspective ? ray[b].py : upright, best[b].facing,
                    &gx, &gy, &gz);
#endif
    merge_plane(planes, FIELD_NORMAL, at[b], gx, closer);
    merge_plane(planes, FIELD_NORMAL + 1, at[b], gy, closer);
    merge_plane(planes, FIELD_NORMAL + 2, at[b], gz, closer);
#if FIELD_COLOR >= 0
    VF inv = 1.0f / best[b].weight;
    merge_plane(planes, FIELD_COLOR, at[b], best[b].red * inv, closer);
    merge_plane(planes, FIELD_COLOR + 1, at[b], best[b].green * inv, closer);
    merge_plane(planes, FIELD_COLOR + 2, at[b], best[b].blue * inv, closer);
#endif
#if FIELD_ID >= 0
    merge_plane(planes, FIELD_ID, at[b], AS_VF((VI)(surface)), closer);
#endif
#if FIELD_SLOT >= 0
    merge_plane(planes, FIELD_SLOT, at[b], AS_VF(best[b].slot), closer);
#endif
#if FIELD_COUNT >= 0
    merge_plane(planes, FIELD_COUNT, at[b], AS_VF(best[b].number), closer);
#endif
  }
  return cost;
}

__kernel void trace_pixels(__global const float *view, __global const float *boxes, __global const float *balls, int roots,
                           int first_bottom, __global const float *surfels, __global const float *tails,
                           __global const float4 *colors, int surface, int bins_x, int bins_y,
                           __global int *touched, __global float *all_planes) {
#if VW == 1
  int bin = get_group_id(0), pixel = get_local_id(0);
  if (bin >= bins_x * bins_y) return;
  int was_touched = touched[bin] >= 0;
  trace_bin(view, boxes, balls, roots, first_bottom, surfels, tails, colors, surface, bin % bins_x, bin / bins_x, pixel,
            was_touched, all_planes + (size_t)bin * BIN_PIXELS * FIELDS);
  barrier(CLK_GLOBAL_MEM_FENCE);
  if (pixel == 0 && !was_touched) touched[bin] = 0;
#else
  int tiles_x = (bins_x + TILE_BINS - 1) / TILE_BINS, tile = get_global_id(0);
  int x0 = tile % tiles_x * TILE_BINS, y0 = tile / tiles_x * TILE_BINS;
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) {
    int bin_x = x0 + i % TILE_BINS, bin_y = y0 + i / TILE_BINS;
    if (bin_x >= bins_x || bin_y >= bins_y) continue;
    int bin = bin_y * bins_x + bin_x, before = touched[bin];
    int cost = trace_bin(view, boxes, balls, roots, first_bottom, surfels, tails, colors, surface, bin_x, bin_y, 0,
                         before >= 0, all_planes + (size_t)bin * BIN_PIXELS * FIELDS);
    if (cost >= 0) touched[bin] = (before >= 0 ? before : 0) + cost * VW;
  }
#endif
}
