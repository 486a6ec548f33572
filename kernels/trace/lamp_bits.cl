// The bits of a lamp that the rays of lamp_rays.cl found something on the way to: a work-item a point.
// Test: test_lamp_rays.
__kernel void lamp_bits(int count, int first, __global const int *pixels, __global const float *hits, int lamp,
                        __global uint *mask, int mask_stride, int mask_offset) {
  int i = get_global_id(0);
  if (i >= count || !(hits[(size_t)i * 8] < INFINITY)) return;
  int at = pixels[first + i];
  mask[(size_t)(at / 64) * mask_stride + mask_offset + at % 64] |= 1u << lamp;
}
