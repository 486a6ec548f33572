// Vertices that minimise the squared distances to the planes of their faces (quadric error, paper 003, section 4): planes
// through the projected centroids with the blended normals, plus a little of the distance from where the vertex was.
#ifndef STAY
#define STAY 0.02f // weight of the old place over the mean weight of the planes
#endif

// planes: rows of 4 floats a face, unit normal n and n.q of a point q of the plane, relative to the mesh's middle.
__kernel void place_vertices(int count, __global const int *offset, __global const int *faces_of,
                             __global const float *planes, __global const uchar *kind, __global const float *from,
                             __global float *to) {
  int v = get_global_id(0);
  if (v >= count) return;
  __global const float *own = from + 3 * (size_t)v;
  float x = own[0], y = own[1], z = own[2];
  int first = offset[v], last = offset[v + 1];
  float stay = STAY * (float)(last - first) + 1e-6f;
  float xx = stay, xy = 0.0f, xz = 0.0f, yy = stay, yz = 0.0f, zz = stay, bx = 0.0f, by = 0.0f, bz = 0.0f;
  for (int i = first; i < last; ++i) {
    __global const float *p = planes + 4 * (size_t)faces_of[i];
    float d = p[3] - (p[0] * x + p[1] * y + p[2] * z);
    xx += p[0] * p[0], xy += p[0] * p[1], xz += p[0] * p[2], yy += p[1] * p[1], yz += p[1] * p[2], zz += p[2] * p[2];
    bx += d * p[0], by += d * p[1], bz += d * p[2];
  }
  float cxx = yy * zz - yz * yz, cxy = xz * yz - xy * zz, cxz = xy * yz - xz * yy, cyy = xx * zz - xz * xz,
        cyz = xy * xz - xx * yz, czz = xx * yy - xy * xy;
  float k = kind[v] && last > first ? 1.0f / (xx * cxx + xy * cxy + xz * cxz) : 0.0f;
  __global float *o = to + 3 * (size_t)v;
  o[0] = x + k * (cxx * bx + cxy * by + cxz * bz);
  o[1] = y + k * (cxy * bx + cyy * by + cyz * bz);
  o[2] = z + k * (cxz * bx + cyz * by + czz * bz);
}
