// Covariance of the K nearest points of every query: its eigenvalues, the normal, and the distance to the K-th point.
//
// Pass 1 keeps only the K least squared distances, sorted across vectors (lanes are the queries): 16 new distances are
// sorted by a network and merged bitonically, nothing but minima and maxima. Pass 2 sums moments of everything up to
// the K-th distance. Points at the K-th distance itself, up to rounding, are all taken, so that the result does not
// depend on the order of the input.
#include "build/knn_search.clh"

#ifndef K
#define K 16
#endif
#define CHUNKS ((K + 15) / 16)
#define TIE 1.00001f  // squared distances this close count as equal

// Merge the distances of one leaf into the K least.
inline void consider(__global const float *leaf, Queries *q, VF best[16 * CHUNKS]) {
#define DISTANCE(j) VF d##j; { VF x = q->x - leaf[j], y = q->y - leaf[16 + j], z = q->z - leaf[32 + j]; d##j = x * x + y * y + z * z; }
  EACH_16(DISTANCE)
#define EXCHANGE(i, j) { VF least = VMIN(d##i, d##j); d##j = VMAX(d##i, d##j); d##i = least; }
  SORT_16(EXCHANGE)
#pragma unroll
  for (int c = 0; c < CHUNKS; c++) {
    VF *b = best + 16 * c;
    // Most leaves after the first few change no or only the last chunk (K = 48: 4.2 -> 7.0 M points/s, 16: 10 -> 12).
    if (!any_lane(d0 < b[15])) continue;
#if CHUNKS > 1
    // The larger halves go on to the next chunk.
#define LARGER(i) VF l##i; 
    EACH_16(LARGER)
#define KEEP_LARGER(i, j) l##i = VMAX(b[i], d##j);
    MIRROR_16(KEEP_LARGER)
#endif
#define KEEP_LEAST(i, j) b[i] = VMIN(b[i], d##j);
    MIRROR_16(KEEP_LEAST)
#define EXCHANGE_BEST(i, j) { VF least = VMIN(b[i], b[j]); b[j] = VMAX(b[i], b[j]); b[i] = least; }
    MERGE_16(EXCHANGE_BEST)
#if CHUNKS > 1
#define HAND_ON(i) d##i = l##i;
    EACH_16(HAND_ON)
    MERGE_16(EXCHANGE)
#endif
  }
}

typedef struct { VF n, x, y, z, xx, xy, xz, yy, yz, zz; } Moments;

// Add the points of one leaf that lie within `reach` (squared), relative to the query.
inline void add_leaf(__global const float *leaf, Queries *q, VF reach, Moments *m) {
  for (int j = 0; j < 16; j++) {
    VF x = leaf[j] - q->x, y = leaf[16 + j] - q->y, z = leaf[32 + j] - q->z;
    VI inside = x * x + y * y + z * z <= reach;
    x = SEL((VF)(0.0f), x, inside), y = SEL((VF)(0.0f), y, inside), z = SEL((VF)(0.0f), z, inside);
    m->n += SEL((VF)(0.0f), (VF)(1.0f), inside);
    m->x += x, m->y += y, m->z += z;
    m->xx += x * x, m->xy += x * y, m->xz += x * z, m->yy += y * y, m->yz += y * z, m->zz += z * z;
  }
}

// One Jacobi rotation that makes the off-diagonal element pq of a symmetric 3x3 matrix zero; r is the third index.
#define ROTATE(pp, qq, pq, pr, qr, vp, vq) { \
    VF h = 0.5f * (qq - pp); \
    VF root = VSQRT(h * h + pq * pq); \
    VF down = SEL(root, -root, h < 0.0f) + h; \
    VI still = down == 0.0f; \
    VF t = SEL(pq / SEL(down, (VF)(1.0f), still), (VF)(0.0f), still); \
    VF c = 1.0f / VSQRT(1.0f + t * t), s = t * c; \
    pp -= t * pq, qq += t * pq, pq = 0.0f; \
    VF r1 = c * pr - s * qr; qr = s * pr + c * qr; pr = r1; \
    for (int a = 0; a < 3; a++) { VF v1 = c * vp[a] - s * vq[a]; vq[a] = s * vp[a] + c * vq[a]; vp[a] = v1; } \
  }
#define SWAP_IF(c, p, q) { VF t = SEL(p, q, c); q = SEL(q, p, c); p = t; }

__kernel void knn_covariance(__global const VF *nodes, __global const float *leaves,
                             __global const float *queries,      // (blocks, 3, 16)
                             __global const uint *query_order,   // (query_count,) where results go
                             __global const uint *starts,        // (blocks,) a leaf near each block of queries
                             __global float *normals,            // (query_count, 3)
                             __global float *eigenvalues,        // (query_count, 3), ascending, world units squared
                             __global float *reaches,            // (query_count,) distance to the K-th point
                             uint query_count, int first_leaf, int leaf_count, float unit)
{
  uint first = get_global_id(0) * VW;
  if (first >= query_count) return;
  Queries q;
  load_queries(queries, first, query_count, &q);

  VF best[16 * CHUNKS];
  for (int i = 0; i < 16 * CHUNKS; i++) best[i] = FAR;
  int start = starts[first / 16];
  int low = start > CHUNKS ? start - CHUNKS : 0, high = start + CHUNKS < leaf_count ? start + CHUNKS : leaf_count - 1;
  for (int leaf = low; leaf <= high; leaf++) consider(leaves + 48 * leaf, &q, best);
  Walk walk;
  walk.top = 1, walk.stack[0] = 0;
  int noted, walks = 0;
  do {
    noted = near_leaves(nodes, first_leaf, &q, largest_lane(best[K - 1]), &walk);
    walks++;
    for (int i = 0; i < noted; i++) {
      int leaf = walk.list[i];
      if (leaf >= low && leaf <= high) continue;
      if (any_lane(gap_to_leaf((__global const float *)nodes, first_leaf, leaf, &q) < best[K - 1]))
        consider(leaves + 48 * leaf, &q, best);
    }
  } while (walk.top > 0);

  VF reach = best[K - 1] * TIE;
  reach = SEL(reach, (VF)(FAR), reach > FAR);
  Moments m = {0};
  walk.top = walks > 1, walk.stack[0] = 0;
  do {
    if (walks > 1) noted = near_leaves(nodes, first_leaf, &q, largest_lane(reach) * TIE, &walk);
    for (int i = 0; i < noted; i++)
      if (any_lane(gap_to_leaf((__global const float *)nodes, first_leaf, walk.list[i], &q) <= reach))
        add_leaf(leaves + 48 * walk.list[i], &q, reach, &m);
  } while (walk.top > 0);

  VF count = SEL(m.n, (VF)(1.0f), m.n < 1.0f), inverse = 1.0f / count;
  m.x *= inverse, m.y *= inverse, m.z *= inverse;
  VF xx = m.xx * inverse - m.x * m.x, yy = m.yy * inverse - m.y * m.y, zz = m.zz * inverse - m.z * m.z;
  VF xy = m.xy * inverse - m.x * m.y, xz = m.xz * inverse - m.x * m.z, yz = m.yz * inverse - m.y * m.z;
  // Divided by the trace, the squares of tiny covariances do not vanish.
  VF trace = xx + yy + zz;
  trace = SEL(trace, (VF)(1.0e-37f), trace < 1.0e-37f);
  inverse = 1.0f / trace;
  xx *= inverse, yy *= inverse, zz *= inverse, xy *= inverse, xz *= inverse, yz *= inverse;
  VF u[3] = {1.0f, 0.0f, 0.0f}, v[3] = {0.0f, 1.0f, 0.0f}, w[3] = {0.0f, 0.0f, 1.0f};
  for (int sweep = 0; sweep < 4; sweep++) {
    ROTATE(xx, yy, xy, xz, yz, u, v)
    ROTATE(xx, zz, xz, xy, yz, u, w)
    ROTATE(yy, zz, yz, xy, xz, v, w)
  }
  VI swap = yy < xx;
  SWAP_IF(swap, xx, yy)
  for (int a = 0; a < 3; a++) u[a] = SEL(u[a], v[a], swap);
  swap = zz < xx;
  VF largest = VMAX(yy, zz), middle = VMIN(yy, zz);
  for (int a = 0; a < 3; a++) u[a] = SEL(u[a], w[a], swap);
  VF least = SEL(xx, zz, swap);
  middle = SEL(middle, VMIN(xx, yy), swap), largest = SEL(largest, VMAX(xx, yy), swap);
  inverse = 1.0f / VSQRT(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
  VI flip = (u[2] < 0.0f) | ((u[2] == 0.0f) & ((u[1] < 0.0f) | ((u[1] == 0.0f) & (u[0] < 0.0f))));
  inverse = SEL(inverse, -inverse, flip);

  // Rounding may leave eigenvalues of nothing below 0.
  least = SEL(least, (VF)(0.0f), least < 0.0f), middle = SEL(middle, (VF)(0.0f), middle < 0.0f);
  trace *= unit * unit;
  union { VF v; float s[VW]; } out[7];
  for (int a = 0; a < 3; a++) out[a].v = u[a] * inverse;
  out[3].v = least * trace, out[4].v = middle * trace, out[5].v = largest * trace;
  out[6].v = VSQRT(best[K - 1]) * unit;
  for (uint j = 0; j < VW && first + j < query_count; j++) {
    uint i = query_order[first + j];
    for (int a = 0; a < 3; a++) normals[3 * i + a] = out[a].s[j], eigenvalues[3 * i + a] = out[3 + a].s[j];
    reaches[i] = out[6].s[j];
  }
}
