// A frame for every fragment of range images: the cells of its rectangle that carry its label.
//
// In: rectangles (image, first row, first column, rows, columns), images (first sample, columns, sign: 1 where rows x
// columns face the eye, else -1). Out, FRAGMENT floats each: cells, centre (3), unit normal (3), unit x (3), lengths of a
// step along rows and columns (2), share of the area that the normal leaves behind at `least` (1), extent along x, y and
// the normal around the centre (6: least x, most x, least y, ...), mean weight of its cells.
//
// x is along the rows of the image or y along its columns, whichever are stretched more by a slanted view: sheared
// cells then widen the extent least.
#include "build/range_cell.clh"
#define FRAGMENT 20

__kernel void fit_fragments(int count, __global const int *rectangles, __global const int *images, float least,
                            __global const float4 *samples, __global const int *labels, __global float *out) {
  int f = get_global_id(0);
  if (f >= count) return;
  __global const int *r = rectangles + 5 * f;
  int first = images[3 * r[0]], columns = images[3 * r[0] + 1];
  float sign = (float)images[3 * r[0] + 2];
  float4 center = (float4)(0.0f), normal = (float4)(0.0f), along = (float4)(0.0f), down = (float4)(0.0f);
  float cells = 0.0f, step_x = 0.0f, step_y = 0.0f, weight = 0.0f;
  // Sums relative to a corner of the rectangle's first own cell: far from the origin they would cancel.
  float4 base = (float4)(0.0f);
  for (int y = r[1]; y < r[1] + r[3]; y++)
    for (int x = r[2]; x < r[2] + r[4]; x++) {
      int k = first + y * columns + x;
      if (labels[k] != f) continue;
      float4 a = samples[k], b = samples[k + 1], c = samples[k + columns], d = samples[k + columns + 1];
      if (cells == 0.0f) base = a;
      float4 dx = 0.5f * (b - a + d - c), dy = 0.5f * (c - a + d - b);
      center += 0.25f * (a + b + c + d) - base;
      normal += sign * cell_area(samples, k, columns);
      along += dx;
      down += dy;
      step_x += sqrt(dot3(dx, dx));
      step_y += sqrt(dot3(dy, dy));
      weight += 0.25f * (a.w + b.w + c.w + d.w);
      cells += 1.0f;
    }
  __global float *o = out + FRAGMENT * f;
  center = base + center / cells;
  normal /= sqrt(dot3(normal, normal));
  normal.w = 0.0f;
  if (step_y > step_x) along = sign * cross3(down, normal);
  along -= dot3(along, normal) * normal;
  along.w = 0.0f;
  float length = sqrt(dot3(along, along));
  if (!(length > 1e-20f)) {  // rows that run along the normal: any direction serves
    along = fabs(normal.x) < 0.5f ? (float4)(0.0f, normal.z, -normal.y, 0.0f) : (float4)(-normal.z, 0.0f, normal.x, 0.0f);
    length = sqrt(dot3(along, along));
  }
  along /= length;
  float4 side = cross3(normal, along);
  float behind = 0.0f, all = 0.0f, x0 = 0.0f, x1 = 0.0f, y0 = 0.0f, y1 = 0.0f, z0 = 0.0f, z1 = 0.0f;
  for (int y = r[1]; y < r[1] + r[3]; y++)
    for (int x = r[2]; x < r[2] + r[4]; x++) {
      int k = first + y * columns + x;
      if (labels[k] != f) continue;
      float4 area = sign * cell_area(samples, k, columns);
      float size = sqrt(dot3(area, area));
      all += size;
      behind += dot3(area, normal) < least * size ? size : 0.0f;
      for (int c = 0; c < 4; c++) {
        float4 p = samples[k + (c & 1) + (c >> 1) * columns] - center;
        float u = dot3(p, along), v = dot3(p, side), w = dot3(p, normal);
        x0 = u < x0 ? u : x0; x1 = u > x1 ? u : x1;
        y0 = v < y0 ? v : y0; y1 = v > y1 ? v : y1;
        z0 = w < z0 ? w : z0; z1 = w > z1 ? w : z1;
      }
    }
  o[0] = cells;
  o[1] = center.x; o[2] = center.y; o[3] = center.z;
  o[4] = normal.x; o[5] = normal.y; o[6] = normal.z;
  o[7] = along.x; o[8] = along.y; o[9] = along.z;
  o[10] = step_x / cells; o[11] = step_y / cells; o[12] = behind / all;
  o[13] = x0; o[14] = x1; o[15] = y0; o[16] = y1;
  o[17] = z0; o[18] = z1;
  o[19] = weight / cells;
}
