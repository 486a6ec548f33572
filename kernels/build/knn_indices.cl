// Indices and distances of the k nearest points of every query, nearest first.
//
// As pass 1 of knn_covariance, with every distance carrying its point along. Points at equal distance come in the order
// of the tree, so that the result is the same each time.
#include "build/knn_search.clh"

#ifndef CHUNKS
#define CHUNKS 1  // k up to 16 CHUNKS; k itself is an argument, because Intel's compiler takes seconds for this kernel
#endif

#define EXCHANGE_PAIR(da, ia, db, ib) { \
    VI later = (da > db) | ((da == db) & (ia > ib)); \
    VF d_ = SEL(da, db, later); db = SEL(db, da, later); da = d_; \
    VI i_ = SEL(ia, ib, later); ib = SEL(ib, ia, later); ia = i_; \
  }

// Merge the points of one leaf into the k nearest.
inline void consider(__global const float *leaf, int number, Queries *q, VF best[16 * CHUNKS], VI index[16 * CHUNKS]) {
  VF d[16];
  VI n[16];
  for (int j = 0; j < 16; j++) {
    VF x = q->x - leaf[j], y = q->y - leaf[16 + j], z = q->z - leaf[32 + j];
    d[j] = x * x + y * y + z * z, n[j] = 16 * number + j;
  }
#define EXCHANGE(i, j) EXCHANGE_PAIR(d[i], n[i], d[j], n[j])
  SORT_16(EXCHANGE)
  for (int c = 0; c < CHUNKS; c++) {
    VF *b = best + 16 * c;
    VI *m = index + 16 * c;
    if (!any_lane(d[0] < b[15])) continue;
    for (int i = 0; i < 16; i++) EXCHANGE_PAIR(b[i], m[i], d[15 - i], n[15 - i])
#define EXCHANGE_BEST(i, j) EXCHANGE_PAIR(b[i], m[i], b[j], m[j])
    MERGE_16(EXCHANGE_BEST)
    MERGE_16(EXCHANGE)
  }
}

__kernel void knn_indices(__global const VF *nodes, __global const float *leaves,
                          __global const uint *order,        // (count,) indices of the points along the curve
                          __global const float *queries,     // (blocks, 3, 16)
                          __global const uint *query_order,  // (query_count,) where results go
                          __global const uint *starts,       // (blocks,) a leaf near each block of queries
                          __global int *indices,             // (query_count, k), -1 for none
                          __global float *distances,         // (query_count, k), INFINITY for none
                          uint count, uint query_count, int k, int first_leaf, int leaf_count, float unit)
{
  uint first = get_global_id(0) * VW;
  if (first >= query_count) return;
  Queries q;
  load_queries(queries, first, query_count, &q);

  VF best[16 * CHUNKS];
  VI index[16 * CHUNKS];
  for (int i = 0; i < 16 * CHUNKS; i++) best[i] = FAR, index[i] = 0x7fffffff;
  int start = starts[first / 16];
  int low = start > CHUNKS ? start - CHUNKS : 0, high = start + CHUNKS < leaf_count ? start + CHUNKS : leaf_count - 1;
  // The leaves around the start come first, as a list like those that the walk notes: consider() is in line at one
  // place, which halves what compilers work on.
  Walk walk;
  walk.top = 1, walk.stack[0] = 0;
  int noted = high - low + 1, at_start = 1;
  for (int i = 0; i < noted; i++) walk.list[i] = low + i;
  while (true) {
    for (int i = 0; i < noted; i++) {
      int leaf = walk.list[i];
      if (!at_start && leaf >= low && leaf <= high) continue;
      if (any_lane(gap_to_leaf((__global const float *)nodes, first_leaf, leaf, &q) < best[k - 1]))
        consider(leaves + 48 * leaf, leaf, &q, best, index);
    }
    if (walk.top == 0) break;
    at_start = 0;
    noted = near_leaves(nodes, first_leaf, &q, largest_lane(best[k - 1]), &walk);
  }

  for (int i = 0; i < k; i++) {
    union { VF v; float s[VW]; } d;
    union { VI v; int s[VW]; } n;
    d.v = VSQRT(best[i]) * unit, n.v = index[i];
    for (uint j = 0; j < VW && first + j < query_count; j++) {
      uint at = query_order[first + j] * k + i;
      int found = (uint)n.s[j] < count;
      indices[at] = found ? (int)order[n.s[j]] : -1;
      distances[at] = found ? d.s[j] : INFINITY;
    }
  }
}
