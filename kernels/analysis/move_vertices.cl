// One step of vertices toward wanted normals of faces: each moves by the mean over its faces of n n.(c - x), which brings
// the faces' planes through their centroids c. Along normals only, so that outlines stay. Where a face of it is folded
// over, a vertex also moves within the surface, toward the mean of its faces' centroids.
// Source of the step: Sun, Rosin, Martin, Langbein, "Fast and Effective Feature-Preserving Mesh Denoising", 2007.
#ifndef FOLDED
#define FOLDED 0.5f // cosine between a face's own normal and the wanted one
#endif

// kind: 1 moves, 3 relaxes too, 0 stays. wanted: rows of 4 floats a face, unit normals.
__kernel void move_vertices(int count, __global const int *offset, __global const int *faces_of,
                            __global const int *faces, __global const float *wanted, __global const uchar *kind,
                            float relax, __global const float *from, __global float *to) {
  int v = get_global_id(0);
  if (v >= count) return;
  __global const float *own = from + 3 * (size_t)v;
  float x = own[0], y = own[1], z = own[2], mx = 0.0f, my = 0.0f, mz = 0.0f, tx = 0.0f, ty = 0.0f, tz = 0.0f;
  float nx = 0.0f, ny = 0.0f, nz = 0.0f;
  int first = offset[v], last = offset[v + 1], folded = 0;
  for (int i = first; i < last; ++i) {
    size_t f = faces_of[i];
    __global const float *n = wanted + 4 * f;
    __global const float *a = from + 3 * (size_t)faces[3 * f], *b = from + 3 * (size_t)faces[3 * f + 1],
                         *c = from + 3 * (size_t)faces[3 * f + 2];
    float px = b[0] - a[0], py = b[1] - a[1], pz = b[2] - a[2], qx = c[0] - a[0], qy = c[1] - a[1], qz = c[2] - a[2];
    float dx = a[0] + (px + qx) * (1.0f / 3.0f) - x, dy = a[1] + (py + qy) * (1.0f / 3.0f) - y,
          dz = a[2] + (pz + qz) * (1.0f / 3.0f) - z;
    float along = n[0] * dx + n[1] * dy + n[2] * dz;
    mx += along * n[0], my += along * n[1], mz += along * n[2];
    tx += dx, ty += dy, tz += dz, nx += n[0], ny += n[1], nz += n[2];
    float cx = py * qz - pz * qy, cy = pz * qx - px * qz, cz = px * qy - py * qx;
    folded |= cx * n[0] + cy * n[1] + cz * n[2] < FOLDED * sqrt(cx * cx + cy * cy + cz * cz);
  }
  __global float *o = to + 3 * (size_t)v;
  float share = last > first && kind[v] ? 1.0f / (float)(last - first) : 0.0f;
  float length2 = nx * nx + ny * ny + nz * nz;
  float slide = folded && kind[v] == 3 && length2 > 1e-12f ? relax * share : 0.0f;
  float along = slide > 0.0f ? (tx * nx + ty * ny + tz * nz) / length2 : 0.0f;
  o[0] = x + share * mx + slide * (tx - along * nx);
  o[1] = y + share * my + slide * (ty - along * ny);
  o[2] = z + share * mz + slide * (tz - along * nz);
}
