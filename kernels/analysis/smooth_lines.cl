// Smooth the planes of `line_values` by a Gaussian that does not reach across depth jumps: along rows, then along
// columns, each window ending at the first missing link. Writes planes of the field and the strength; the field is NaN
// within CLEAR pixels of a jump or of the background, where neither curvatures nor their derivatives are to be trusted.
//
// One work-item per VW columns and ROWS rows, with the last 2 RADIUS + 1 smoothed rows in a ring.
// Twin: tests/reference/lines.py.
#include "analysis/line_planes.clh"
#ifndef AXIS
#define AXIS 0
#endif
#ifndef RADIUS
#define RADIUS 4  // at most MARGIN_Y
#endif
#ifndef ROWS
#define ROWS 32
#endif
#define CLEAR 2
#define COUNT (AXIS ? 4 : 2)
#define RING (2 * RADIUS + 1)
enum { CLEAR_ROW = 8 };  // bit beside those of the links: no jump within CLEAR pixels in the row

// The smoothed values of one row's VW pixels, and their bits.
INLINE VI smooth_row(__global const float *values, __global const int *links, size_t at, int plane,
                     __global const float *weights, VF *out) {
  VI here = LOAD_INT(links + at), hit = (here & HIT) != 0, right = hit, left = hit, clear = hit;
  VF sum = (VF)(weights[0]);
  for (int k = 0; k < COUNT; k++) out[k] = weights[0] * LOAD(values + (size_t)k * plane + at);
  for (int i = 1; i <= RADIUS; i++) {
    right &= (LOAD_INT(links + at + i - 1) & LINK_RIGHT) != 0;
    left &= (LOAD_INT(links + at - i) & LINK_RIGHT) != 0;
    if (i == CLEAR) clear = right & left;
    VF w = SEL((VF)(0.0f), (VF)(weights[i]), right), v = SEL((VF)(0.0f), (VF)(weights[i]), left);
    sum += w + v;
    for (int k = 0; k < COUNT; k++) {
      __global const float *p = values + (size_t)k * plane + at;
      out[k] += w * LOAD(p + i) + v * LOAD(p - i);
    }
  }
  for (int k = 0; k < COUNT; k++) out[k] /= sum;
  return here | SEL((VI)(0), (VI)(CLEAR_ROW), clear);
}

// Smooth along a column and write one row; `value` and `bits` are rings, row y at slot (y + RING) % RING.
INLINE void smooth_column(VF value[RING][COUNT], VI bits[RING], int y, __global const float *weights, size_t to,
                          int plane, __global const float *values, __global float *field, __global float *strength) {
  int own = (y + RING) % RING;
  VI down = (bits[own] & HIT) != 0, up = down, clear = (bits[own] & CLEAR_ROW) != 0;
  VF sum = (VF)(weights[0]), total[COUNT];
  for (int k = 0; k < COUNT; k++) total[k] = weights[0] * value[own][k];
  for (int j = 1; j <= RADIUS; j++) {
    int below = (y + j + RING) % RING, above = (y - j + RING) % RING, last = (y + j - 1 + RING) % RING;
    down &= (bits[last] & LINK_DOWN) != 0;
    up &= (bits[above] & LINK_DOWN) != 0;
    if (j <= CLEAR) clear &= down & up & ((bits[below] & bits[above] & CLEAR_ROW) != 0);
    VF w = SEL((VF)(0.0f), (VF)(weights[j]), down), v = SEL((VF)(0.0f), (VF)(weights[j]), up);
    sum += w + v;
    for (int k = 0; k < COUNT; k++) total[k] += w * value[below][k] + v * value[above][k];
  }
  VF inv = 1.0f / sum;
#if AXIS
  __global const float *t = values + (size_t)4 * plane + to;
  VF f = total[0] * LOAD(t) + total[1] * LOAD(t + plane) + total[2] * LOAD(t + 2 * (size_t)plane);
#else
  VF f = total[0];
#endif
  STORE(field + to, SEL((VF)(NAN), f * inv, clear));
  STORE(strength + to, total[COUNT - 1] * inv);
}

__kernel void smooth_lines(int height, int stride, int plane, __global const int *links, __global const float *values,
                           __global const float *weights, __global float *field, __global float *strength) {
  int x = get_global_id(0) * VW - MARGIN_X, first = get_global_id(1) * ROWS;
  if (x >= stride - MARGIN_X || first >= height) return;
  int last = first + ROWS < height ? first + ROWS : height, inside = x >= 0 && x < stride - 2 * MARGIN_X;
  VF value[RING][COUNT];
  VI bits[RING];
  for (int i = 0; i < RING; i++) {
    bits[i] = (VI)(0);
    for (int k = 0; k < COUNT; k++) value[i][k] = (VF)(0.0f);
  }
  for (int y = first - RADIUS; y < last + RADIUS; y++) {
    int slot = (y + RING) % RING, middle = y - RADIUS;
    size_t at = PLANE_AT(x, y);
    // Rows without a hit keep old values, which the missing links leave unused.
    if (inside && any_lane((LOAD_INT(links + at) & HIT) != 0))
      bits[slot] = smooth_row(values, links, at, plane, weights, value[slot]);
    else bits[slot] = (VI)(0);
    if (middle < first) { }
    else if (any_lane((bits[(middle + RING) % RING] & HIT) != 0))
      smooth_column(value, bits, middle, weights, PLANE_AT(x, middle), plane, values, field, strength);
    else STORE(field + PLANE_AT(x, middle), (VF)(NAN));
  }
}
