// Centres and radii of surfels as four arrays padded to whole blocks; what pads has the radius -1 and the last centre.
#define GUIDED_SURFEL 16

__kernel void guided_balls(int count, int padded, __global const float *surfels, __global float *balls) {
  int i = get_global_id(0);
  if (i >= padded) return;
  __global const float *o = surfels + GUIDED_SURFEL * (size_t)(i < count ? i : count - 1);
  for (int k = 0; k < 4; ++k) balls[k * (size_t)padded + i] = k == 3 && i >= count ? -1.0f : o[k];
}
