// Hits in the frame of a traced surface as world distances, positions and normals, where they are nearer than what
// stands there; `fresh`: nothing stands there yet. Twin: clsurf.trace.single.finish_rays_host, which devices without
// float64 use.
#pragma OPENCL EXTENSION cl_khr_fp64 : enable

__kernel void finish_rays(int count, long first, __global const double *origins, int origin_step,
                          __global const double *directions, int direction_step, __global const double *place,
                          __global const double *starts, __global const float *hits, int surface, int fresh,
                          __global double *distances, __global double *positions, __global double *normals,
                          __global int *surfaces, __global int *primitives) {
  int i = get_global_id(0);
  if (i >= count) return;
  size_t n = (size_t)first + i;
  __global const float *hit = hits + (size_t)i * 8;
  double scale = place[12], distance = (starts[i] + hit[0]) * scale;
  if (!(hit[0] < INFINITY && (fresh || distance < distances[n]))) {
    if (!fresh) return;
    distances[n] = INFINITY;
    for (int a = 0; a < 3; a++) positions[3 * n + a] = normals[3 * n + a] = (double)NAN;
    surfaces[n] = primitives[n] = -1;
    return;
  }
  __global const double *o = origins + n * origin_step, *d = directions + n * direction_step;
  double x = d[0], y = d[1], z = d[2];
  double most = x < 0.0 ? -x : x;
  most = y > most ? y : -y > most ? -y : most;
  most = z > most ? z : -z > most ? -z : most;
  double part = most < 1e-100 ? 1e200 : most > 1e100 ? 1e-200 : 1.0;
  x *= part; y *= part; z *= part;
  double inverse = 1.0 / sqrt(x * x + y * y + z * z);
  x *= inverse; y *= inverse; z *= inverse;
  distances[n] = distance;
  positions[3 * n] = o[0] + distance * x;
  positions[3 * n + 1] = o[1] + distance * y;
  positions[3 * n + 2] = o[2] + distance * z;
  // The map's linear part is a rotation over the scale: its transpose turns back.
  double u = hit[1], v = hit[2], w = hit[3];
  double nx = place[0] * u + place[4] * v + place[8] * w, ny = place[1] * u + place[5] * v + place[9] * w;
  double nz = place[2] * u + place[6] * v + place[10] * w;
  double length = sqrt(nx * nx + ny * ny + nz * nz);
  double sign = nx * x + ny * y + nz * z > 0.0 ? -1.0 : 1.0;  // toward where the ray comes from
  double factor = length > 0.0 ? sign / length : 0.0;
  // A triangle without area: against the ray.
  normals[3 * n] = factor != 0.0 ? nx * factor : -x;
  normals[3 * n + 1] = factor != 0.0 ? ny * factor : -y;
  normals[3 * n + 2] = factor != 0.0 ? nz * factor : -z;
  surfaces[n] = surface;
  primitives[n] = as_int(hit[4]);
}
