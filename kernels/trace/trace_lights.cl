// Hard shadows: which lamps the points of a picture do not see because of one surface; a bit per lamp in a mask.
//
// Rays run from the lamp to the point. Hits from behind count wherever they are in front of the point by OFFSET radii
// of the surfel, so that a point never shadows itself; hits from the front only farther than FRONT_OFFSET radii away:
// they let open surfaces throw shadows. Points that face away from a lamp are not traced.
// VW = 16: a work-item per TILE_BINS^2 bins, packets of 8x8 points; VW = 1: one point each.
// Twin: tests/reference/trace.py, trace_lights.
#ifndef PACKET_X
#define PACKET_X 2  // bins of a packet, across and down; 1 x 1: 76, 2 x 1: 85, 2 x 2: 93, 4 x 2: 90, 4 x 4: 82 Mrays/s of
#define PACKET_Y 2  // ambient occlusion
#endif
#define PACKET_BINS (PACKET_X * PACKET_Y)
#include "trace/packet.clh"
#include "common/bins.clh"
#include "common/planes.clh"
#include "common/view.clh"

// A lamp: 8 floats, as in the shading buffer of kernels/render/shade.clh; places and directions in view space.
enum { LIGHT_KIND, LIGHT_X, LIGHT_Y, LIGHT_Z, LIGHT_FLOATS = 8 };
enum { HEADLIGHT, DIRECTIONAL, POINT };

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#ifndef OFFSET_RADII
#define OFFSET_RADII (ORIENTED ? 0.25f : 1.0f)  // where sides mean nothing, a point's own surfels are hit from behind too
#endif
#ifndef GRAZING_RADII
#define GRAZING_RADII 0.04f  // error of a surfel's height: at the angle whose cosine is c it shifts a hit by this over c
#endif
#ifndef FRONT_RADII
#define FRONT_RADII 1.0f
#endif
#define LARGEST_OFFSET 2.0f
#ifndef RIM_COSINE
#define RIM_COSINE 0.2f   // of normal and eye: below it the eye may see a surface from behind, past its rim
#endif
#define RIM_OFFSET 1.0f

// Points to be reached: in view space, then along the packet's rays (x, y) at depth t.
typedef struct {
  VF X, Y, Z, x, y, t;
  VF offset;  // radii before the point within which hits from behind do not count
} Target;

// Set `lost` where something lies on the way to the targets `want`, not more than `reach` before them.
INLINE void occlude(__global const float *boxes, int roots, int first_bottom, __global const float *surfels,
                    __global const float *tails, Packet *packet, const Target *target, float reach, const VI *want,
                    VI *lost) {
  Sieve sieve;
  Waiting waiting;
  BlockBounds bounds;
  float near = INFINITY, block_far[BLOCKS];
  for (int b = 0; b < BLOCKS; b++) {
    block_far[b] = -INFINITY;
    bounds.least_x[b] = bounds.least_y[b] = 1e30f; bounds.largest_x[b] = bounds.largest_y[b] = -1e30f;
    if (!any_lane(want[b])) continue;
    bound_block(target[b].x, target[b].y, want[b], b, &bounds);
    block_far[b] = largest_lane(SEL((VF)(-INFINITY), target[b].t, want[b]));
    near = VMIN(near, least_lane(SEL((VF)(INFINITY), target[b].t, want[b])));
  }
  near -= reach;
  near = packet->perspective ? VMAX(near, 0.0f) : near;
  bound_packet(&bounds, packet);
  set_sieve(packet, &sieve);
  start_walk(&waiting);
  while (waiting.count > 0) {
    float far = -INFINITY;
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
      // What reaches no further from the lamp than the offsets, the points' own surfels above all, cannot hide them.
      VF r = projected.field[OWN_RADIUS];
      VI within = (piece.least_x <= packet->largest_x) & (piece.largest_x >= packet->least_x)
                & (piece.least_y <= packet->largest_y) & (piece.largest_y >= packet->least_y);
      uint enters = mask_of(within & piece.enters & (piece.near < far - (FRONT_RADII + OFFSET_RADII) * r));
      uint leaves = mask_of(within & piece.leaves & (piece.near < far - OFFSET_RADII * r));
      if (!(enters | leaves)) continue;
      for (int b = 0; b < BLOCKS; b++) {
        if (block_far[b] == -INFINITY) continue;
        uint bits = pieces_in_block(&piece, &bounds, b, near, block_far[b]) & slots >> part & (enters | leaves);
        if (!bits) continue;
        VF px = target[b].x, py = target[b].y, end = target[b].t, offset = target[b].offset;
        VI hit = lost[b];
        while (bits) {
          int j = lowest_bit(bits);
          bits &= bits - 1;
          const float *own = (const float *)projected.field + j;
          __global const float *k = tails + (size_t)(slot + part + j) * TAIL_FLOATS - K0;
          VF u, v, w, du, dv, dw, t;
          float radius = OWN(OWN_RADIUS);
          place_ray(own, px, py, &u, &v, &w, &du, &dv, &dw);
          RayPoly p = ray_poly(k, u, v, w, du, dv, dw);
          if (leaves >> j & 1u) {
            VI good = piece_root(k, own, p, -1.0f, u, v, w, du, dv, dw, &t);
            hit = hit | (good & (t < end - offset * radius) & (t > end - reach) & (t > near));
          }
          if (enters >> j & 1u) {
            VI good = piece_root(k, own, p, 1.0f, u, v, w, du, dv, dw, &t);
            hit = hit | (good & (t < end - (FRONT_RADII + offset) * radius) & (t > end - reach) & (t > near));
          }
        }
        lost[b] = hit;
        VI open = want[b] & NOT(hit);
        if (!any_lane(open)) {
          block_far[b] = -INFINITY;
          bounds.least_x[b] = 1e30f;
        }
      }
    }
    int left = 0;
    for (int b = 0; b < BLOCKS; b++) left |= block_far[b] > -INFINITY;
    if (!left) waiting.count = 0;
  }
}

// Axes of a packet that looks along the unit vector f (view axes), seen by the occluder placed by `view`.
INLINE void aim(__global const float *view, float fx, float fy, float fz, float ox, float oy, float oz, int perspective,
                float *axes, Packet *packet) {
  float sign = fz < 0.0f ? -1.0f : 1.0f, a = -1.0f / (sign + fz), b = fx * fy * a;
  axes[0] = 1.0f + sign * fx * fx * a; axes[1] = sign * b; axes[2] = -sign * fx;
  axes[3] = b; axes[4] = sign + fy * fy * a; axes[5] = -fy;
  axes[6] = fx; axes[7] = fy; axes[8] = fz;
  packet->perspective = perspective;
  packet->scale = view[SCALE];
  float x = view[OFFSET] - ox, y = view[OFFSET + 1] - oy, z = view[OFFSET + 2] - oz;
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++)
      packet->turn[3 * i + j] = axes[3 * i] * view[ROTATION + j] + axes[3 * i + 1] * view[ROTATION + 3 + j]
                                + axes[3 * i + 2] * view[ROTATION + 6 + j];
    packet->zero[i] = axes[3 * i] * x + axes[3 * i + 1] * y + axes[3 * i + 2] * z;
  }
}

INLINE float sum_of_lanes(VF v) {
  float sum = 0.0f;
  for (int i = 0; i < VW; i++) sum += ((float *)&v)[i];
  return sum;
}

// The targets' rays from a lamp that shines along one direction, (lx, ly, lz) toward it.
INLINE void aim_directional(__global const float *view, float lx, float ly, float lz, Target *target, Packet *packet) {
  float axes[9];
  aim(view, -lx, -ly, -lz, 0.0f, 0.0f, 0.0f, 0, axes, packet);
  for (int b = 0; b < BLOCKS; b++) {
    target[b].x = axes[0] * target[b].X + axes[1] * target[b].Y + axes[2] * target[b].Z;
    target[b].y = axes[3] * target[b].X + axes[4] * target[b].Y + axes[5] * target[b].Z;
    target[b].t = axes[6] * target[b].X + axes[7] * target[b].Y + axes[8] * target[b].Z;
  }
}

// The rays from a lamp at (lx, ly, lz) to the targets `want`. Those too far from the packet's middle are left for
// another packet: they are cleared in `want` and set in `later`.
INLINE void aim_point(__global const float *view, float lx, float ly, float lz, Target *target, VI *want, VI *later,
                      Packet *packet) {
  float mx = 0.0f, my = 0.0f, mz = 0.0f;
  for (int b = 0; b < BLOCKS; b++) {
    VF x = target[b].X - lx, y = target[b].Y - ly, z = target[b].Z - lz, zero = 0.0f;
    VF inv = 1.0f / VSQRT(x * x + y * y + z * z + 1e-30f);
    mx += sum_of_lanes(SEL(zero, x * inv, want[b]));
    my += sum_of_lanes(SEL(zero, y * inv, want[b]));
    mz += sum_of_lanes(SEL(zero, z * inv, want[b]));
  }
  float m2 = mx * mx + my * my + mz * mz;
  if (m2 < 1e-6f) {  // all around the lamp: toward the first target
    for (int b = BLOCKS - 1; b >= 0; b--)
      for (int i = VW - 1; i >= 0; i--)
        if (((int *)&want[b])[i]) {
          mx = ((float *)&target[b].X)[i] - lx; my = ((float *)&target[b].Y)[i] - ly;
          mz = ((float *)&target[b].Z)[i] - lz;
        }
    m2 = mx * mx + my * my + mz * mz + 1e-30f;
  }
  float inv = 1.0f / sqrt(m2), axes[9];
  aim(view, mx * inv, my * inv, mz * inv, lx, ly, lz, 1, axes, packet);
  for (int b = 0; b < BLOCKS; b++) {
    VF x = target[b].X - lx, y = target[b].Y - ly, z = target[b].Z - lz;
    VF t = axes[6] * x + axes[7] * y + axes[8] * z;
    VI wide = want[b] & (t * t < 0.1f * (x * x + y * y + z * z) | t <= 0.0f);
    later[b] = wide;
    want[b] = want[b] & NOT(wide);
    VF safe = 1.0f / SEL((VF)(1.0f), t, want[b]);
    target[b].t = t;
    target[b].x = (axes[0] * x + axes[1] * y + axes[2] * z) * safe;
    target[b].y = (axes[3] * x + axes[4] * y + axes[5] * z) * safe;
  }
}

// The packets of PACKET_X x PACKET_Y bins from (bin_x, bin_y) on (VW = 1: one pixel of a bin).
INLINE void shadow_bins(__global const float *view, __global const float *boxes, int roots, int first_bottom,
                        __global const float *surfels, __global const float *tails, __global const float *lamps,
                        int lamp_count, float reach, int fresh, int bin_x, int bin_y, int pixel, int bins_x, int bins_y,
                        __global const int *touched, __global const float *all_planes, __global uint *mask,
                        int mask_stride) {
  Target target[BLOCKS];
  VF nx[BLOCKS], ny[BLOCKS], nz[BLOCKS];
  VF rim[BLOCKS];
  VI seen[BLOCKS], found[BLOCKS];
  int at[BLOCKS], bins[BLOCKS], any = 0;
  float inv_fx = 1.0f / view[FX], inv_fy = 1.0f / view[FY];
  for (int b = 0; b < BLOCKS; b++) {
    int own_x = bin_x + b / BIN_BLOCKS % PACKET_X, own_y = bin_y + b / BIN_BLOCKS / PACKET_X;
    int inside = own_x < bins_x && own_y < bins_y;
    bins[b] = inside ? own_y * bins_x + own_x : 0;
    if (inside && touched[bins[b]] < 0) inside = 0;
    if (!inside) bins[b] = -1;
    seen[b] = 0; found[b] = 0;
    if (!inside) continue;
    __global const float *planes = all_planes + (size_t)bins[b] * BIN_PIXELS * FIELDS;
#if VW == 1
    int x = pixel & 7, y = pixel >> 3;
    at[b] = pixel;
#else
    VI x = (LANE_INDEX & 3) + (b & 1) * 4, y = (LANE_INDEX >> 2) + (b >> 1 & 1) * 4;
    at[b] = (b >> 1 & 1) * 4 * BIN + (b & 1) * 4;
#endif
    VF depth = load_plane(planes, FIELD_DEPTH, at[b]);
    seen[b] = depth < EMPTY_DEPTH;
    VF t = SEL((VF)(1.0f), depth, seen[b]), across = view[PERSPECTIVE] > 0.0f ? t : (VF)(1.0f);
    target[b].X = (TO_VF(x) + (own_x * BIN + 0.5f) - view[CX]) * inv_fx * across;
    target[b].Y = (view[CY] - (TO_VF(y) + (own_y * BIN + 0.5f))) * inv_fy * across;
    target[b].Z = -t;
    nx[b] = load_plane(planes, FIELD_NORMAL, at[b]);
    ny[b] = load_plane(planes, FIELD_NORMAL + 1, at[b]);
    nz[b] = load_plane(planes, FIELD_NORMAL + 2, at[b]);
    VF inv = 1.0f / VSQRT(nx[b] * nx[b] + ny[b] * ny[b] + nz[b] * nz[b] + 1e-30f);
    nx[b] *= inv; ny[b] *= inv; nz[b] *= inv;
    VF facing = nz[b], sight = 1.0f;
    if (view[PERSPECTIVE] > 0.0f) {
      facing = -(nx[b] * target[b].X + ny[b] * target[b].Y + nz[b] * target[b].Z);
      sight = target[b].X * target[b].X + target[b].Y * target[b].Y + target[b].Z * target[b].Z;
    }
    rim[b] = SEL((VF)(OFFSET_RADII), (VF)(RIM_OFFSET), facing * facing < RIM_COSINE * RIM_COSINE * sight);
    if (!fresh) found[b] = AS_VI(load_plane((__global const float *)(mask + (size_t)bins[b] * mask_stride), 0, at[b]));
    any |= any_lane(seen[b]);
  }
  for (int l = 0; l < lamp_count && any; l++) {
    __global const float *lamp = lamps + l * LIGHT_FLOATS;
    int kind = (int)lamp[LIGHT_KIND];
    if (kind == HEADLIGHT) continue;  // what the eye sees, it lights
    float lx = lamp[LIGHT_X], ly = lamp[LIGHT_Y], lz = lamp[LIGHT_Z];
    VI want[BLOCKS], later[BLOCKS], lost[BLOCKS];
    int left = 0;
    for (int b = 0; b < BLOCKS; b++) {
      want[b] = 0; later[b] = 0; lost[b] = 0;
      if (bins[b] < 0) continue;
      VF tx = lx, ty = ly, tz = lz;
      if (kind == POINT) { tx -= target[b].X; ty -= target[b].Y; tz -= target[b].Z; }
      VF toward = nx[b] * tx + ny[b] * ty + nz[b] * tz;
      VF length = 1.0f;
      if (kind == POINT) length = VSQRT(tx * tx + ty * ty + tz * tz);
      VF slant = GRAZING_RADII * length / VMAX(toward, GRAZING_RADII / LARGEST_OFFSET * length);
      target[b].offset = VMAX(slant, rim[b]);
      VI before = (found[b] >> l & 1) != 0;
      want[b] = seen[b] & (toward > 0.0f) & NOT(before);
      left |= any_lane(want[b]);
    }
    for (int packets = 0; packets < 8; packets++) {
      if (!left) continue;
      Packet packet;
      if (kind == POINT) aim_point(view, lx, ly, lz, target, want, later, &packet);
      else aim_directional(view, lx, ly, lz, target, &packet);
      occlude(boxes, roots, first_bottom, surfels, tails, &packet, target, reach, want, lost);
      left = 0;
      for (int b = 0; b < BLOCKS; b++) {
        found[b] = found[b] | (SEL((VI)(0), (VI)(1), want[b] & lost[b]) << l);
        want[b] = later[b];
        lost[b] = 0;
        left |= any_lane(want[b]);
      }
    }
  }
  for (int b = 0; b < BLOCKS; b++)
    if (bins[b] >= 0) store_plane((__global float *)(mask + (size_t)bins[b] * mask_stride), 0, at[b], AS_VF(found[b]));
}

// `mask` has a plane of 64 words every `mask_stride` words, one for each bin; `fresh`: it holds nothing yet.
__kernel void trace_lights(__global const float *view, __global const float *boxes, int roots, int first_bottom,
                           __global const float *surfels, __global const float *tails, __global const float *lamps,
                           int lamp_count, float reach, int fresh, int bins_x, int bins_y, __global const int *touched,
                           __global const float *all_planes, __global uint *mask, int mask_stride, int mask_offset) {
#if VW == 1
  int bin = get_group_id(0), pixel = get_local_id(0);
  if (bin >= bins_x * bins_y || touched[bin] < 0) return;
  shadow_bins(view, boxes, roots, first_bottom, surfels, tails, lamps, lamp_count, reach, fresh, bin % bins_x,
              bin / bins_x, pixel, bins_x, bins_y, touched, all_planes, mask + mask_offset, mask_stride);
#else
  int tiles_x = (bins_x + TILE_BINS - 1) / TILE_BINS, tile = get_global_id(0);
  int x0 = tile % tiles_x * TILE_BINS, y0 = tile / tiles_x * TILE_BINS;
  for (int y = y0; y < y0 + TILE_BINS && y < bins_y; y += PACKET_Y)
    for (int x = x0; x < x0 + TILE_BINS && x < bins_x; x += PACKET_X)
      shadow_bins(view, boxes, roots, first_bottom, surfels, tails, lamps, lamp_count, reach, fresh, x, y, 0, bins_x,
                  bins_y, touched, all_planes, mask + mask_offset, mask_stride);
#endif
}
