// One row a face: unit normal, area over the mean area, centroid, 0. Faces without area get the normal (0, 0, 0).
#define ROW 8

__kernel void guided_planes(int count, __global const int *faces, __global const float *vertices, float inverse_area,
                            __global float *rows) {
  int f = get_global_id(0);
  if (f >= count) return;
  __global const float *a = vertices + 3 * (size_t)faces[3 * (size_t)f];
  __global const float *b = vertices + 3 * (size_t)faces[3 * (size_t)f + 1];
  __global const float *c = vertices + 3 * (size_t)faces[3 * (size_t)f + 2];
  float px = b[0] - a[0], py = b[1] - a[1], pz = b[2] - a[2], qx = c[0] - a[0], qy = c[1] - a[1], qz = c[2] - a[2];
  float nx = py * qz - pz * qy, ny = pz * qx - px * qz, nz = px * qy - py * qx;
  float length = sqrt(nx * nx + ny * ny + nz * nz), k = length > 1e-30f ? 1.0f / length : 0.0f;
  __global float *row = rows + ROW * (size_t)f;
  row[0] = k * nx, row[1] = k * ny, row[2] = k * nz;
  row[3] = 0.5f * length * inverse_area;
  row[4] = a[0] + (px + qx) * (1.0f / 3.0f), row[5] = a[1] + (py + qy) * (1.0f / 3.0f),
  row[6] = a[2] + (pz + qz) * (1.0f / 3.0f), row[7] = 0.0f;
}
