// One bilateral iteration on the normals of faces: means over the faces that share a vertex (those across an edge count
// twice), weighted by area, by distance, and by about exp(-sharp (1 - cosine)).
#define ROW 8 // floats a face: normal, area, centroid, 0 (guided_planes.cl)

__kernel void guided_normals(int count, __global const int *faces, __global const int *offset,
                             __global const int *faces_of, __global const float *rows, float inverse_width2,
                             float sharp, __global float *out) {
  int f = get_global_id(0);
  if (f >= count) return;
  __global const float *own = rows + ROW * (size_t)f;
  float nx = own[0], ny = own[1], nz = own[2], x = 0.0f, y = 0.0f, z = 0.0f;
  for (int k = 0; k < 3; ++k) {
    int v = faces[3 * (size_t)f + k];
    for (int i = offset[v]; i < offset[v + 1]; ++i) {
      __global const float *row = rows + ROW * (size_t)faces_of[i];
      float dx = row[4] - own[4], dy = row[5] - own[5], dz = row[6] - own[6];
      float turn = 1.0f - (nx * row[0] + ny * row[1] + nz * row[2]);
      // (1 - t / 8)^8 for the exponential: its call took four fifths of the kernel's time.
      float w = 1.0f - 0.125f * ((dx * dx + dy * dy + dz * dz) * inverse_width2 + sharp * turn);
      w = w > 0.0f ? w * w : 0.0f;
      w *= w;
      w *= w * row[3];
      x += w * row[0], y += w * row[1], z += w * row[2];
    }
  }
  float length2 = x * x + y * y + z * z;
  int usable = length2 > 1e-30f;
  float s = usable ? 1.0f / sqrt(length2) : 0.0f;
  __global float *to = out + ROW * (size_t)f;
  to[0] = usable ? s * x : nx, to[1] = usable ? s * y : ny, to[2] = usable ? s * z : nz;
  for (int k = 3; k < ROW; ++k) to[k] = own[k];
}
