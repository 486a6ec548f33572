// Hard shadows: which lamps the points of a picture do not see because of one surface; a bit per lamp in a mask.
//
// Rays run from the lamp to the point. Hits from behind count wherever they are in front of the point by OFFSET radii
// of the surfel, so that a point never shadows itself; hits from the front only farther than FRONT_OFFSET radii away:
// they let open surfaces throw shadows. Points that face away from a lamp are not traced.
// VW = 16: a work-item per TILE_BINS^2 bins, packets of 8x8 points; VW = 1: one point each.
// Twin: tests/reference/trace.py, trace_lights.
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
#define OFFSET_RADII 0.25f
#endif
#ifndef GRAZING_RADII
#define GRAZING_RADII 0.04f  // error of a surfel's height: at the angle whose cosine is c it shifts a hit by this over c
#endif
#ifndef FRONT_RADII
#define FRONT_RADII 1.0f  // 0: hits from the front do not count
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
INLINE void occlude(__global const float *boxes, __global const float *cones, int roots, int first_bottom,
                    __global const float *surfels, __global const float *tails, Packet *packet, const Target *target,
                    float reach, const VI *want, VI *lost) {
  Sieve sieve;
  Waiting waiting;
  BlockBounds bounds;
  float near = INFINITY, block_far[BLOCKS];
  for (int b = 0; b < BLOCKS; b++) {
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
    int node = next_bottom(boxes, roots, first_bottom, &sieve, near, far, &waiting);
    if (node < 0) continue;
    int slot = first_slot(node, first_bottom);
    for (int part = 0; part < WIDE; part += VW) {
      Projected projected;
      Piece piece;
      project_surfels(surfels + (size_t)slot * SURFEL_FLOATS, part, packet, &projected, &piece);
      uint enters = FRONT_RADII > 0 ? mask_of(piece.enters) : 0u, leaves = mask_of(piece.leaves);
      for (int b = 0; b < BLOCKS; b++) {
        uint bits = pieces_in_block(&piece, &bounds, b, near, block_far[b]) & (enters | leaves);
        if (!bits) continue;
        VF px = target[b].x, py = target[b].y, end = target[b].t, offset = target[b].offset;
        VI hit = lost[b];
        while (bits) {
          int j = lowest_bit(bits);
          bits &= bits - 1;
          const float *own = (const float *)projected.field + j;
          __global const float *k = tails + (size_t)(slot + part + j) * TAIL_FLOATS - K0;
          VF u, v, w, du, dv, dw, t, r = OWN(OWN_RADIUS);
          place_ray(own, px, py, &u, &v, &w, &du, &dv, &dw);
          RayPoly p = ray_poly(k, u, v, w, du, dv, dw);
          if (leaves >> j & 1u) {
            VI good = piece_root(k, own, p, -1.0f, u, v, w, du, dv, dw, &t);
            hit = hit | (good & (t < end - offset * r) & (t > end - reach) & (t > near));
          }
          if (enters >> j & 1u) {
            VI good = piece_root(k, own, p, 1.0f, u, v, w, du, dv, dw, &t);
            hit = hit | (good & (t < end - (FRONT_RADII + offset) * r) & (t > end - reach) & (t > near));
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

INLINE void shadow_bin(__global const float *view, __global const float *boxes, __global const float *cones, int roots,
                       int first_bottom, __global const float *surfels, __global const float *tails,
                       __global const float *lamps, int lamp_count, float reach, int fresh, int bin_x, int bin_y,
                       int pixel, __global const float *planes, __global uint *mask) {
  Target target[BLOCKS];
  VF nx[BLOCKS], ny[BLOCKS], nz[BLOCKS];
  VF rim[BLOCKS];
  VI seen[BLOCKS], found[BLOCKS];
  int at[BLOCKS], any = 0;
  float inv_fx = 1.0f / view[FX], inv_fy = 1.0f / view[FY];
  for (int b = 0; b < BLOCKS; b++) {
#if VW == 1
    int x = pixel & 7, y = pixel >> 3;
    at[b] = pixel;
#else
    VI x = (LANE_INDEX & 3) + (b & 1) * 4, y = (LANE_INDEX >> 2) + (b >> 1) * 4;
    at[b] = (b >> 1) * 4 * BIN + (b & 1) * 4;
#endif
    VF depth = load_plane(planes, FIELD_DEPTH, at[b]);
    seen[b] = depth < EMPTY_DEPTH;
    VF t = SEL((VF)(1.0f), depth, seen[b]), across = view[PERSPECTIVE] > 0.0f ? t : (VF)(1.0f);
    target[b].X = (TO_VF(x) + (bin_x * BIN + 0.5f) - view[CX]) * inv_fx * across;
    target[b].Y = (view[CY] - (TO_VF(y) + (bin_y * BIN + 0.5f))) * inv_fy * across;
    target[b].Z = -t;
    nx[b] = load_plane(planes, FIELD_NORMAL, at[b]);
    ny[b] = load_plane(planes, FIELD_NORMAL + 1, at[b]);
    nz[b] = load_plane(planes, FIELD_NORMAL + 2, at[b]);
    VF facing = nz[b], sight = 1.0f;
    if (view[PERSPECTIVE] > 0.0f) {
      facing = -(nx[b] * target[b].X + ny[b] * target[b].Y + nz[b] * target[b].Z);
      sight = target[b].X * target[b].X + target[b].Y * target[b].Y + target[b].Z * target[b].Z;
    }
    sight *= RIM_COSINE * RIM_COSINE * (nx[b] * nx[b] + ny[b] * ny[b] + nz[b] * nz[b]);
    rim[b] = SEL((VF)(OFFSET_RADII), (VF)(RIM_OFFSET), facing * facing < sight);
    found[b] = 0;
    if (!fresh) found[b] = AS_VI(load_plane((__global const float *)mask, 0, at[b]));
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
      VF tx = lx, ty = ly, tz = lz;
      if (kind == POINT) { tx -= target[b].X; ty -= target[b].Y; tz -= target[b].Z; }
      VF toward = nx[b] * tx + ny[b] * ty + nz[b] * tz;
      VF slant = VSQRT((tx * tx + ty * ty + tz * tz) * (nx[b] * nx[b] + ny[b] * ny[b] + nz[b] * nz[b]) + 1e-30f);
      slant = GRAZING_RADII * slant / VMAX(toward, GRAZING_RADII / LARGEST_OFFSET * slant);
      target[b].offset = VMAX(slant, rim[b]);
      VI before = (found[b] >> l & 1) != 0;
      want[b] = seen[b] & (toward > 0.0f) & NOT(before);
      later[b] = 0; lost[b] = 0;
      left |= any_lane(want[b]);
    }
    for (int packets = 0; packets < 8; packets++) {
      if (!left) continue;
      Packet packet;
      if (kind == POINT) aim_point(view, lx, ly, lz, target, want, later, &packet);
      else aim_directional(view, lx, ly, lz, target, &packet);
      occlude(boxes, cones, roots, first_bottom, surfels, tails, &packet, target, reach, want, lost);
      left = 0;
      for (int b = 0; b < BLOCKS; b++) {
        found[b] = found[b] | (SEL((VI)(0), (VI)(1), want[b] & lost[b]) << l);
        want[b] = later[b];
        lost[b] = 0;
        left |= any_lane(want[b]);
      }
    }
  }
  for (int b = 0; b < BLOCKS; b++) store_plane((__global float *)mask, 0, at[b], AS_VF(found[b]));
}

// `mask` has a plane of 64 words every `mask_stride` words, one for each bin; `fresh`: it holds nothing yet.
__kernel void trace_lights(__global const float *view, __global const float *boxes, __global const float *cones,
                           int roots, int first_bottom, __global const float *surfels, __global const float *tails,
                           __global const float *lamps, int lamp_count, float reach, int fresh, int bins_x, int bins_y,
                           __global const int *touched, __global const float *all_planes, __global uint *mask,
                           int mask_stride, int mask_offset) {
#if VW == 1
  int bin = get_group_id(0), pixel = get_local_id(0);
  if (bin >= bins_x * bins_y || touched[bin] < 0) return;
  shadow_bin(view, boxes, cones, roots, first_bottom, surfels, tails, lamps, lamp_count, reach, fresh, bin % bins_x,
             bin / bins_x, pixel, all_planes + (size_t)bin * BIN_PIXELS * FIELDS,
             mask + (size_t)bin * mask_stride + mask_offset);
#else
  int tiles_x = (bins_x + TILE_BINS - 1) / TILE_BINS, tile = get_global_id(0);
  int x0 = tile % tiles_x * TILE_BINS, y0 = tile / tiles_x * TILE_BINS;
  for (int i = 0; i < TILE_BINS * TILE_BINS; i++) {
    int bin_x = x0 + i % TILE_BINS, bin_y = y0 + i / TILE_BINS;
    if (bin_x >= bins_x || bin_y >= bins_y) continue;
    int bin = bin_y * bins_x + bin_x;
    if (touched[bin] < 0) continue;
    shadow_bin(view, boxes, cones, roots, first_bottom, surfels, tails, lamps, lamp_count, reach, fresh, bin_x, bin_y, 0,
               all_planes + (size_t)bin * BIN_PIXELS * FIELDS, mask + (size_t)bin * mask_stride + mask_offset);
  }
#endif
}
