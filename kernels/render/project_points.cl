// The tiles that each run of points may touch, its order from front to back, and how many of its points are drawn: as few
// as make discs `widest` pixels wide, if that is less than all. One work-item per run.
// Twin: tests/reference/render_points.py, project_points.
#include "render/bounds.clh"
#include "render/points.clh"

__kernel void project_points(__global const float *view, __global const float *runs, int count, float widest,
                             __global int *drawn, __global short4 *full, __global short4 *core, __global uint *keys,
                             __global ushort *buckets) {
  int k = get_global_id(0);
  if (k >= count) return;
  __global const float *r = runs + (size_t)k * RUN_FLOATS;
  int perspective = view[PERSPECTIVE] > 0.0f;
  float own = view[SCALE] * r[RUN_RADIUS], front = INFINITY, back = -INFINITY;
  float4 corners[8];
  for (int c = 0; c < 8; c++) {
    float x = r[c & 1 ? RUN_HIGH : RUN_LOW], y = r[(c & 2 ? RUN_HIGH : RUN_LOW) + 1], z = r[(c & 4 ? RUN_HIGH : RUN_LOW) + 2];
    float4 p;
    p.x = view[SCALE] * (view[0] * x + view[1] * y + view[2] * z) + view[OFFSET];
    p.y = view[SCALE] * (view[3] * x + view[4] * y + view[5] * z) + view[OFFSET + 1];
    p.w = -(view[SCALE] * (view[6] * x + view[7] * y + view[8] * z) + view[OFFSET + 2]);
    front = LESS(front, p.w); back = MORE(back, p.w);
    corners[c] = p;
  }
  if (!(back > near_limit(view))) { full[k] = (short4)(1, 1, 0, 0); return; }
  float focal = MORE(view[FX], view[FY]), nearest = MORE(front, 1e-3f * back);
  float wide = 2.0f * own * focal / (perspective ? nearest : 1.0f);
  int use = POINT_RUN;
  for (; use > LEAST_DRAWN && wide * 1.41421356f <= widest; use /= 2) wide *= 1.41421356f;
  drawn[k] = use;
  // What discs add to the box: their radius, in pixels or in the model's units.
  float swell = own * LARGER(use);
  if (view[RADIUS_FIXED] > 0.0f) swell = view[SCALE] * view[RADIUS_FIXED];
  if (view[RADIUS_PX] > 0.0f) swell = view[RADIUS_PX] * (perspective ? MORE(front, 0.05f * back) : 1.0f) / view[FX];
  Bounds b = NO_BOUNDS;
  // A box that comes close to the eye is bounded as a whole: its discs would reach around the eye's plane.
  int clipped = perspective && (front - swell <= near_limit(view) || front - swell <= 0.05f * back);
  for (int c = 0; c < 8; c++) {
    float4 p = corners[c];
    float w = perspective ? (MORE(p.w, 0.05f * back)) : 1.0f;
    corners[c].x = view[CX] + view[FX] * p.x / w; corners[c].y = view[CY] - view[FY] * p.y / w;
    float more = 1.0f + (view[RADIUS_PX] > 0.0f ? 2.0f * view[RADIUS_PX]
                                                : swell * focal / (perspective ? MORE(p.w - swell, 0.01f * back) : 1.0f));
    bound_point((float4)(corners[c].x - more, corners[c].y - more, 0.0f, p.w - swell), &b);
    bound_point((float4)(corners[c].x + more, corners[c].y + more, 0.0f, p.w - swell), &b);
  }
  if (clipped) { b.x0 = b.y0 = -1e9f; b.x1 = b.y1 = 1e9f; b.front = near_limit(view); }
  put_footprint(view, b, clipped, k, full, core, keys, buckets);
}
