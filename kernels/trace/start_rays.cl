// Rays of the world in the frame of a traced surface: unit directions, clipped to the surface's box, so that float32
// holds what is left. Twin: clsurf.trace.single.start_rays_host, which devices without float64 use.
//
// `place`: 12 numbers, row by row the affine map of the world to the frame; the length of one unit of the frame in the
// world. `box`: least and largest x, y, z. Steps are 0 where one vector or limit serves all rays.
#pragma OPENCL EXTENSION cl_khr_fp64 : enable

// Where the ray o + t d, from t = *near to *far, is inside the box along one axis.
inline void clip(double o, double d, double least, double largest, double *near, double *far) {
  if (d == 0.0) {
    if (!(o >= least && o <= largest)) *far = -1.0;
    return;
  }
  double inverse = 1.0 / d, a = (least - o) * inverse, b = (largest - o) * inverse;
  double enters = a < b ? a : b, leaves = a < b ? b : a;
  *near = enters > *near ? enters : *near;
  *far = leaves < *far ? leaves : *far;
}

__kernel void start_rays(int count, long first, __global const double *origins, int origin_step,
                         __global const double *directions, int direction_step, __global const double *nearest,
                         int nearest_step, __global const double *farthest, int farthest_step,
                         __global const double *distances, int limited, __global const double *place,
                         __global const double *box, __global float *rays, __global double *starts) {
  int i = get_global_id(0);
  if (i >= count) return;
  size_t n = (size_t)first + i;
  __global const double *o = origins + n * origin_step, *d = directions + n * direction_step;
  double x = d[0], y = d[1], z = d[2];
  double most = x < 0.0 ? -x : x;
  most = y > most ? y : -y > most ? -y : most;
  most = z > most ? z : -z > most ? -z : most;
  double part = most < 1e-100 ? 1e200 : most > 1e100 ? 1e-200 : 1.0;  // so that squares stay numbers
  x *= part; y *= part; z *= part;
  double inverse = 1.0 / sqrt(x * x + y * y + z * z), scale = place[12];
  x *= inverse * scale; y *= inverse * scale; z *= inverse * scale;
  double dx = place[0] * x + place[1] * y + place[2] * z, dy = place[4] * x + place[5] * y + place[6] * z;
  double dz = place[8] * x + place[9] * y + place[10] * z;
  double ox = place[0] * o[0] + place[1] * o[1] + place[2] * o[2] + place[3];
  double oy = place[4] * o[0] + place[5] * o[1] + place[6] * o[2] + place[7];
  double oz = place[8] * o[0] + place[9] * o[1] + place[10] * o[2] + place[11];
  double near = nearest[n * nearest_step], far = farthest[n * farthest_step];
  near = near > 0.0 ? near / scale : 0.0;
  far = limited && distances[n] < far ? distances[n] / scale : far / scale;
  clip(ox, dx, box[0], box[3], &near, &far);
  clip(oy, dy, box[1], box[4], &near, &far);
  clip(oz, dz, box[2], box[5], &near, &far);
  // All false for what is not a number.
  int good = near <= far && dx * dx + dy * dy + dz * dz > 0.5 && ox - ox + (oy - oy) + (oz - oz) == 0.0;
  __global float *ray = rays + (size_t)i * 8;
  ray[0] = good ? (float)(ox + near * dx) : 0.0f;
  ray[1] = good ? (float)(oy + near * dy) : 0.0f;
  ray[2] = good ? (float)(oz + near * dz) : 0.0f;
  ray[3] = 0.0f;
  ray[4] = good ? (float)dx : 1.0f; ray[5] = good ? (float)dy : 0.0f; ray[6] = good ? (float)dz : 0.0f;
  ray[7] = good ? (float)(far - near) : -1.0f;
  starts[i] = near;
}
