// Level of detail, one level of a surfel hierarchy: of the visited surfels, draw those that are small enough in the
// picture, or of the finest level, and visit the children of the others; children of which none has children itself are
// drawn at once, so that most of the surfels need no look of their own. Launched level by level, coarse to fine; one
// work-item handles VW surfels. Twin: tests/reference/surfels.py, select_surfels.
//
// Inside, a surfel may be `interior` pixels wide; where the normals below it, as far as its cone tells, may turn from the
// eye, only LOD pixels. A bumpy surfel seen at an angle shows its relief in the wrong place: that may be `relief` pixels.
#include "common/surfel.clh"

// Of cones, which are twice as wide as the normals' deviation (clsurf/build/surfel_tree.py, CONE). Texels trim outlines
// (tile_surfels.cl), so that few surfels must: dragon 1024x1024 at 0.75 26.4 ms, at 0.35 24.5.
#define RIM 0.35f

__kernel void select_surfels(__global const float *view, __global const float *surfels, float interior, float relief, int begin,
                             int end, __global uchar *state) {
  int first = begin / VW * VW + get_global_id(0) * VW;
  if (first >= end) return;
  int from = first < begin ? begin - first : 0, to = end - first < VW ? end - first : VW, any = 0;
  for (int i = from; i < to; i++) any |= state[first + i];
  if (!any) return;
  VF field[10];
  for (int i = 0; i < VW; i++) {
    int at = first + (i < from ? from : i < to ? i : to - 1);
    for (int f = 0; f < 10; f++) ((float *)&field[f])[i] = surfels[(size_t)at * SURFEL_FLOATS + f];
  }
  VF x = field[0], y = field[1], z = field[2], nx = field[4], ny = field[5], nz = field[6];
  float scale = view[SCALE];
  VF X = scale * (view[0] * x + view[1] * y + view[2] * z) + view[OFFSET];
  VF Y = scale * (view[3] * x + view[4] * y + view[5] * z) + view[OFFSET + 1];
  VF depth = -(scale * (view[6] * x + view[7] * y + view[8] * z) + view[OFFSET + 2]);
  VF NXv = view[0] * nx + view[1] * ny + view[2] * nz, NYv = view[3] * nx + view[4] * ny + view[5] * nz;
  VF NZv = view[6] * nx + view[7] * ny + view[8] * nz;
  VF r = scale * field[S_RADIUS], sphere = scale * field[S_SPHERE];
  int perspective = view[PERSPECTIVE] > 0.0f;
  float fx = view[FX], fy = view[FY], f = fx > fy ? fx : fy;
  // Outside of the picture: beyond one of its sides, or nearer than anything is drawn.
  float left = view[CX], right = view[WIDTH] - view[CX], top = view[CY], bottom = view[HEIGHT] - view[CY];
  float slope = perspective ? 1.0f : 0.0f;
  VF d = perspective ? depth : (VF)(1.0f);
  VI out = (X * fx - right * d > sphere * sqrt(fx * fx + slope * right * right))
         | (-X * fx - left * d > sphere * sqrt(fx * fx + slope * left * left))
         | (Y * fy - top * d > sphere * sqrt(fy * fy + slope * top * top))
         | (-Y * fy - bottom * d > sphere * sqrt(fy * fy + slope * bottom * bottom))
         | (depth + sphere < view[NEAR]);
  VF distance2 = perspective ? X * X + Y * Y + depth * depth : (VF)(1.0f), facing = NZv;
  VF inverse = 1.0f / VSQRT(VMAX(distance2, (VF)(1e-30f)));
  if (perspective) facing = (NZv * depth - NXv * X - NYv * Y) * inverse;
  facing = VMAX(facing, -facing);
  VF spread = field[S_SPREAD];
  if (perspective) spread += r * inverse;
  VF most = SEL((VF)(interior), (VF)(view[LOD]), facing < RIM * spread);
  VF side2 = 1.0f - facing * facing;
  VF shift = scale * field[S_HEIGHT] * VSQRT(VMAX(side2, (VF)(0.0f)));
  VI small = (2.0f * f * r <= most * d) & (f * shift <= relief * d) & ((VI)(perspective ? 0 : TRUE_LANES) | (depth > r));
  const int *is_small = (const int *)&small, *is_out = (const int *)&out;
  for (int i = from; i < to; i++) {
    int at = first + i;
    if (state[at] != VISITED) continue;
    __global const int *s = (__global const int *)(surfels + (size_t)at * SURFEL_FLOATS);
    int flags = s[S_FLAGS];
    if (flags & IS_BASE) { state[at] = DRAWN; continue; }
    if (is_out[i]) { state[at] = UNSEEN; continue; }
    if (is_small[i] && view[LOD] > 0.0f) { state[at] = DRAWN; continue; }
    state[at] = flags & HAS_TRIANGLES ? BY_TRIANGLES : VISITED;
    uchar below = flags & IS_LAST ? DRAWN : VISITED;
    for (int c = s[S_CHILD]; c < s[S_CHILD] + s[S_CHILDREN]; c++) state[c] = below;
  }
}
