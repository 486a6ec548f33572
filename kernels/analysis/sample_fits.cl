// Fits of degree 2 and 4 around samples, each with several radii: what the two-degree risk compares (analysis/risk.py).
// One work-item per sample and radius.
#include "analysis/quartic.clh"

#ifndef RESIDUAL
#define RESIDUAL 0 // 1: the mean square residual of the degree-3 fit, for the noise
#endif
#define OUT 6 // floats out: points, mean curvatures of degree 2 and 4, heights of degree 2 and 4, squared residual

// `all_radii` holds `radii` of them for each sample; radius number i is left out (0 points) at samples whose number has one of
// the bits skips[i]. Curvatures and lengths are in the tree's units.
__kernel void sample_fits(int samples, int radii, __global const int *center, __global const float *all_radii,
                          __global const int *skips, int padded,
                          __global const float *sorted, __global const float *boxes, __global const int *node_offset,
                          int top_level, __global float *out) {
  int item = get_global_id(0);
  if (item >= samples * radii) return;
  size_t n = padded;
  __global const float *own = sorted + center[item / radii];
  float x = own[0], y = own[n], z = own[2 * n], radius = all_radii[item];
  __global float *o = out + OUT * (size_t)item;
  if ((item / radii) & skips[item % radii]) {
    for (int i = 0; i < OUT; ++i) o[i] = 0.0f;
    return;
  }
  Frame frame = frame_at(own[3 * n], own[4 * n], own[5 * n]), *f = &frame;
  Sums sums;
  float a[TERMS], c[TERMS];
  sum_ball(&sums, a, 0.0f, f, x, y, z, radius, padded, sorted, boxes, node_offset, top_level);
  float weight = sums.row[0].s[0];
  eliminate(&sums, TERMS);
  o[0] = sums.count;
  for (int four = 0; four < 2; ++four) {
    solve(&sums, four ? 15 : 6, a);
    to_monomials(a, c);
    o[1 + four] = mean_curvature(c) / radius;
    o[3 + four] = c[0] * radius;
  }
  o[5] = 0.0f;
#if RESIDUAL
  solve(&sums, 10, a);
  PF sum = 0.0f;
  EACH_NEAR(PF b[TERMS]; basis_at(u, v, b); PF e = w;
            for (int i = 0; i < 10; ++i) e -= a[i] * b[i];
            sum += g * e * e;)
  o[5] = sum_lanes(sum) / weight * radius * radius;
#endif
}
