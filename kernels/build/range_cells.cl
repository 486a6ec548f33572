// Which cells of a range image are surface: four samples, and no depth jump between any two of them.
//
// Two samples are torn apart where the line between them is steeper against the line of sight than `jump` to 1, unless
// the step is within `noise` (depth images: times the squared distance to the eye). The distance across the line of
// sight counts as at least half of `pitch`, and more than 3 `pitch` is a gap; 0: no such limits.
#include "build/range_cell.clh"

inline int torn(float4 p, float4 q, float4 eye, float jump, float noise, float pitch, int squared) {
  float4 e = q - p, v = eye - 0.5f * (p + q);
  float e2 = dot3(e, e), v2 = dot3(v, v), along = dot3(e, v);
  float along2 = along * along / v2, across2 = e2 - along2;
  float least = 0.25f * pitch * pitch;
  int gap = pitch > 0.0f && across2 > 9.0f * pitch * pitch;
  across2 = across2 > least ? across2 : least;
  float step = squared ? noise * v2 : noise;
  return gap || !(along2 <= jump * jump * across2 || along2 <= step * step);
}

__kernel void range_cells(int rows, int columns, int first, float eye_x, float eye_y, float eye_z, float jump,
                          float noise, float pitch, int squared, __global const float4 *samples,
                          __global uchar *cells) {
  int x = get_global_id(0), y = get_global_id(1);
  if (x >= columns || y >= rows) return;
  int k = first + y * columns + x, good = 0;
  if (x < columns - 1 && y < rows - 1) {
    float4 eye = (float4)(eye_x, eye_y, eye_z, 0.0f);
    float4 a = samples[k], b = samples[k + 1], c = samples[k + columns], d = samples[k + columns + 1];
    if (isfinite(a.z + b.z + c.z + d.z))
      good = !(torn(a, b, eye, jump, noise, pitch, squared) || torn(c, d, eye, jump, noise, pitch, squared)
               || torn(a, c, eye, jump, noise, pitch, squared) || torn(b, d, eye, jump, noise, pitch, squared)
               || torn(a, d, eye, jump, noise, pitch, squared) || torn(b, c, eye, jump, noise, pitch, squared));
  }
  cells[k] = good;
}
