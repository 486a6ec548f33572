// The rectangles around the points of regions in 16 orientations, and the range of their heights.
//
// One work-item walks over the points of a region; lanes are the orientations, angle k at k / 16 of a quarter turn from
// the x axis, which the unit normal gives (common/frame.clh).
#include "common/frame.clh"

__constant float COSINE[16] = {1.0f,         0.99518473f, 0.98078528f, 0.95694034f, 0.92387953f, 0.88192126f,
                               0.83146961f,  0.77301045f, 0.70710678f, 0.63439328f, 0.55557023f, 0.47139674f,
                               0.38268343f,  0.29028468f, 0.19509032f, 0.09801714f};

__kernel void region_extents(int regions,
                             __global const int *start,     // (regions + 1,) of each region in `order`
                             __global const int *order,     // places of points in `sorted`
                             int padded, __global const float *sorted,
                             __global const float *frame,   // (regions, 8): a place, the unit normal, 0, 0
                             __global float *out)           // (regions, 5, 16): low u, high u, low v, high v; heights
{
  int r = get_global_id(0);
  if (r >= regions) return;
  __global const float *f = frame + 8 * (size_t)r;
  float3 n = (float3)(f[3], f[4], f[5]), x, y;
  frame_of_normal(n, &x, &y);
  union { float16 v; float s[16]; } c, s;
  for (int k = 0; k < 16; ++k) c.s[k] = COSINE[k], s.s[k] = k ? COSINE[16 - k] : 0.0f;
  float16 low_u = INFINITY, high_u = -INFINITY, low_v = INFINITY, high_v = -INFINITY;
  float low_w = INFINITY, high_w = -INFINITY;
  for (int i = start[r]; i < start[r + 1]; ++i) {
    int p = order[i];
    float dx = sorted[p] - f[0], dy = sorted[padded + p] - f[1], dz = sorted[2 * (size_t)padded + p] - f[2];
    float a = dx * x.x + dy * x.y + dz * x.z, b = dx * y.x + dy * y.y + dz * y.z, w = dx * n.x + dy * n.y + dz * n.z;
    float16 u = c.v * a + s.v * b, v = c.v * b - s.v * a;
    low_u = u < low_u ? u : low_u;
    high_u = u > high_u ? u : high_u;
    low_v = v < low_v ? v : low_v;
    high_v = v > high_v ? v : high_v;
    low_w = w < low_w ? w : low_w;
    high_w = w > high_w ? w : high_w;
  }
  __global float16 *to = (__global float16 *)(out + 80 * (size_t)r);
  to[0] = low_u, to[1] = high_u, to[2] = low_v, to[3] = high_v, to[4] = low_w;
  out[80 * (size_t)r + 65] = high_w;
}
