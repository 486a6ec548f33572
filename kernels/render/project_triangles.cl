// The tiles that each run of faces may touch, and its order from front to back. One work-item per run.
// Twin: tests/reference/render_triangles.py, project_triangles.
//
// Footprints are those of common/bins.clh with a tile in place of a bin: blocks are half tiles. Faces that reach the cut
// are bounded by what lies in front of it: their vertices there, and where edges leave, towards infinity at the eye's
// plane.
#include "common/bins.clh"
#include "render/triangles.clh"

#ifndef TILE_BINS
#define TILE_BINS 4
#endif
#define BLOCK (TILE_BINS * BIN / 2)

#define LESS(a, b) ((b) < (a) ? (b) : (a))
#define MORE(a, b) ((b) > (a) ? (b) : (a))

__kernel void project_triangles(__global const float *view, __global const float4 *points, __global const int *faces,
                                int count, int runs, __global short4 *full, __global short4 *core, __global uint *keys,
                                __global ushort *buckets) {
  int k = get_global_id(0);
  if (k >= runs) return;
  int begin = k * RUN, end = begin + RUN < count ? begin + RUN : count;
  float x0 = INFINITY, y0 = INFINITY, x1 = -INFINITY, y1 = -INFINITY, front = INFINITY, least = INFINITY;
  float cut = view[CUT], near = view[NEAR];
  for (int i = 3 * begin; i < 3 * end; i++) {
    float4 p = points[faces[i]];
    least = LESS(least, p.w);
    int shown = p.w > cut;
    float x = shown ? p.x : x0, y = shown ? p.y : y0, u = shown ? p.x : x1, v = shown ? p.y : y1, z = shown ? p.w : front;
    x0 = LESS(x0, x); y0 = LESS(y0, y); x1 = MORE(x1, u); y1 = MORE(y1, v); front = LESS(front, z);
  }
  int clipped = least <= cut;
  if (clipped) {
    int plane = !(view[PERSPECTIVE] > 0.0f) || near > 0.0f;  // whether what shows ends at `near`, not at the eye's plane
    for (int i = begin; i < end; i++)
      for (int e = 0; e < 3; e++) {
        float4 p = points[faces[3 * i + e]], q = points[faces[3 * i + (e + 1) % 3]];
        float limit = plane ? near : 0.0f;
        if (p.w == -INFINITY || q.w == -INFINITY) continue;
        // Vertices between `limit` and the cut are far out, but they bound what shows.
        if (p.w > limit) {
          x0 = LESS(x0, p.x); y0 = LESS(y0, p.y); x1 = MORE(x1, p.x); y1 = MORE(y1, p.y); front = LESS(front, p.w);
        }
        if ((p.w > limit) == (q.w > limit)) continue;
        float t = (limit - p.w) / (q.w - p.w), pw = view[PERSPECTIVE] > 0.0f ? p.w : 1.0f;
        float qw = view[PERSPECTIVE] > 0.0f ? q.w : 1.0f;
        // Relative to the middle of the picture: x w of the place on the edge, which is towards infinity where w is 0.
        float mx = 0.5f * view[WIDTH], my = 0.5f * view[HEIGHT];
        float x = (p.x - mx) * pw + t * ((q.x - mx) * qw - (p.x - mx) * pw);
        float y = (p.y - my) * pw + t * ((q.y - my) * qw - (p.y - my) * pw), w = pw + t * (qw - pw);
        if (plane) {
          x = mx + x / w; y = my + y / w;
          x0 = LESS(x0, x - 1.0f); x1 = MORE(x1, x + 1.0f); y0 = LESS(y0, y - 1.0f); y1 = MORE(y1, y + 1.0f);
        } else {
          // Rounding may turn a direction that is almost along an axis: both sides count there.
          float ax = x < 0.0f ? -x : x, ay = y < 0.0f ? -y : y;
          if (x > -1e-3f * ay - 1e-30f) x1 = 1e9f;
          if (x < 1e-3f * ay + 1e-30f) x0 = -1e9f;
          if (y > -1e-3f * ax - 1e-30f) y1 = 1e9f;
          if (y < 1e-3f * ax + 1e-30f) y0 = -1e9f;
        }
        front = LESS(front, limit);
      }
  }
  // 1/32 pixel covers float rounding.
  x0 = MORE(ceil(x0 - 0.53125f), 0.0f); x1 = LESS(floor(x1 - 0.46875f), view[WIDTH] - 1.0f);
  y0 = MORE(ceil(y0 - 0.53125f), 0.0f); y1 = LESS(floor(y1 - 0.46875f), view[HEIGHT] - 1.0f);
  int shown = x0 <= x1 && y0 <= y1;
  short4 box = shown ? (short4)((int)x0 / BLOCK, (int)y0 / BLOCK, (int)x1 / BLOCK, (int)y1 / BLOCK) : (short4)(1, 1, 0, 0);
  full[k] = box;
  core[k] = box;
  uint bits = as_uint(front);
  keys[k] = ((bits & 0x80000000u ? ~bits : bits | 0x80000000u) & 0xffffff00u) | (clipped ? 1u : 0u);
  float bucket = (front - view[FIRST_DEPTH]) / view[BUCKET_DEPTH];
  buckets[k] = (ushort)(bucket > 0.0f ? LESS(bucket, DEPTH_BUCKETS - 1.0f) : 0.0f);
}
