// From which cosine between disc and ray on all of a surfel's disc is seen, whatever its map: once, at the upload. One
// work-item looks through one map, VW texels at a time. Twin: tests/reference/surfels.py, plain_cosines.
//
// A texel whose normal is an angle a from the disc's is seen (tile_surfels.cl) where its cosine to the ray is over TRIM
// of the disc's. That holds at the worst where cos(t + a) > TRIM cos t, t between disc and ray. A texel that is not
// covered is never seen.
#include "common/surfel.clh"

#define NEVER 2.0f

__kernel void plain_cosines(int count, __global const uint *atlas, __global float *surfels) {
  int s = get_global_id(0);
  if (s >= count) return;
  __global float *surfel = surfels + (size_t)s * SURFEL_FLOATS;
  int size = as_int(surfel[S_FLAGS]) & MAP_SIZE_BITS, first = as_int(surfel[S_MAP]), texels = size * size;
  VF least = 1.0f;
  for (int part = 0; part < texels; part += VW) {
    VI k = LANE_INDEX + part;
    k = SEL(k, (VI)(texels - 1), k >= texels);
    VI row = k / size, column = k - row * size;
    VU code = gather_words(atlas, k + first);
    VF x, y, z;
    decode_normal(code, &x, &y, &z);
    VF along = (x * surfel[S_NORMAL] + y * surfel[S_NORMAL + 1] + z * surfel[S_NORMAL + 2])
             / VSQRT(x * x + y * y + z * z);
    along = SEL((VF)(-1.0f), along, AS_VI(code) < 0);  // the highest bit: covered
    // The corner of the texel next to the map's middle, in half texels: where it lies outside of the disc all does.
    // In floats, for which whole numbers like these are exact: Oclgrind has no magnitude of integers.
    VF across = TO_VF(2 * column + 1 - size), down = TO_VF(2 * row + 1 - size), none = 0.0f;
    across = VMAX(VMAX(across, -across) - 1.0f, none); down = VMAX(VMAX(down, -down) - 1.0f, none);
    least = VMIN(least, SEL((VF)(1.0f), along, across * across + down * down < (float)texels));
  }
  float cosine = 1.0f;
  for (int i = 0; i < VW; i++) {
    float own = ((const float *)&least)[i];
    cosine = own < cosine ? own : cosine;
  }
  surfel[S_PLAIN] = cosine > TRIM ? sqrt(1.0f - cosine * cosine) / sqrt(1.0f + TRIM * TRIM - 2.0f * TRIM * cosine) : NEVER;
}
