// One round of planting the wide tree (clsurf/trace/tree.py): every part of the primitives is divided in two where the
// surface area of both halves' boxes, each times what lies in it, is least, as BINS bins along each axis tell it;
// Wald, "On fast construction of SAH-based bounding volume hierarchies", RT 2007. The bottom nodes are filled up: the
// first half takes a multiple of WIDE, and no half more than its nodes hold. A work-item for each part. Twin:
// tests/reference/trace_tree.py, split_nodes.
//
// A part is 3 numbers: where it starts in the order, how many primitives it has, and bottom nodes to put them in;
// `full` nodes are below one root, and whole roots are told apart first. Its halves follow in the next round's parts.
#include "common/lanes.clh"

#define WIDE 16
#define BINS 32

typedef struct { float4 low, high; int count; } Bin;

#define LESSER(a, b) ((a) < (b) ? (a) : (b))
#define GREATER(a, b) ((a) > (b) ? (a) : (b))

INLINE Bin no_bin() {
  Bin b = {(float4)(1e30f), (float4)(-1e30f), 0};
  return b;
}
INLINE void join(Bin *a, const Bin *b) {
  a->low = LESSER(a->low, b->low); a->high = GREATER(a->high, b->high); a->count += b->count;
}
INLINE float area(const Bin *b) {
  float x = b->high.x - b->low.x, y = b->high.y - b->low.y, z = b->high.z - b->low.z;
  return x * y + y * z + z * x;
}
INLINE float of_axis(float4 v, int axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }
INLINE int bin_of(float at, float least, float scale) {
  int bin = (int)((at - least) * scale);
  return bin < 0 ? 0 : bin >= BINS ? BINS - 1 : bin;
}
INLINE int within(int x, int least, int most) { return x < least ? least : x > most ? most : x; }

INLINE float key_of(__global const float4 *low, __global const float4 *high, int i, int axis) {
  return of_axis(low[i], axis) + of_axis(high[i], axis);
}

// Put the root of a heap, the largest (key, then place in `items`' numbers) on top, where it belongs.
INLINE void sift(__global int *items, __global float *keys, int root, int count) {
  int item = items[root];
  float key = keys[root];
  for (int child; (child = 2 * root + 1) < count; root = child) {
    if (child + 1 < count && (keys[child + 1] > keys[child]
                              || (keys[child + 1] == keys[child] && items[child + 1] > items[child]))) child++;
    if (keys[child] < key || (keys[child] == key && items[child] < item)) break;
    items[root] = items[child]; keys[root] = keys[child];
  }
  items[root] = item; keys[root] = key;
}

INLINE void sort_by_key(__global int *items, __global float *keys, int count) {
  for (int root = count / 2 - 1; root >= 0; root--) sift(items, keys, root, count);
  for (int last = count - 1; last > 0; last--) {
    int item = items[0]; float key = keys[0];
    items[0] = items[last]; keys[0] = keys[last];
    items[last] = item; keys[last] = key;
    sift(items, keys, 0, last);
  }
}

__kernel void split_nodes(int parts, int full, __global const int *from, __global const int *order_from,
                          __global const float4 *low, __global const float4 *high, __global int *to,
                          __global int *order_to, __global int *rest, __global float *keys) {
  int part = get_global_id(0);
  if (part >= parts) return;
  int start = from[3 * part], count = from[3 * part + 1], room = from[3 * part + 2];
  __global const int *items = order_from + start;
  __global int *out = order_to + start;
  to += 6 * part; rest += start; keys += start;
  int left = room > full ? (room / full + 1) / 2 * full : (room + 1) / 2;
  int least = count - WIDE * (room - left) > 0 ? count - WIDE * (room - left) : 0;
  int most = count < WIDE * left ? count : WIDE * left, first = most;
  int axis = -1, border = 0;
  float origin = 0.0f, scale = 0.0f;
  if (count > WIDE && room > 1) {
    first = within((count / WIDE * left / room) * WIDE, least, most);
    float4 c0 = (float4)(1e30f), c1 = (float4)(-1e30f);
    for (int i = 0; i < count; i++) {
      float4 c = low[items[i]] + high[items[i]];
      c0 = LESSER(c0, c); c1 = GREATER(c1, c);
    }
    Bin bins[3][BINS];
    float scales[3];
    for (int a = 0; a < 3; a++) {
      float reach = of_axis(c1, a) - of_axis(c0, a);
      scales[a] = reach > 0.0f ? BINS * (1.0f - 1e-6f) / reach : 0.0f;
      for (int b = 0; b < BINS; b++) bins[a][b] = no_bin();
    }
    for (int i = 0; i < count; i++) {
      Bin own = {low[items[i]], high[items[i]], 1};
      float4 c = own.low + own.high;
      join(&bins[0][bin_of(c.x, c0.x, scales[0])], &own);
      join(&bins[1][bin_of(c.y, c0.y, scales[1])], &own);
      join(&bins[2][bin_of(c.z, c0.z, scales[2])], &own);
    }
    float best = INFINITY;
    for (int a = 0; a < 3; a++) {
      if (!(scales[a] > 0.0f) || !(scales[a] < INFINITY)) continue;
      Bin after[BINS], before = no_bin();
      after[BINS - 1] = bins[a][BINS - 1];
      for (int b = BINS - 2; b >= 0; b--) { after[b] = bins[a][b]; join(&after[b], &after[b + 1]); }
      for (int b = 1; b < BINS; b++) {
        join(&before, &bins[a][b - 1]);
        // Outside of what the nodes hold, the border next to it stands for a division of the bin between.
        int k = within(before.count, least, most), out_of_reach = k > before.count ? k - before.count : before.count - k;
        if (before.count == 0 || before.count == count || out_of_reach > bins[a][k < before.count ? b - 1 : b].count)
          continue;
        float cost = area(&before) * k + area(&after[b]) * (count - k);
        if (cost < best) {
          best = cost; axis = a; origin = of_axis(c0, a); scale = scales[a];
          first = within((k + WIDE / 2) / WIDE * WIDE, least, most);
        }
      }
    }
    if (axis >= 0) {  // the bin that the division goes through
      int before = 0;
      while (before + bins[axis][border].count < first) before += bins[axis][border++].count;
    }
  }
  to[0] = start; to[1] = first; to[2] = left;
  to[3] = start + first; to[4] = count - first; to[5] = room - left;
  if (axis < 0) {
    for (int i = 0; i < count; i++) out[i] = items[i];
    return;
  }
  int l = 0, r = count, middle = 0;
  for (int i = 0; i < count; i++) {
    int item = items[i];
    float key = key_of(low, high, item, axis);
    int bin = bin_of(key, origin, scale);
    if (bin == border) { rest[middle] = item; keys[middle++] = key; }
    else if (bin < border) out[l++] = item;
    else out[--r] = item;
  }
  if (l < first && l + middle > first) sort_by_key(rest, keys, middle);
  for (int i = 0; i < middle; i++) out[l++] = rest[i];
}
