// Lay the ink of `draw_strokes` over a picture (linear, premultiplied), in the colours of the palette (linear, opaque),
// and write the ink as a channel, 0 to 1. One work-item per SPAN pixels. Twin: tests/reference/lines.py.
#ifndef SPAN
#define SPAN 256
#endif
#ifndef PLAIN
#define PLAIN 0  // 1: over one colour, palette[0], instead of a picture
#endif

__kernel void blend_strokes(int pixels, __global const float4 *picture, __global const uint *ink,
                            __global const float4 *palette, __global float4 *color, __global float *lines) {
  int first = get_global_id(0) * SPAN;
  for (int i = first; i < first + SPAN && i < pixels; i++) {
    float4 under = PLAIN ? palette[0] : picture[i];
    float share = (float)(ink[i] >> 12) * (1.0f / 1048575.0f);
    color[i] = ink[i] ? under + share * (palette[ink[i] & 0xfff] - under) : under;
    lines[i] = share;
  }
}
