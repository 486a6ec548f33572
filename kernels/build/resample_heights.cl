// Heights of a triangle mesh over the nodes of patches, one work-item for `rows` rows of a patch of at most rows x bands.
//
// A patch owns the first faces of its list; the rest lie around them. A node is needed where an own face meets one of
// the four cells around it, or comes within REACH - 1 steps of them. Its height is that of the own face above it, the
// highest of several; beyond the own faces that of the face around which lies closest to the plane of the nearest own
// face, if it is within GAP_LIMIT steps of it. Where there is none (at open borders and folds) the plane is carried on,
// but only to nodes within CARRY steps of an own face, not where a nearer face around lies FALL below it, and never over
// an edge between two vertices that `cut` marks: patches of its own follow that. Scratch: two floats a node. Lists too long
// for one launch are gone through by several, `begin` to `end` of each; the one with `last` ends the heights.
//
// Paper on spatial patches, section 4.1 ("can be converted to patches, since ... projected onto a plane").
#include "build/patch_frame.clh"

#ifndef REACH
#define REACH 1.25f       // half the side of the square around a node that an own face must meet, node steps
#endif
#ifndef CARRY
#define CARRY 0.8f        // the same for nodes that no face lies over
#endif
#ifndef FALL
#define FALL 1.2f         // steps: the surface bends away. Without it fandisk's roundings overhung by 0.56 nodes (0.47)
#endif
#ifndef SLOPE_LIMIT
#define SLOPE_LIMIT 2.0f  // of planes that are carried on beyond their faces
#endif
#ifndef GAP_LIMIT
#define GAP_LIMIT 1.5f    // steps
#endif
#define FLAT_AREA 1e-9f   // a triangle seen edge-on: no plane over it

// Gap of a node: to the plane of the nearest own face where another face was found there, or what it is.
#define UNNEEDED -2.0f
#define OWN -1.0f         // an own face lies over it
#define CARRIED 1e30f     // none found, near enough to carry the plane on
#define CUT -2            // source of a node beyond an edge with patches of its own: CUT - face
#define CUT_WIDTH 0.01f   // steps that a node may lie beyond such an edge by rounding
#define LOOSE 2e30f       // none found

typedef struct { int i0, i1, j0, j1; } NodeBox;

inline NodeBox nodes_around(const FlatTriangle *t, float reach, int m, int n) {
  float x0 = min(t->x[0], min(t->x[1], t->x[2])) - reach, x1 = max(t->x[0], max(t->x[1], t->x[2])) + reach;
  float y0 = min(t->y[0], min(t->y[1], t->y[2])) - reach, y1 = max(t->y[0], max(t->y[1], t->y[2])) + reach;
  NodeBox box;  // clamped before the conversion: far triangles would overflow
  box.i0 = (int)ceil(clamp(x0, 0.0f, (float)m));
  box.i1 = (int)floor(clamp(x1, -1.0f, (float)(m - 1)));
  box.j0 = (int)ceil(clamp(y0, 0.0f, (float)n));
  box.j1 = (int)floor(clamp(y1, -1.0f, (float)(n - 1)));
  return box;
}

// Whether the square of half side `reach` around (x, y) meets the triangle, given that it meets its edges' box.
inline bool meets(const FlatTriangle *t, float side, float reach, float x, float y) {
  for (int k = 0; k < 3; k++) {
    int b = k == 2 ? 0 : k + 1;
    float dx = (t->x[b] - t->x[k]) * side, dy = (t->y[b] - t->y[k]) * side;
    float edge = dx * (y - t->y[k]) - dy * (x - t->x[k]);
    if (edge + reach * (fabs(dx) + fabs(dy)) < 0.0f) return false;
  }
  return true;
}

// Whether the point of the weights lies on an edge with patches of its own, and the node beyond it, not on it.
inline bool beyond_cut(const float *weight, float d2, __global const int *corners, __global const uchar *cut) {
  bool all = d2 > CUT_WIDTH * CUT_WIDTH;
  for (int k = 0; k < 3; k++) all = all && (weight[k] == 0.0f || cut[corners[k]] != 0);
  return all;
}

// Height at (x, y) of the triangle's plane, carried on from its nearest point with a limited slope.
inline float carried_height(const FlatTriangle *t, float area, float x, float y, const float *weight) {
  float nx = weight[0] * t->x[0] + weight[1] * t->x[1] + weight[2] * t->x[2];
  float ny = weight[0] * t->y[0] + weight[1] * t->y[1] + weight[2] * t->y[2];
  float nz = weight[0] * t->z[0] + weight[1] * t->z[1] + weight[2] * t->z[2];
  if (fabs(area) <= FLAT_AREA) return nz;
  float ax = t->x[1] - t->x[0], ay = t->y[1] - t->y[0], az = t->z[1] - t->z[0];
  float bx = t->x[2] - t->x[0], by = t->y[2] - t->y[0], bz = t->z[2] - t->z[0];
  float gx = (az * by - bz * ay) / area, gy = (bz * ax - az * bx) / area;
  float slope = sqrt(gx * gx + gy * gy);
  float scale = slope > SLOPE_LIMIT ? SLOPE_LIMIT / slope : 1.0f;
  return nz + scale * (gx * (x - nx) + gy * (y - ny));
}

__kernel void resample_heights(int patches, int rows, int bands, int begin, int end, int last,
                               __global const float *frames, __global const int *size,
                               __global const int *node_offset, __global const int *list_offset,
                               __global const int *own_count, __global const int *list, __global const int *faces,
                               __global const float *vertices, __global const uchar *cut, __global float *distance,
                               __global float *gap, __global float *heights, __global int *source) {
  int p = get_global_id(0) / bands, low = get_global_id(0) % bands * rows;
  if (p >= patches) return;
  __global const float *frame = frames + FRAME_FLOATS * (size_t)p;
  int m = size[2 * p], n = size[2 * p + 1], first = node_offset[p], high = min(low + rows, n);
  for (int k = first + low * m; begin == 0 && k < first + high * m; k++) {
    distance[k] = INFINITY;
    gap[k] = UNNEEDED;
    heights[k] = NAN;
    source[k] = -1;
  }
  for (int at = list_offset[p] + begin; at < min(list_offset[p] + end, list_offset[p + 1]); at++) {
    bool own = at < list_offset[p] + own_count[p];
    FlatTriangle t = flat_triangle(frame, vertices, faces + 3 * (size_t)list[at]);
    float area = doubled_area(&t), side = area < 0.0f ? -1.0f : 1.0f, weight[3];
    if (!own && area <= FLAT_AREA) continue;  // what faces down is another side of the surface
    __global const int *corners = faces + 3 * (size_t)list[at];
    NodeBox box = nodes_around(&t, REACH, m, n);
    for (int j = max(box.j0, low); j <= min(box.j1, high - 1); j++)
      for (int i = box.i0; i <= box.i1; i++) {
        int k = first + j * m + i;
        float x = i, y = j;
        if (own ? !meets(&t, side, REACH, x, y) : distance[k] == INFINITY || gap[k] == OWN) continue;
        float d2 = nearest_weights(&t, area, x, y, weight);
        if (own) {
          float z = carried_height(&t, area, x, y, weight);
          float state = d2 == 0.0f ? OWN : d2 <= 2.0f * CARRY * CARRY && meets(&t, side, CARRY, x, y) ? CARRIED : LOOSE;
          if (distance[k] == INFINITY || state < gap[k]) gap[k] = state;
          if (d2 > distance[k] || (d2 == distance[k] && z <= heights[k])) continue;
          distance[k] = d2;
          heights[k] = z;
          source[k] = beyond_cut(weight, d2, corners, cut) ? CUT - list[at] : list[at];
        } else if (d2 == 0.0f) {
          // heights[k] goes on holding the own plane, distance[k] takes the height found
          float z = weight[0] * t.z[0] + weight[1] * t.z[1] + weight[2] * t.z[2], miss = fabs(z - heights[k]);
          if (miss > GAP_LIMIT || miss >= gap[k]) continue;
          distance[k] = z;
          source[k] = list[at];
          gap[k] = miss;
        } else if (gap[k] >= CARRIED && d2 < distance[k]) {
          float z = weight[0] * t.z[0] + weight[1] * t.z[1] + weight[2] * t.z[2];
          if (beyond_cut(weight, d2, corners, cut)) source[k] = CUT - list[at];  // the edge goes on beside the own faces
          if (heights[k] - z > FALL) gap[k] = LOOSE;
        }
      }
  }
  for (int k = first + low * m; last && k < first + high * m; k++) {
    if (source[k] <= CUT) gap[k] = LOOSE;
    float z = gap[k] >= 0.0f && gap[k] < CARRIED ? distance[k] : heights[k];
    heights[k] = gap[k] == LOOSE ? NAN : frame[FRAME_STEP] * z;
    if (gap[k] == LOOSE) source[k] = -1;
  }
}
