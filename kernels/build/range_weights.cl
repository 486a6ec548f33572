// The weight of every sample where range images overlap, put into its fourth component: samples an area (unit^2) times
// the cosine between normal and line of sight, falling to the image's borders and jumps over `ramp` samples.
#include "build/range_cell.clh"

__kernel void range_weights(int rows, int columns, int first, float eye_x, float eye_y, float eye_z, float unit,
                            float ramp, __global const uchar *cells, __global const uchar *border,
                            __global float4 *samples) {
  int x = get_global_id(0), y = get_global_id(1);
  if (x >= columns || y >= rows) return;
  int k = first + y * columns + x;
  float4 total = (float4)(0.0f);
  int count = 0;
  for (int j = -1; j <= 0; j++)
    for (int i = -1; i <= 0; i++) {
      int at = k + j * columns + i;
      if (x + i < 0 || y + j < 0 || !cells[at]) continue;
      total += cell_area(samples, at, columns);
      count++;
    }
  if (!count) return;
  float4 v = (float4)(eye_x, eye_y, eye_z, 0.0f) - place_at(samples, k);
  float area = sqrt(dot3(total, total)), facing = fabs(dot3(total, v)) / (sqrt(dot3(v, v)) * area);
  float edge = ((float)border[k] + 0.5f) / ramp;
  edge = edge < 1.0f ? edge : 1.0f;
  float density = unit * unit * (float)count / area;
  ((__global float *)(samples + k))[3] = area > 0.0f ? edge * edge * facing * (density < 4.0f ? density : 4.0f) : 0.0f;
}
