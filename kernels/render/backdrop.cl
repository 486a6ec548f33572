// Lay the picture's colours (linear, premultiplied) over what is behind everything: a colour for each row, a picture of the
// surroundings seen along the pixel's ray, or a picture that fills the frame. One work-item per SPAN pixels of a row.
// Twin: tests/reference/light.py, backdrop.
#include "render/texels.clh"
#include "common/view.clh"

#ifndef SPAN
#define SPAN 64
#endif
#define ROWS 0
#define SURROUNDINGS 1
#define FILLING 2
#ifndef KIND
#define KIND ROWS
#endif

// `turn`: 9 floats, view axes to the picture's axes, row by row, then its colour.
__kernel void backdrop(__global const float *view, __global const float *turn, __global const float4 *texels,
                       int texels_x, int texels_y, int width, int height, __global float4 *color) {
  int x0 = get_global_id(0) * SPAN, y = get_global_id(1);
  if (x0 >= width || y >= height) return;
  for (int x = x0; x < (x0 + SPAN < width ? x0 + SPAN : width); x++) {
    float4 front = color[(size_t)y * width + x], back;
    if (front.w >= 1.0f) continue;
#if KIND == ROWS
    back = texels[y];
#elif KIND == FILLING
    float across = (float)texels_x / width, down = (float)texels_y / height, scale = across < down ? across : down;
    float px = (x + 0.5f - 0.5f * width) * scale + 0.5f * texels_x - 0.5f;
    float py = (y + 0.5f - 0.5f * height) * scale + 0.5f * texels_y - 0.5f;
    px = clamp(px, 0.0f, texels_x - 1.0f); py = clamp(py, 0.0f, texels_y - 1.0f);
    back = bilinear(texels, texels_x, texels_y, px, py);
#else
    float vx = 0.0f, vy = 0.0f, vz = -1.0f;
    if (view[PERSPECTIVE] > 0.0f) { vx = (x + 0.5f - view[CX]) / view[FX]; vy = (view[CY] - (y + 0.5f)) / view[FY]; }
    float dx = turn[0] * vx + turn[1] * vy + turn[2] * vz, dy = turn[3] * vx + turn[4] * vy + turn[5] * vz;
    float dz = turn[6] * vx + turn[7] * vy + turn[8] * vz;
    float px = (atan2(dx, dz) * (0.5f / M_PI_F) + 0.5f) * texels_x - 0.5f;
    float py = atan2(sqrt(dx * dx + dz * dz), dy) * (1.0f / M_PI_F) * texels_y - 0.5f;
    py = clamp(py, 0.0f, texels_y - 1.0f);
    float left = floor(px), u = px - left;
    int i = ((int)left + texels_x) % texels_x, j = (int)py, next = i + 1 < texels_x ? i + 1 : 0;
    j = j < texels_y - 2 ? j : texels_y - 2;
    float v = py - j;
    __global const float4 *row = texels + (size_t)j * texels_x, *below = row + texels_x;
    float4 top = row[i] + u * (row[next] - row[i]), low = below[i] + u * (below[next] - below[i]);
    back = top + v * (low - top);
    back *= (float4)(turn[9], turn[10], turn[11], 1.0f);
#endif
    color[(size_t)y * width + x] = front + (1.0f - front.w) * back;
  }
}
