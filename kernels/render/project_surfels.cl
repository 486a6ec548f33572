// Project the surfels of a list: their records (common/surfel.clh), the blocks of 4x4 pixels that their discs may touch,
// and their order from front to back. One work-item handles VW surfels. Twin: tests/reference/surfels.py,
// project_surfels.
#include "common/surfel.clh"
#include "common/bins.clh"
#include "common/blocks.clh"

#define EDGE 0.02f  // cosine of ray and plane below which a disc is seen as a line, and left out
#define BACK 0.25f  // radii that discs seen from behind are set back by: just past a silhouette they reach in front of it

#define LEAN 0.25f  // cosine of ray and plane that the depths of blended discs are held to

__kernel void project_surfels(__global const float *view, __global const float *surfels, __global const int *list,
                              int count, __global float *records, __global short4 *full, __global uint *keys,
                              __global ushort *buckets) {
  int first = get_global_id(0) * VW;
  if (first >= count) return;
  int lanes = count - first < VW ? count - first : VW;
#ifdef HAS_PREFETCH
  // What the next work-item reads, and what this one writes. Dragon 1024x1024, PoCL on AVX2: 2.4 to 2.1 ms.
  for (int i = 0; i < VW; i++) {
    int next = first + VW + i < count ? first + VW + i : count - 1;
    __builtin_prefetch((const void *)(size_t)(surfels + (size_t)list[next] * SURFEL_FLOATS));
    __builtin_prefetch((const void *)(size_t)(records + (size_t)(first + i) * RECORD_FLOATS), 1);
    __builtin_prefetch((const void *)(size_t)(records + (size_t)(first + i) * RECORD_FLOATS + LINE), 1);
  }
#endif
  VF field[SURFEL_FLOATS];
  for (int i = 0; i < VW; i++) {
    int at = list[first + (i < lanes ? i : lanes - 1)];
    for (int f = 0; f < SURFEL_FLOATS; f++) ((float *)&field[f])[i] = surfels[(size_t)at * SURFEL_FLOATS + f];
  }
  VF x = field[0], y = field[1], z = field[2], nx = field[4], ny = field[5], nz = field[6];
  float scale = view[SCALE], fx = view[FX], fy = view[FY];
  int perspective = view[PERSPECTIVE] > 0.0f;
  VF X = scale * (view[0] * x + view[1] * y + view[2] * z) + view[OFFSET];
  VF Y = scale * (view[3] * x + view[4] * y + view[5] * z) + view[OFFSET + 1];
  VF depth = -(scale * (view[6] * x + view[7] * y + view[8] * z) + view[OFFSET + 2]);
  VF r = scale * field[S_RADIUS], inv_r = 1.0f / r;
  // The frame of the normal (common/frame.clh in lanes), turned into view space.
  VF sign = SIGN_OF(nz);
  VF a = -1.0f / (sign + nz), b = nx * ny * a;
  VF ax = 1.0f + sign * nx * nx * a, ay = sign * b, az = -sign * nx;
  VF bx = b, by = sign + ny * ny * a, bz = -ny;
#define TURNED(row, p, q, s) (view[3 * row] * p + view[3 * row + 1] * q + view[3 * row + 2] * s)
  VF uX = TURNED(0, ax, ay, az), uY = TURNED(1, ax, ay, az), uZ = TURNED(2, ax, ay, az);
  VF vX = TURNED(0, bx, by, bz), vY = TURNED(1, bx, by, bz), vZ = TURNED(2, bx, by, bz);
  VF nX = TURNED(0, nx, ny, nz), nY = TURNED(1, nx, ny, nz), nZ = TURNED(2, nx, ny, nz);

  // The ray of the reference pixel is (dX, dY, -1) t, or (dX, dY, -t): through the middle of the disc, or, where that
  // lies behind the eye or beside it, straight on.
  VI ahead = perspective ? (depth > 0.5f * r) : (VI)(TRUE_LANES);
  VF inv_depth = 1.0f / SEL((VF)(1.0f), depth, ahead);
  VF dX = perspective ? SEL((VF)(0.0f), X * inv_depth, ahead) : X;
  VF dY = perspective ? SEL((VF)(0.0f), Y * inv_depth, ahead) : Y;
  VF plane = nX * X + nY * Y - nZ * depth;                        // n . P
  VF along = perspective ? nX * dX + nY * dY - nZ : -nZ;          // n . ray
  VF length2 = perspective ? dX * dX + dY * dY + 1.0f : (VF)(1.0f);
  // Perspective, disc ahead: the plane meets the reference ray at `depth`, whatever roundings say.
  VF plane_by_ray = SEL(plane, along * depth, ahead);
  VF inv_plane = perspective ? 1.0f / plane_by_ray : 1.0f / along;
  float ex = 1.0f / fx, ey = -1.0f / fy;
  VF out[RECORD_FLOATS];
  out[XR] = view[CX] + fx * dX; out[YR] = view[CY] - fy * dY;
  out[KX] = nX * inv_plane * ex; out[KY] = nY * inv_plane * ey;
  if (perspective) {
    VF pu = uX * X + uY * Y - uZ * depth, pv = vX * X + vY * Y - vZ * depth;
    out[K0] = SEL(along * inv_plane, inv_depth, ahead);
    out[U0] = SEL((uX * dX + uY * dY - uZ - pu * out[K0]) * inv_r, (VF)(0.0f), ahead);
    out[V0] = SEL((vX * dX + vY * dY - vZ - pv * out[K0]) * inv_r, (VF)(0.0f), ahead);
    out[UX] = (uX * ex - pu * out[KX]) * inv_r; out[UY] = (uY * ey - pu * out[KY]) * inv_r;
    out[VX] = (vX * ex - pv * out[KX]) * inv_r; out[VY] = (vY * ey - pv * out[KY]) * inv_r;
  } else {
    out[K0] = -depth; out[U0] = 0.0f; out[V0] = 0.0f;
    out[UX] = (uX * ex + uZ * out[KX]) * inv_r; out[UY] = (uY * ey + uZ * out[KY]) * inv_r;
    out[VX] = (vX * ex + vZ * out[KX]) * inv_r; out[VY] = (vY * ey + vZ * out[KY]) * inv_r;
  }
  VF magnitude = VMAX(plane_by_ray, -plane_by_ray), lean = VMAX(along, -along);
  out[SLAB] = scale * field[S_SLAB] / VMAX(perspective ? VMAX(magnitude, LEAN * depth) : VMAX(lean, (VF)(LEAN)), (VF)(1e-30f));
  out[BIAS] = BACK * r;
  out[NX] = nx; out[NY] = ny; out[NZ] = nz;
  out[MAP] = field[S_MAP];
  VI front = perspective ? plane_by_ray < 0.0f : along < 0.0f;
  out[FACE] = SEL((VF)(-1.0f), (VF)(1.0f), front);
  VI flags = AS_VI(field[S_FLAGS]);
  // Far enough from silhouettes no texel is trimmed (tile_surfels.cl); rays differ by the disc's width.
  VF steep = field[S_PLAIN];
  if (perspective) steep += r * inv_depth;
  VI plain = ((flags & IS_BASE) != 0) | (lean * lean > steep * steep * length2);
  out[FLAGS] = AS_VF(flags | SEL((VI)(0), (VI)(IS_PLAIN), plain));
  out[CORE2] = SEL((VF)(1.0f), (VF)(CORE * CORE), (flags & IS_BASE) != 0);

  // Bounds on the screen: x - middle = fx (m . q) / depth(q) with m = (1, 0, X / depth), q in the disc.
  VF tilt = 1.0f - nZ * nZ, reach = r * VSQRT(VMAX(tilt, (VF)(0.0f)));
  VF near = depth - reach, far = depth + reach;
  VI crosses = perspective ? (near < 1e-3f * r) : (VI)(0);
  VF inv_near = perspective ? 1.0f / VMAX(near, 1e-3f * r) : (VF)(1.0f);
  VF gX = perspective ? dX : (VF)(0.0f), gY = perspective ? dY : (VF)(0.0f);
  VF mx = nX + nZ * gX, my = nY + nZ * gY;
  VF wide2 = 1.0f + gX * gX - mx * mx, high2 = 1.0f + gY * gY - my * my;
  VF wide = fx * r * VSQRT(VMAX(wide2, (VF)(0.0f))) * inv_near + 0.03125f;  // 1/32 pixel covers float rounding
  VF high = fy * r * VSQRT(VMAX(high2, (VF)(0.0f))) * inv_near + 0.03125f;
  VF all = 1e9f;
  VI x0, x1, y0, y1;
  block_range(SEL(out[XR] - wide, -all, crosses), SEL(out[XR] + wide, all, crosses), view[WIDTH], &x0, &x1);
  block_range(SEL(out[YR] - high, -all, crosses), SEL(out[YR] + high, all, crosses), view[HEIGHT], &y0, &y1);
  VI edge = perspective ? ((along * along < EDGE * EDGE * length2) & ahead) | (magnitude < 1e-6f * r) : (lean < EDGE);
  VI shown = NOT(edge) & (far > view[NEAR]) & (r > 0.0f) & (x0 <= x1) & (y0 <= y1);
  VU bits = AS_VU(near);
  VU ordered = bits ^ SEL((VU)(0x80000000u), (VU)(0xffffffffu), AS_VI(bits) < 0);
  VF bucket = (near - view[FIRST_DEPTH]) * (1.0f / view[BUCKET_DEPTH]);
  bucket = VMIN(VMAX(bucket, (VF)(0.0f)), (VF)(DEPTH_BUCKETS - 1));
  VI bucket_number = TO_VI(bucket);
  const float *lane = (const float *)out;
#define LANE(v) (((const int *)&(v))[i])
  for (int i = 0; i < lanes; i++) {
    int at = first + i;
    if (!LANE(shown)) { full[at] = (short4)(1, 1, 0, 0); continue; }
    full[at] = (short4)(LANE(x0), LANE(y0), LANE(x1), LANE(y1));
    keys[at] = (uint)LANE(ordered) & 0xffffff00u;
    buckets[at] = (ushort)LANE(bucket_number);
    __global float *record = records + (size_t)at * RECORD_FLOATS;
    for (int f = 0; f < ID; f++) record[f] = lane[f * VW + i];
    record[ID] = as_float(list[at]);
  }
}
