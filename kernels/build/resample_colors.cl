// Colours of the nodes of patches, from the faces their heights came from; one work-item a patch.
//
// Every node takes the mean of SAMPLES x SAMPLES samples (as many as the texture has texels in a cell) spread over one
// cell around it; samples beyond the face are moved onto it, so that none crosses a seam of the texture. Sums are linear
// light, weighted by alpha. Results are sRGB with straight alpha.
#include "build/patch_frame.clh"

#define VERTEX_COLORS 1
#define FACE_COLORS 2
#define TEXTURE 3
#ifndef SOURCE
#define SOURCE 1
#endif
#ifndef MOST_SAMPLES
#define MOST_SAMPLES 8  // along one direction
#endif

inline void add_texel(float4 *sum, float weight, __global const uchar *color, __global const float *linear) {
  float alpha = weight * color[3] * (1.0f / 255.0f);
  sum->x += alpha * linear[color[0]];
  sum->y += alpha * linear[color[1]];
  sum->z += alpha * linear[color[2]];
  sum->w += alpha;
}

// Texels repeat beyond the borders; texel centres are at +0.5, row 0 is at the top, v counts from the bottom.
inline void add_texture(float4 *sum, float weight, float u, float v, int width, int height,
                        __global const uchar *texture, __global const float *linear) {
  u -= floor(u);
  v -= floor(v);
  float x = u * width - 0.5f, y = (1.0f - v) * height - 0.5f, fx = floor(x), fy = floor(y);
  float rx = x - fx, ry = y - fy;
  int x0 = (int)fx < 0 ? width - 1 : (int)fx, x1 = x0 + 1 >= width ? 0 : x0 + 1;
  int y0 = (int)fy < 0 ? height - 1 : min((int)fy, height - 1), y1 = y0 + 1 >= height ? 0 : y0 + 1;
  add_texel(sum, weight * (1.0f - rx) * (1.0f - ry), texture + 4 * ((size_t)y0 * width + x0), linear);
  add_texel(sum, weight * rx * (1.0f - ry), texture + 4 * ((size_t)y0 * width + x1), linear);
  add_texel(sum, weight * (1.0f - rx) * ry, texture + 4 * ((size_t)y1 * width + x0), linear);
  add_texel(sum, weight * rx * ry, texture + 4 * ((size_t)y1 * width + x1), linear);
}

inline uchar srgb8(float value) {
  float s = value <= 0.0031308f ? 12.92f * value : 1.055f * pow(value, 1.0f / 2.4f) - 0.055f;
  return (uchar)(clamp(s, 0.0f, 1.0f) * 255.0f + 0.5f);
}

// Texels that one node step covers, at most.
inline float texels_a_step(const FlatTriangle *t, float area, __global const int *corners, __global const float *uv,
                           int width, int height) {
  if (area == 0.0f) return 1.0f;
  float step = 0.0f, ax = t->x[1] - t->x[0], ay = t->y[1] - t->y[0], bx = t->x[2] - t->x[0], by = t->y[2] - t->y[0];
  for (int c = 0; c < 2; c++) {
    float a = uv[2 * (size_t)corners[1] + c] - uv[2 * (size_t)corners[0] + c];
    float b = uv[2 * (size_t)corners[2] + c] - uv[2 * (size_t)corners[0] + c];
    float texels = c ? height : width;
    step = max(step, texels * max(fabs(a * by - b * ay), fabs(b * ax - a * bx)) / fabs(area));
  }
  return step;
}

// `color` holds 4 bytes a vertex or face, or the texture row by row; `uv` two floats a vertex; `linear` the light of the
// 256 sRGB values.
__kernel void resample_colors(int patches, __global const float *frames, __global const int *size,
                              __global const int *node_offset, __global const int *source, __global const int *faces,
                              __global const float *vertices, __global const uchar *color, int width, int height,
                              __global const float *uv, __global const float *linear, __global uchar *out) {
  int p = get_global_id(0);
  if (p >= patches) return;
  __global const float *frame = frames + FRAME_FLOATS * (size_t)p;
  int m = size[2 * p], n = size[2 * p + 1], first = node_offset[p];
  for (int k = first; k < first + m * n; k++) {
    __global uchar *node = out + 4 * (size_t)k;
    node[0] = node[1] = node[2] = node[3] = 0;
    if (source[k] < 0) continue;
    __global const int *corners = faces + 3 * (size_t)source[k];
    float4 sum = 0.0f;
    int samples = 1;
#if SOURCE == FACE_COLORS
    add_texel(&sum, 1.0f, color + 4 * (size_t)source[k], linear);
#else
    FlatTriangle t = flat_triangle(frame, vertices, corners);
    float area = doubled_area(&t), weight[3];
#if SOURCE == TEXTURE
    samples = clamp((int)ceil(texels_a_step(&t, area, corners, uv, width, height)), 1, MOST_SAMPLES);
#endif
    for (int s = 0; s < samples * samples; s++) {
      float x = (k - first) % m + (s % samples + 0.5f) / samples - 0.5f;
      float y = (k - first) / m + (s / samples + 0.5f) / samples - 0.5f;
      nearest_weights(&t, area, x, y, weight);
#if SOURCE == TEXTURE
      float u = 0.0f, v = 0.0f;
      for (int c = 0; c < 3; c++) {
        u += weight[c] * uv[2 * (size_t)corners[c]];
        v += weight[c] * uv[2 * (size_t)corners[c] + 1];
      }
      add_texture(&sum, 1.0f, u, v, width, height, color, linear);
#else
      for (int c = 0; c < 3; c++) add_texel(&sum, weight[c], color + 4 * (size_t)corners[c], linear);
#endif
    }
#endif
    float scale = sum.w > 0.0f ? 1.0f / sum.w : 0.0f;
    node[0] = srgb8(sum.x * scale);
    node[1] = srgb8(sum.y * scale);
    node[2] = srgb8(sum.z * scale);
    node[3] = (uchar)(clamp(sum.w / (samples * samples), 0.0f, 1.0f) * 255.0f + 0.5f);
  }
}
