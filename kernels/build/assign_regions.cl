// The nearest seed of every point: one round of Lloyd's iteration over points with normals.
//
// A seed is a place c and a unit normal m. The cost of a point p with normal n is
//   |d|^2 + flatness (d.m)^2 + bend (1 - n.m),  d = p - c,
// so that regions are flat, face one way, and the two sides of a thin sheet never share one. Seeds come in blocks of 16
// under boxes; a block is looked at where its box is nearer to the VW points than their worst best. Every point starts
// with the seed that it had, and the first one found wins a tie.
#include "common/lanes.clh"

inline float least_of(VF a) {
  union { VF v; float s[VW]; } lanes;
  lanes.v = a;
  float m = lanes.s[0];
  for (int j = 1; j < VW; ++j) m = lanes.s[j] < m ? lanes.s[j] : m;
  return m;
}
#define LARGEST_OF(a) (-least_of(-(a)))

__kernel void assign_regions(int count, int padded,
                             __global const float *sorted,     // x, y, z, normal x, y, z (padded each)
                             int seeds,
                             __global const float *seed,       // (seeds, 8): place, normal, 0, 0
                             __global const float *seed_boxes, // (ceil(seeds / 16), 8): low, high, 0, 0
                             float flatness, float bend,
                             __global int *label)              // (padded,), in and out
{
  int packet = get_global_id(0);
  if (packet * VW >= count) return;
  int stride = padded / VW;
  __global const VF *points = (__global const VF *)sorted + packet;
  VI spare = LANE_INDEX >= (VI)(count - VW * packet); // padding repeats the packet's first point
  VF x = SEL(points[0], (VF)sorted[VW * packet], spare);
  VF y = SEL(points[stride], (VF)sorted[padded + VW * packet], spare);
  VF z = SEL(points[2 * stride], (VF)sorted[2 * padded + VW * packet], spare);
  VF nx = points[3 * stride], ny = points[4 * stride], nz = points[5 * stride];
  float low_x = least_of(x), low_y = least_of(y), low_z = least_of(z);
  float high_x = LARGEST_OF(x), high_y = LARGEST_OF(y), high_z = LARGEST_OF(z);
  union { VI v; int s[VW]; } best;
  union { VF v; float s[VW]; } px, py, pz, pnx, pny, pnz, cost;
  best.v = ((__global VI *)label)[packet];
  px.v = x, py.v = y, pz.v = z, pnx.v = nx, pny.v = ny, pnz.v = nz;
  for (int j = 0; j < VW; ++j) {
    __global const float *c = seed + 8 * best.s[j];
    float dx = px.s[j] - c[0], dy = py.s[j] - c[1], dz = pz.s[j] - c[2], off = dx * c[3] + dy * c[4] + dz * c[5];
    float facing = pnx.s[j] * c[3] + pny.s[j] * c[4] + pnz.s[j] * c[5];
    cost.s[j] = dx * dx + dy * dy + dz * dz + flatness * off * off + bend * (1.0f - facing);
  }
  float worst = LARGEST_OF(cost.v);
  for (int block = 0; 16 * block < seeds; ++block) {
    __global const float *box = seed_boxes + 8 * block;
    float gx = VMAX(box[0] - high_x, low_x - box[3]), gy = VMAX(box[1] - high_y, low_y - box[4]);
    float gz = VMAX(box[2] - high_z, low_z - box[5]);
    gx = VMAX(gx, 0.0f), gy = VMAX(gy, 0.0f), gz = VMAX(gz, 0.0f);
    if (gx * gx + gy * gy + gz * gz >= worst) continue;
    int end = 16 * block + 16 < seeds ? 16 * block + 16 : seeds;
    for (int k = 16 * block; k < end; ++k) {
      __global const float *c = seed + 8 * k;
      gx = VMAX(c[0] - high_x, low_x - c[0]), gy = VMAX(c[1] - high_y, low_y - c[1]);
      gz = VMAX(c[2] - high_z, low_z - c[2]);
      gx = VMAX(gx, 0.0f), gy = VMAX(gy, 0.0f), gz = VMAX(gz, 0.0f);
      if (gx * gx + gy * gy + gz * gz >= worst) continue;
      VF dx = x - c[0], dy = y - c[1], dz = z - c[2], off = dx * c[3] + dy * c[4] + dz * c[5];
      VF facing = nx * c[3] + ny * c[4] + nz * c[5];
      VF total = dx * dx + dy * dy + dz * dz + flatness * off * off + bend * (1.0f - facing);
      VI better = total < cost.v;
      cost.v = SEL(cost.v, total, better);
      best.v = SEL(best.v, (VI)k, better);
      if (any_lane(better)) worst = LARGEST_OF(cost.v);
    }
  }
  ((__global VI *)label)[packet] = best.v;
}
