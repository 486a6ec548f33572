// The points of lines on the edges between pixels that they cross: x, y (pixels, centres at +0.5), depth and strength.
//
// CONTOUR 0: where the field, linear along the edge, is 0. CONTOUR 1: where the nearer surface ends. The squared cosine
// between normal and ray falls linearly towards an occluding contour, so its zero is extrapolated from the last pixel
// of the surface and the one before it; at open borders, where it does not reach 0, the edge's middle is taken.
// Strength: 2 before the background, 1 before another surface. Edges are numbered 2 * pixel, + 1 for the one downwards,
// in rows of stride - 2 MARGIN_X pixels. One work-item per edge. Twin: tests/reference/lines.py.
#define VW 1
#include "analysis/line_planes.clh"
#ifndef AXIS
#define AXIS 0
#endif
#ifndef CONTOUR
#define CONTOUR 0
#endif

__kernel void line_points(int count, int stride, int plane, __global const int *edges, __global const int *links,
                          __global const float *depths, __global const float *sine2, __global const float *field,
                          __global const float *strength, __global const float *values, __global float4 *points) {
  int i = get_global_id(0);
  if (i >= count) return;
  int down = edges[i] & 1, pixel = edges[i] >> 1, columns = stride - 2 * MARGIN_X;
  int x = pixel % columns, y = pixel / columns, step = down ? stride : 1;
  size_t a = PLANE_AT(x, y), b = a + step;
  float share, depth, s = 1.0f;
#if CONTOUR
  int from_b = !(depths[a] <= depths[b]) && (links[b] & HIT);  // the nearer one; missing depths are NaN
  size_t near = from_b ? b : a, inner = from_b ? b + step : a - step;
  int on = links[from_b ? near : inner] & (down ? LINK_DOWN : LINK_RIGHT);
  float q = 1.0f - sine2[near], fall = on ? 1.0f - sine2[inner] - q : 0.0f;
  float beyond = fall > 0.0f ? q / fall : 1.0f;
  beyond = beyond < 1.0f ? beyond : 0.5f;
  share = from_b ? 1.0f - beyond : beyond;
  depth = depths[near];
  s = (links[a] & links[b] & HIT) ? 1.0f : 2.0f;
#else
  float f = field[a], g = field[b];
#if AXIS
  __global const float *t = values + (size_t)4 * plane, *u = t + plane, *v = u + plane;
  float dot = t[a] * t[b] + u[a] * u[b] + v[a] * v[b];
  g = dot > 0.0f ? g : -g;
#endif
  share = f == g ? 0.5f : f / (f - g);
  depth = depths[a] + share * (depths[b] - depths[a]);
  s = strength[a] + share * (strength[b] - strength[a]);
#endif
  points[i] = (float4)(x + 0.5f + (down ? 0.0f : share), y + 0.5f + (down ? share : 0.0f), depth, s);
}
