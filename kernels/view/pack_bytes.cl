// Linear premultiplied colours to opaque sRGB bytes, white behind what is transparent: a picture to show.
// One work-item per run of SPAN pixels. Twin: tests/reference/view.py, pack_bytes.
#ifndef SPAN
#define SPAN 1024
#endif
#ifndef LEVELS
#define LEVELS 4096
#endif

inline uchar byte_of(__global const uchar *table, float value) {
  float level = value * (LEVELS - 1) + 0.5f;
  return table[level > 0.0f ? level < LEVELS - 1 ? (int)level : LEVELS - 1 : 0];  // a NaN is black
}

__kernel void pack_bytes(__global const float4 *colors, int count, __global const uchar *table,
                         __global uchar4 *bytes) {
  int first = get_global_id(0) * SPAN, end = first + SPAN < count ? first + SPAN : count;
  for (int i = first; i < end; i++) {
    float4 c = colors[i];
    float white = 1.0f - c.w;
    bytes[i] = (uchar4)(byte_of(table, c.x + white), byte_of(table, c.y + white), byte_of(table, c.z + white), 255);
  }
}
