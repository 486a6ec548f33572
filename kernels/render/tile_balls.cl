// Draw the surfels' balls of every bin into its planes: the paper's figures 1 and 7. The same forms as tile_slim.
// Twin: tests/reference/render.py, tile_balls.
#include "common/slim.clh"
#include "common/planes.clh"
#include "common/view.clh"
#include "common/clip.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif

INLINE void draw_balls(__global const float *view, __global const uint2 *pairs, int count, uint quarter,
                       __global const float *records, __global const float4 *colors, __global const int *levels,
                       __global float *planes, int was_touched, int surface, VI lane_x, VI lane_y, int bin_x, int bin_y,
                       int at) {
  VF px = TO_VF(lane_x) + (bin_x * BIN + 0.5f), py = TO_VF(lane_y) + (bin_y * BIN + 0.5f);
  VF before = EMPTY_DEPTH, fx = 0.0f, fy = 0.0f, ft = -1.0f;
  if (was_touched) before = load_plane(planes, FIELD_DEPTH, at);
  VF z = before, red = 0.0f, green = 0.0f, blue = 0.0f;
  VI nearest = 0;
  VF low = view[NEAR], high = INFINITY;
  clip_range(view, px, py, &low, &high);
  for (int e = 0; e < count; e++) {
    uint2 pair = pairs[e];
    if (!(pair.y >> quarter & 1u) || !any_lane(near_of_key(pair.y) < z)) continue;
    __global const float *k = records + (size_t)INDEX_OF(pair) * RECORD_FLOATS;
    VF x = px - k[XR], y = py - k[YR];
    VF u = k[U0] + k[UX] * x + k[UY] * y, v = k[V0] + k[VX] * x + k[VY] * y, w = k[W0] + k[WX] * x + k[WY] * y;
    VF du = k[DU] + k[INV_T] * u, dv = k[DV] + k[INV_T] * v, dw = k[DW] + k[INV_T] * w;
    VF a = du * du + dv * dv + dw * dw, b = u * du + v * dv + w * dw, c = u * u + v * v + w * w - 1.0f;
    VF disc = b * b - a * c;
    VF root = VSQRT(VMAX(disc, (VF)(0.0f)));
    VF s = (-b - root) / a, t = k[T_REF] + s;
    VF turn = 1.0f;
#if CLIP_PLANES
    VI inner = t <= low;  // the ball is cut open: its far side is seen from within
    s = SEL(s, (root - b) / a, inner);
    t = k[T_REF] + s;
    turn = SEL((VF)(1.0f), (VF)(-1.0f), inner);
#endif
    VI good = (disc >= 0.0f) & (t > low) & (t < high) & (t < z);
    z = SEL(z, t, good);
    u += s * du; v += s * dv; w += s * dw;
    fx = SEL(fx, turn * k[RADIUS_PX] * (u * k[UX] + v * k[VX] + w * k[WX]), good);
    fy = SEL(fy, turn * k[RADIUS_PX] * (u * k[UY] + v * k[VY] + w * k[WY]), good);
    ft = SEL(ft, -root * k[RADIUS], good);
    float4 color = colors[INDEX_OF(pair)];
    red = SEL(red, (VF)(color.x), good); green = SEL(green, (VF)(color.y), good);
    blue = SEL(blue, (VF)(color.z), good);
    nearest = SEL(nearest, (VI)((int)INDEX_OF(pair)), good);
  }
  VI closer = z < before;
  store_plane(planes, FIELD_DEPTH, at, z);
  if (!any_lane(closer)) return;
  VF gx = fx * view[FX], gy = -fy * view[FY], gz = -ft;
  if (view[PERSPECTIVE] > 0.0f)
    gz = gx * ((px - view[CX]) / view[FX]) + gy * ((view[CY] - py) / view[FY]) - ft;
  merge_plane(planes, FIELD_NORMAL, at, gx, closer);
  merge_plane(planes, FIELD_NORMAL + 1, at, gy, closer);
  merge_plane(planes, FIELD_NORMAL + 2, at, gz, closer);
#if FIELD_COLOR >= 0
  merge_plane(planes, FIELD_COLOR, at, red, closer);
  merge_plane(planes, FIELD_COLOR + 1, at, green, closer);
  merge_plane(planes, FIELD_COLOR + 2, at, blue, closer);
#endif
#if FIELD_ID >= 0
  merge_plane(planes, FIELD_ID, at, AS_VF((VI)(surface)), closer);
#endif
#if FIELD_COUNT >= 0
  merge_plane(planes, FIELD_COUNT, at, AS_VF((VI)(1)), closer);
#endif
#if FIELD_LEVEL >= 0
  VI level;
  for (int i = 0; i < VW; i++) ((int *)&level)[i] = levels[((int *)&nearest)[i]];
  merge_plane(planes, FIELD_LEVEL, at, AS_VF(level), closer);
#endif
}

__kernel void tile_balls(__global const float *view, __global const uint2 *pairs, __global const uint *offsets,
                         __global const float *records, __global const float4 *colors, __global const int *levels,
                         int surface, int tiles_x, int tile_count, int bins_x, int bins_y,
                         __global int *touched, __global float *tile_planes) {
#if VW == 1
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
    draw_balls(view, pairs + begin, count, quarter, records, colors, levels, planes, was_touched, surface, pixel & 7,
               pixel >> 3, bin_x, bin_y, pixel);
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (pixel == 0) touched[bin] = (was_touched ? touched[bin] : 0) + count * BIN_PIXELS;
#else
    for (int b = 0; b < 64 / VW; b++) {
      int quarter = b / (16 / VW), part = b % (16 / VW);
      int qx = (quarter & 1) * 4, qy = (quarter >> 1) * 4 + part * (VW / 4);
      draw_balls(view, pairs + begin, count, (uint)quarter, records, colors, levels, planes, was_touched, surface,
                 qx + (LANE_INDEX & 3), qy + (LANE_INDEX >> 2), bin_x, bin_y, qy * BIN + qx);
    }
    touched[bin] = (was_touched ? touched[bin] : 0) + count * BIN_PIXELS;
#endif
  }
}
