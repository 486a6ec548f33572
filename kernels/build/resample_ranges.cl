// Heights and colours of the nodes of patches from the cells of range images, one work-item a patch.
//
// First the cells of the patch's own fragment: each as two triangles, the highest where they fold. Then, up to MARGIN
// nodes beyond them and between, every image's cells that lie within the tolerance of what is already there; images
// blend by their samples' weights, less the farther they lie apart, so that all patches of a place agree on one surface.
// Nodes that no cell covers stay NaN.
//
// rects, 6 ints each: image, first row, first column, rows, columns, label of its cells that count (-1: of all); those of
// patch p start at first[p]: its surroundings in its own image, then fragments of other images, the images in order.
// images: first sample, columns, sign (1 where rows x columns face the eye, else -1).
//
// Drivers that end long loops get several launches for a patch: of one `only` pass (-1: both) with rects `begin` to `end`
// of each patch, the one with `last` ends the pass.
#include "build/patch_place.clh"
#ifndef COLORED
#define COLORED 0
#endif
#ifndef M
#define M 17  // nodes along x
#define N 17  // nodes along y
#endif
#ifndef MARGIN
#define MARGIN 2
#endif
#ifndef STEEPEST
#define STEEPEST 0.2f  // least cosine between a cell and the patch
#endif
#define STRIP 24  // columns of cells whose samples are kept at a time
#define NODES (M * N)
#define NOTHING -1e30f
// Planes of floats of a patch's scratch.
enum { REFERENCE, WEIGHT, HEIGHT, IMAGE_HEIGHT, IMAGE_WEIGHT, RED, GREEN, BLUE, IMAGE_RED, IMAGE_GREEN, IMAGE_BLUE };
#define PLANES (COLORED ? 11 : 5)

typedef struct { float u, v, h, w, r, g, b; } Corner;

inline void place_row(Corner *row, const Place *place, __global const float4 *samples, __global const uchar4 *colors,
                      int k, int count) {
  for (int i = 0; i < count; i++) {
    float4 p = samples[k + i], q = p - place->origin;
    Corner c;
    c.u = dot3(q, place->x); c.v = dot3(q, place->y); c.h = dot3(q, place->z); c.w = p.w;
#if COLORED
    uchar4 rgb = colors[k + i];
    c.r = rgb.x; c.g = rgb.y; c.b = rgb.z;
#endif
    row[i] = c;
  }
}

// The nodes in a triangle: own ones keep the highest, others what lies nearest to the reference.
inline void rasterise(__global float *s, const Corner *a, const Corner *b, const Corner *c, float sign, float xx,
                      float yy, float tolerance, int own, int fill_own) {
  float area = (b->u - a->u) * (c->v - a->v) - (b->v - a->v) * (c->u - a->u);
  if (!(sign * area > 0.0f)) return;
  float u0 = a->u < b->u ? a->u : b->u, u1 = a->u > b->u ? a->u : b->u;
  float v0 = a->v < b->v ? a->v : b->v, v1 = a->v > b->v ? a->v : b->v;
  u0 = c->u < u0 ? c->u : u0; u1 = c->u > u1 ? c->u : u1;
  v0 = c->v < v0 ? c->v : v0; v1 = c->v > v1 ? c->v : v1;
  if (!(u0 < (float)M && v0 < (float)N && u1 > -1.0f && v1 > -1.0f)) return;
  int i0 = u0 < 0.0f ? 0 : (int)(u0 - 1e-4f + 1.0f), i1 = u1 > (float)(M - 1) ? M - 1 : (int)(u1 + 1.0001f) - 1;
  int j0 = v0 < 0.0f ? 0 : (int)(v0 - 1e-4f + 1.0f), j1 = v1 > (float)(N - 1) ? N - 1 : (int)(v1 + 1.0001f) - 1;
  if (i0 > i1 || j0 > j1) return;
  float inverse = 1.0f / area;
  float hu = ((b->h - a->h) * (c->v - a->v) - (c->h - a->h) * (b->v - a->v)) * inverse;
  float hv = ((c->h - a->h) * (b->u - a->u) - (b->h - a->h) * (c->u - a->u)) * inverse;
  // xx and yy turn slopes over nodes into slopes over lengths.
  if (hu * hu * xx + hv * hv * yy > 1.0f / (STEEPEST * STEEPEST) - 1.0f) return;
  for (int j = j0; j <= j1; j++)
    for (int i = i0; i <= i1; i++) {
      float du = (float)i - a->u, dv = (float)j - a->v;
      float t = (du * (c->v - a->v) - dv * (c->u - a->u)) * inverse;
      float q = (dv * (b->u - a->u) - du * (b->v - a->v)) * inverse;
      if (t < -1e-4f || q < -1e-4f || t + q > 1.0001f) continue;  // neighbours share their edge's nodes
      int at = j * M + i;
      float h = a->h + hu * du + hv * dv, o = 1.0f - t - q;
      int to = IMAGE_HEIGHT * NODES + at;
      if (own) {
        if (!(h > s[to])) continue;
      } else {
        float reference = s[at];
        int taken = s[WEIGHT * NODES + at] > 0.0f && fill_own;
        float gap = fabs(h - reference);
        if (taken || !(gap < tolerance) || gap >= fabs(s[to] - reference)) continue;
      }
      s[to] = h;
      s[IMAGE_WEIGHT * NODES + at] = o * a->w + t * b->w + q * c->w;
#if COLORED
      s[IMAGE_RED * NODES + at] = o * a->r + t * b->r + q * c->r;
      s[IMAGE_GREEN * NODES + at] = o * a->g + t * b->g + q * c->g;
      s[IMAGE_BLUE * NODES + at] = o * a->b + t * b->b + q * c->b;
#endif
    }
}

inline void clear_image(__global float *s) {
  for (int at = 0; at < NODES; at++) s[IMAGE_HEIGHT * NODES + at] = NOTHING;
}

// Adds an image's heights to the sums.
inline void blend_image(__global float *s, float tolerance, int soft) {
  for (int at = 0; at < NODES; at++) {
    float h = s[IMAGE_HEIGHT * NODES + at];
    if (h <= NOTHING) continue;
    float t = soft ? (h - s[at]) / tolerance : 0.0f, near = 1.0f - t * t;
    float w = (s[IMAGE_WEIGHT * NODES + at] + 1e-6f) * near * near;
    s[WEIGHT * NODES + at] += w;
    s[HEIGHT * NODES + at] += w * h;
#if COLORED
    for (int c = 0; c < 3; c++) s[(RED + c) * NODES + at] += w * s[(IMAGE_RED + c) * NODES + at];
#endif
  }
}

// Continues the reference by a node on all sides: the mean over the eight directions of the line through the two nodes
// beyond, or of the next node alone. IMAGE_WEIGHT holds the rounds' numbers, so that a round sees the one before it.
inline void widen_reference(__global float *s, int round) {
  __global float *rounds = s + IMAGE_WEIGHT * NODES;
  for (int at = 0; at < NODES; at++) {
    if (s[at] > NOTHING) continue;
    int x = at % M, y = at / M;
    float sum = 0.0f, count = 0.0f, nearest = 0.0f, singles = 0.0f;
    for (int j = -1; j <= 1; j++)
      for (int i = -1; i <= 1; i++) {
        int x1 = x + i, y1 = y + j, x2 = x + 2 * i, y2 = y + 2 * j;
        if ((!i && !j) || x1 < 0 || x1 >= M || y1 < 0 || y1 >= N) continue;
        int one = y1 * M + x1, two = y2 * M + x2;
        if (!(s[one] > NOTHING && rounds[one] < (float)round)) continue;
        nearest += s[one];
        singles += 1.0f;
        if (x2 < 0 || x2 >= M || y2 < 0 || y2 >= N || !(s[two] > NOTHING && rounds[two] < (float)round)) continue;
        sum += 2.0f * s[one] - s[two];
        count += 1.0f;
      }
    if (!(singles > 0.0f)) continue;
    s[at] = count > 0.0f ? sum / count : nearest / singles;
    rounds[at] = (float)round;
  }
}

__kernel void resample_ranges(int count, int start, int only, int begin, int end, int last,
                              __global const float *places, __global const int *own_labels,
                              __global const int *first, __global const int *rects, __global const int *images,
                              __global const float4 *samples, __global const uchar *cells,
                              __global const int *labels, __global const uchar4 *colors, __global float *scratch,
                              __global float *heights, __global uchar4 *out_colors) {
  int item = get_global_id(0);
  if (item >= count) return;
  int p = start + item;
  Place place = place_of(places + PLACE * p);
  __global float *s = scratch + (long)item * PLANES * NODES;
  float xx = dot3(place.x, place.x), yy = dot3(place.y, place.y);
  if (only < 1 && begin == 0) {
    for (int at = 0; at < PLANES * NODES; at++) s[at] = 0.0f;
    clear_image(s);
  }
  int own_image = rects[6 * first[p]], rect_end = min(first[p] + end, first[p + 1]);
  Corner rows[2 * (STRIP + 1)];
  for (int pass = only == 1; pass <= (only != 0); pass++) {  // 0: the own fragment; 1: all other cells
    int image = begin > 0 ? rects[6 * (min(first[p] + begin, rect_end) - 1)] : -1;
    for (int r = first[p] + begin; r < rect_end; r++) {
      __global const int *rect = rects + 6 * r;
      if (!pass && rect[0] != own_image) break;
      if (pass && rect[0] != image && image >= 0) {
        blend_image(s, place.tolerance, image != own_image);
        clear_image(s);
      }
      image = rect[0];
      int base = images[3 * image], columns = images[3 * image + 1];
      float sign = (float)images[3 * image + 2];
      int last = rect[2] + rect[4];
      for (int x0 = rect[2]; x0 < last; x0 += STRIP) {
        int x1 = x0 + STRIP < last ? x0 + STRIP : last;
        for (int y = rect[1]; y <= rect[1] + rect[3]; y++) {
          // Rows of samples are placed over the patch once and serve the cells above and below.
          Corner *above = rows + (y & 1 ? 0 : STRIP + 1), *below = rows + (y & 1 ? STRIP + 1 : 0);
          place_row(below, &place, samples, colors, base + y * columns + x0, x1 - x0 + 1);
          if (y == rect[1]) continue;
          for (int x = x0; x < x1; x++) {
            int k = base + (y - 1) * columns + x;
            if (!cells[k] || (labels[k] == own_labels[p]) != !pass || (rect[5] >= 0 && labels[k] != rect[5])) continue;
            const Corner *a = above + x - x0, *b = below + x - x0;
            rasterise(s, a, a + 1, b + 1, sign, xx, yy, place.tolerance, !pass, image == own_image);
            rasterise(s, a, b + 1, b, sign, xx, yy, place.tolerance, !pass, image == own_image);
          }
        }
      }
    }
    if (!last) return;
    if (!pass) {
      blend_image(s, 1.0f, 0);
      for (int at = 0; at < NODES; at++) {
        s[at] = s[IMAGE_HEIGHT * NODES + at];
        s[IMAGE_WEIGHT * NODES + at] = 0.0f;
      }
      for (int round = 1; round <= MARGIN; round++) widen_reference(s, round);
      clear_image(s);
    } else if (image >= 0) {
      blend_image(s, place.tolerance, image != own_image);
    }
  }
  if (only == 0) return;
  for (int at = 0; at < NODES; at++) {
    float w = s[WEIGHT * NODES + at], inverse = w > 0.0f ? 1.0f / w : 0.0f;
    long to = (long)p * NODES + at;
    heights[to] = w > 0.0f ? s[HEIGHT * NODES + at] * inverse : NAN;
#if COLORED
    out_colors[to] = (uchar4)((uchar)(s[RED * NODES + at] * inverse + 0.5f), (uchar)(s[GREEN * NODES + at] * inverse + 0.5f),
                              (uchar)(s[BLUE * NODES + at] * inverse + 0.5f), w > 0.0f ? 255 : 0);
#endif
  }
}
