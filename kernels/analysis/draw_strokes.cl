// Ink of strokes: every segment is a stroke with round ends whose half width runs linearly from one end to the other.
//
// A pixel takes the strongest ink of all strokes that touch it, so that joints leave no beads: the share of the pixel
// that a straight stroke covers, times the stroke's ink there, in 1 / 2^20, above the number of the colour (12 bits). A
// maximum does not depend on the order. One work-item per segment. Twin: tests/reference/lines.py.
__kernel void draw_strokes(int count, int width, int height, __global const float4 *points,
                           __global const int2 *segments, __global const int *colors, __global uint *ink) {
  int i = get_global_id(0);
  if (i >= count) return;
  float4 a = points[segments[i].x], b = points[segments[i].y];  // x, y, half width, ink
  float reach = (a.z > b.z ? a.z : b.z) + 0.5f;
  int x0 = (int)floor((a.x < b.x ? a.x : b.x) - reach), x1 = (int)floor((a.x > b.x ? a.x : b.x) + reach);
  int y0 = (int)floor((a.y < b.y ? a.y : b.y) - reach), y1 = (int)floor((a.y > b.y ? a.y : b.y) + reach);
  x0 = x0 > 0 ? x0 : 0; y0 = y0 > 0 ? y0 : 0;
  x1 = x1 < width ? x1 : width - 1; y1 = y1 < height ? y1 : height - 1;
  float dx = b.x - a.x, dy = b.y - a.y, length2 = dx * dx + dy * dy;
  for (int y = y0; y <= y1; y++)
    for (int x = x0; x <= x1; x++) {
      float px = x + 0.5f - a.x, py = y + 0.5f - a.y;
      float t = length2 > 0.0f ? (px * dx + py * dy) / length2 : 0.0f;
      t = t < 0.0f ? 0.0f : t > 1.0f ? 1.0f : t;
      float ex = px - t * dx, ey = py - t * dy, d = sqrt(ex * ex + ey * ey);
      float half_width = a.z + t * (b.z - a.z), tone = a.w + t * (b.w - a.w);
      // The stroke covers -half_width...half_width across, the pixel d - 0.5...d + 0.5.
      float upper = d + 0.5f < half_width ? d + 0.5f : half_width;
      float lower = d - 0.5f > -half_width ? d - 0.5f : -half_width, cover = upper - lower;
      if (cover > 0.0f)
        atomic_max(ink + (size_t)y * width + x, (uint)(cover * tone * 1048575.0f) << 12 | (uint)colors[i]);
    }
}
