// A surfel of degree 4 about each centre. One work-item per surfel; those that pad the last block get no radius.
//
// Where the ball holds fewer than NEED points it grows up to `limit` times; where they stay too few the degree sinks. A
// surfel without even a quadratic has no radius either: nothing is known there.
#include "analysis/quartic.clh"

#ifndef NEED
#define NEED 28 // points of a ball for degree 4
#endif
// Outliers: where the distances from a fit are beyond `plain` and their fourth moment shows a few large ones (3 is normal),
// the fit is made again without what lies beyond CUT of their root mean square.
#define HEAVY 8.0f
#define CUT 3.0f
#define ROUNDS 6
#define NEED_CUBIC 18
#define NEED_QUADRATIC 6
// A slope against the normal or a second-order term, over the radius, that no surface in such a ball has: of a few points in
// a clump, or not a number. The dragon has 23 vertices whose curvature is off by more than 1 over the spacing without this.
#define ASIDE 0.25f // height of the surface over its centre beyond which the centre is an outlier itself
#define STEEP 1.5f
#define BENT 6.0f
#define SURFEL 32 // floats out: centre, radius, normal, u, v, coefficients over the radius from 13, points

inline int is_wild(const float *k) {
  return !(k[1] * k[1] + k[2] * k[2] < STEEP * STEEP && k[3] * k[3] + k[4] * k[4] + k[5] * k[5] < BENT * BENT);
}

__kernel void fit_quartics(int surfels, int padded_surfels, __global const int *center,
                           __global const float *block_radius, float limit, float ridge3, float ridge4, float plain,
                           int padded, __global const float *sorted, __global const float *boxes,
                           __global const int *node_offset, int top_level, __global float *out, __global float *balls) {
  int s = get_global_id(0);
  if (s >= padded_surfels) return;
  size_t n = padded;
  int pads = s >= surfels, c = center[pads ? surfels - 1 : s];
  __global const float *own = sorted + c;
  float x = own[0], y = own[n], z = own[2 * n], radius = pads ? -1.0f : block_radius[c / 16];
  if (!pads) {
    Frame frame = frame_at(own[3 * n], own[4 * n], own[5 * n]), *f = &frame;
    Sums sums;
    float most = radius * limit, a[TERMS], inverse_cut2 = 0.0f;
    int terms;
    for (int round = 0; round < ROUNDS; ++round) {
      while (1) {
        sum_ball(&sums, a, inverse_cut2, f, x, y, z, radius, padded, sorted, boxes, node_offset, top_level);
        if (sums.count >= NEED || radius * 1.25f > most || round > 0) break;
        radius *= 1.25f;
      }
      terms = sums.count >= NEED ? 15 : sums.count >= NEED_CUBIC ? 10 : 6;
      for (int i = 6; i < terms; ++i) // a term of degree 3 or 4 that the points hardly show would be noise
        sums.row[i].s[i] += (i < 10 ? ridge3 : ridge4) * sums.row[0].s[0];
      float right[TERMS], left = sums.square;
      for (int i = 0; i < TERMS; ++i) right[i] = sums.row[i].s[15];
      float allowed = sums.row[0].s[0] * plain * plain / (radius * radius);
      eliminate(&sums, terms);
      solve(&sums, terms, a);
      for (int i = 0; i < TERMS; ++i) left -= a[i] * right[i]; // of the squared heights: rounded, but good enough here
      if (terms < TERMS || left < allowed) break; // too few points to tell which are wrong, or nothing is
      PF sum = 0.0f, sum2 = 0.0f, sum4 = 0.0f;
      EACH_NEAR(PF basis[TERMS]; basis_at(u, v, basis); PF e = distance_from(a, basis, w); PF e2 = e * e;
                if (inverse_cut2 > 0.0f) g *= weight_within(e, inverse_cut2);
                sum += g; sum2 += g * e2; sum4 += g * e2 * e2;)
      float all = sum_lanes(sum), square = sum_lanes(sum2) / all, fourth = sum_lanes(sum4) / all;
      if (!(fourth > HEAVY * square * square)) break;
      inverse_cut2 = 1.0f / (CUT * CUT * square);
    }
    __global float *o = out + SURFEL * (size_t)s;
    float k[TERMS], parts[13] = {x, y, z, radius, f->nx, f->ny, f->nz, f->ux, f->uy, f->uz, f->vx, f->vy, f->vz};
    to_monomials(a, k);
    if (is_wild(k) && terms > 6) { // the same elimination holds the quadratic
      solve(&sums, 6, a);
      to_monomials(a, k);
    }
    int known = sums.count >= NEED_QUADRATIC && !is_wild(k) && k[0] < ASIDE && k[0] > -ASIDE;
    for (int i = 0; i < 13; ++i) o[i] = parts[i];
    for (int i = 0; i < TERMS; ++i) o[13 + i] = k[i];
    o[28] = sums.count;
    o[29] = o[30] = o[31] = 0.0f;
    if (!known) radius = -1.0f;
  }
  size_t m = padded_surfels;
  balls[s] = x;
  balls[m + s] = y;
  balls[2 * m + s] = z;
  balls[3 * m + s] = radius;
}
