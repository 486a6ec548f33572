// Where a picture's pixels hold an edge: beside a pixel of which one of both hits nothing, or another surface, or a surface
// that is not the other's plane carried on, or one that faces elsewhere. What belongs to a pixel's edge is drawn again,
// FACTOR times as large: a bin of that picture is wanted (-1) where one of its pixels holds an edge, else not (-2).
//
// One work-item per SPAN x (BIN / FACTOR) pixels; lanes are pixels of a row (scalar items took 29 ms of a dragon's frame
// of 1024x1024, lanes take 7). Twin: tests/reference/light.py, mark_edges.
#include "common/lanes.clh"
#include "common/bins.clh"
#include "common/view.clh"

#ifndef FACTOR
#define FACTOR 4
#endif
#ifndef SPAN
#define SPAN 64
#endif
#ifndef HAS_ID
#define HAS_ID 0
#endif
#define STEP_PX 1.5f      // of depth, in widths of a pixel there, is a jump
#define CREASE 0.82f      // cosine between normals
#define WIDE (VW + 2)
#if VW == 1
typedef float FloatsAt;
#else
typedef CAT(float, VW) FloatsAt __attribute__((aligned(4)));
#endif

// What VW pixels of a row and those around them show: depth (0: nothing), normal in world space, number of the surface.
typedef struct { float depth[WIDE], x[WIDE], y[WIDE], z[WIDE], id[WIDE]; } Strip;
typedef struct { VF depth, x, y, z, id; } Part;

INLINE Part part_of(const Strip *s, int at) {
  Part p;
  p.depth = *(const FloatsAt *)(s->depth + at); p.x = *(const FloatsAt *)(s->x + at); p.y = *(const FloatsAt *)(s->y + at);
  p.z = *(const FloatsAt *)(s->z + at); p.id = *(const FloatsAt *)(s->id + at);
  return p;
}

// Pixels outside the picture repeat its rim.
INLINE void fetch(__global const float *depth, __global const float *normal, __global const int *id, int width, int height,
                  int x0, int y, Strip *s) {
  y = y < 0 ? 0 : y >= height ? height - 1 : y;
  for (int i = 0; i < WIDE; i++) {
    int x = x0 + i - 1;
    size_t at = (size_t)y * width + (x < 0 ? 0 : x >= width ? width - 1 : x);
    float t = depth[at];
    int none = t != t;
    s->depth[i] = none ? INFINITY : t;
    s->x[i] = none ? 0.0f : normal[3 * at]; s->y[i] = none ? 0.0f : normal[3 * at + 1];
    s->z[i] = none ? 0.0f : normal[3 * at + 2];
#if HAS_ID
    s->id[i] = id[at];
#else
    s->id[i] = 0.0f;
#endif
  }
}

// How far the plane of `a`, seen along (ax, ay), is from what `b` shows along (bx, by).
INLINE VF away_from_plane(__global const float *view, const Part *a, VF ax, VF ay, const Part *b, VF bx, VF by) {
  VF nx = view[0] * a->x + view[1] * a->y + view[2] * a->z, ny = view[3] * a->x + view[4] * a->y + view[5] * a->z;
  VF nz = view[6] * a->x + view[7] * a->y + view[8] * a->z, there;
  if (view[PERSPECTIVE] > 0.0f) there = a->depth * (nx * ax + ny * ay - nz) / (nx * bx + ny * by - nz);
  else there = a->depth + (nx * (bx - ax) + ny * (by - ay)) / nz;
  there -= b->depth;
  return SEL(there, -there, there < 0.0f);
}

// Whether an edge runs between two pixels.
INLINE VI edge_between(__global const float *view, const Part *a, VF ax, VF ay, const Part *b, VF bx, VF by) {
  VI hit_a = a->depth < INFINITY, hit_b = b->depth < INFINITY, both = hit_a & hit_b;
  VI edge = (hit_a | hit_b) & NOT(both);
  if (!any_lane(both)) return edge;
  edge = edge | (both & ((a->id != b->id) | (a->x * b->x + a->y * b->y + a->z * b->z < CREASE)));
  VF px = 1.0f / view[FX];
  if (view[PERSPECTIVE] > 0.0f) px *= VMIN(a->depth, b->depth);
  VF step = a->depth - b->depth;
  step = SEL(step, -step, step < 0.0f);
  VI jump = both & NOT(edge) & (step > STEP_PX * px);
  if (!any_lane(jump)) return edge;
  // A plane seen edge-on says nothing: the other one speaks.
  VI near = (away_from_plane(view, a, ax, ay, b, bx, by) <= STEP_PX * px)
          | (away_from_plane(view, b, bx, by, a, ax, ay) <= STEP_PX * px);
  return edge | (jump & NOT(near));
}

__kernel void mark_edges(__global const float *view, __global const float *depth, __global const float *normal,
                         __global const int *id, int width, int height, int bins_x, int bins_y,
                         __global uchar *edges /* (height, width) */, __global int *wanted /* bins */) {
  int first = get_global_id(0) * SPAN, row = get_global_id(1), side = BIN / FACTOR;
  if (first >= width || row >= bins_y) return;
  for (int x = first; x < first + SPAN && x / side < bins_x; x += side) wanted[row * bins_x + x / side] = -2;
  float inv_fx = 1.0f / view[FX], inv_fy = 1.0f / view[FY];
  for (int y = row * side; y < (row + 1) * side && y < height; y++)
    for (int x = first; x < first + SPAN && x < width; x += VW) {
      Strip strips[3];
      for (int j = 0; j < 3; j++) fetch(depth, normal, id, width, height, x, y + j - 1, &strips[j]);
      Part own = part_of(&strips[1], 1);
      VF ax = (TO_VF((VI)(x) + LANE_INDEX) + 0.5f - view[CX]) * inv_fx, ay = (view[CY] - (y + 0.5f)) * inv_fy;
      VI edge = 0;
      for (int k = 0; k < 9; k++) {
        if (k == 4) continue;
        Part other = part_of(&strips[k / 3], k % 3);
        edge = edge | edge_between(view, &own, ax, ay, &other, ax + (k % 3 - 1) * inv_fx, ay - (k / 3 - 1) * inv_fy);
      }
      for (int i = 0; i < VW && x + i < width; i++) {
        int here = ((int *)&edge)[i] != 0;
        edges[(size_t)y * width + x + i] = here;
        if (here) wanted[row * bins_x + (x + i) / side] = -1;
      }
    }
}
