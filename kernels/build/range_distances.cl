// How far the samples of fragments lie from patches, one work-item a pair of a patch and a fragment.
//
// A byte for each corner of the cells in the fragment's rectangle: the root of the distance along the patch's axis over its
// tolerance, in hundredths; 127: farther, beside the patch, or not in question, which are those that are no corner of the fragment's
// cells, and every other one, as on a chess board. The highest bit: the patch goes on by `reach` nodes on all sides.
//
// pairs: patch, image, first row, first column, rows, columns, label. images: first sample, columns, sign.
#include "build/patch_place.clh"
#ifndef M
#define M 17
#define N 17
#endif
#define BESIDE 127

inline int drawn(__global const float *h, float u, float v) {
  if (!(u >= 0.0f && v >= 0.0f && u <= (float)(M - 1) && v <= (float)(N - 1))) return 0;
  int i = u < (float)(M - 1) ? (int)u : M - 2, j = v < (float)(N - 1) ? (int)v : N - 2;
  __global const float *c = h + j * M + i;
  return isfinite(c[0] + c[1] + c[M] + c[M + 1]);
}

__kernel void range_distances(int count, float reach, __global const float *places, __global const float *heights,
                              __global const int *pairs, __global const long *offsets, __global const int *images,
                              __global const float4 *samples, __global const int *labels, __global uchar *out) {
  int item = get_global_id(0);
  if (item >= count) return;
  __global const int *pair = pairs + 7 * item, *image = images + 3 * pair[1];
  Place place = place_of(places + PLACE * pair[0]);
  __global const float *h = heights + (long)pair[0] * M * N;
  __global uchar *to = out + offsets[item];
  for (int y = 0; y <= pair[4]; y++)
    for (int x = 0; x <= pair[5]; x++) {
      int k = image[0] + (pair[2] + y) * image[1] + pair[3] + x, code = BESIDE;
      int own = y < pair[4] && ((x < pair[5] && labels[k] == pair[6]) || (x > 0 && labels[k - 1] == pair[6]));
      int up = k - image[1];
      own |= y > 0 && ((x < pair[5] && labels[up] == pair[6]) || (x > 0 && labels[up - 1] == pair[6]));
      if (own && !((pair[2] + y + pair[3] + x) & 1)) {
        float4 q = samples[k] - place.origin;
        float u = dot3(q, place.x), v = dot3(q, place.y), d = dot3(q, place.z);
        if (drawn(h, u, v)) {
          int i = u < (float)(M - 1) ? (int)u : M - 2, j = v < (float)(N - 1) ? (int)v : N - 2;
          float s = u - (float)i, t = v - (float)j;
          __global const float *c = h + j * M + i;
          float there = (1.0f - t) * ((1.0f - s) * c[0] + s * c[1]) + t * ((1.0f - s) * c[M] + s * c[M + 1]);
          float distance = 100.0f * sqrt(fabs(d - there) / place.tolerance);
          if (distance <= 100.0f) {
            code = (int)ceil(distance);
            if (drawn(h, u - reach, v - reach) && drawn(h, u + reach, v - reach) && drawn(h, u - reach, v + reach)
                && drawn(h, u + reach, v + reach)) code |= 128;
          }
        }
      }
      to[y * (pair[5] + 1) + x] = code;
    }
}
