// Where a picture's pixels hold an edge: beside a pixel of which one of both hits nothing, or another surface, or a surface
// that is not the other's plane carried on, or one that faces elsewhere. What belongs to a pixel's edge is drawn again,
// FACTOR times as large: a bin of that picture is wanted (-1) where one of its pixels holds an edge, else not (-2).
//
// One work-item per SPAN x (BIN / FACTOR) pixels. Twin: tests/reference/light.py, mark_edges.
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

typedef struct {
  __global const float *view, *depth, *normal;
  __global const int *id;
  int width, height;
} Picture;

// Depth at pixel (u, v) of the plane through what pixel (x, y) shows.
inline float carried_on(const Picture *p, int x, int y, int u, int v) {
  __global const float *view = p->view;
  size_t at = (size_t)y * p->width + x;
  __global const float *n = p->normal + 3 * at;
  float nx = view[0] * n[0] + view[1] * n[1] + view[2] * n[2], ny = view[3] * n[0] + view[4] * n[1] + view[5] * n[2];
  float nz = view[6] * n[0] + view[7] * n[1] + view[8] * n[2], t = p->depth[at];
  float ax = (x + 0.5f - view[CX]) / view[FX], ay = (view[CY] - (y + 0.5f)) / view[FY];
  float bx = (u + 0.5f - view[CX]) / view[FX], by = (view[CY] - (v + 0.5f)) / view[FY];
  if (view[PERSPECTIVE] > 0.0f) return t * (nx * ax + ny * ay - nz) / (nx * bx + ny * by - nz);
  return t + (nx * (bx - ax) + ny * (by - ay)) / nz;
}

// Whether an edge runs between two pixels.
inline int edge_between(const Picture *p, int x, int y, int u, int v) {
  size_t a = (size_t)y * p->width + x, b = (size_t)v * p->width + u;
  float za = p->depth[a], zb = p->depth[b];
  if ((za != za) | (zb != zb)) return (za == za) | (zb == zb);
#if HAS_ID
  if (p->id[a] != p->id[b]) return 1;
#endif
  __global const float *na = p->normal + 3 * a, *nb = p->normal + 3 * b;
  if (na[0] * nb[0] + na[1] * nb[1] + na[2] * nb[2] < CREASE) return 1;
  float px = p->view[PERSPECTIVE] > 0.0f ? (za < zb ? za : zb) / p->view[FX] : 1.0f / p->view[FX];
  if (fabs(za - zb) <= STEP_PX * px) return 0;
  // A plane seen edge-on says nothing: the other one speaks.
  float from_a = fabs(carried_on(p, x, y, u, v) - zb), from_b = fabs(carried_on(p, u, v, x, y) - za);
  return !(from_a <= STEP_PX * px) & !(from_b <= STEP_PX * px);
}

__kernel void mark_edges(__global const float *view, __global const float *depth, __global const float *normal,
                         __global const int *id, int width, int height, int bins_x, int bins_y,
                         __global uchar *edges /* (height, width) */, __global int *wanted /* bins */) {
  Picture p = {view, depth, normal, id, width, height};
  int x0 = get_global_id(0) * SPAN, row = get_global_id(1), side = BIN / FACTOR;
  if (x0 >= width || row >= bins_y) return;
  for (int x = x0; x < x0 + SPAN && x / side < bins_x; x += side) {
    int any = 0;
    for (int j = row * side; j < (row + 1) * side && j < height; j++)
      for (int i = x; i < x + side && i < width; i++) {
        int edge = 0;
        for (int k = 0; k < 8 && !edge; k++) {
          int u = i + (k < 3 ? k - 1 : k < 6 ? k - 4 : k < 7 ? -1 : 1), v = j + (k < 3 ? -1 : k < 6 ? 1 : 0);
          if (u >= 0 && u < width && v >= 0 && v < height) edge = edge_between(&p, i, j, u, v);
        }
        edges[(size_t)j * width + i] = edge;
        any |= edge;
      }
    wanted[row * bins_x + x / side] = any ? -1 : -2;
  }
}
