// Normals at the texels of a scale map, from its distances. VW texels a work-item.
//
// GRADIENT: n ~ rho d - grad rho, with the gradient on the sphere from the quadratic that fits the 3 x 3 texels around
// best (least squares, through the middle one): of second order on the cube's edges and corners too, where lines of texels
// bend. Otherwise the four neighbours of Reiter, "Spherical Scale Mapping", section 3.1: the four cross products of
// adjacent ones add up to (north - south) x (east - west); the neighbours stand `epsilon` away in the tangent plane, not
// in spherical coordinates, which have poles. Twin: tests/reference/scale_map.py, scale_normals.
#include "render/scale_sample.clh"

#ifndef GRADIENT
#define GRADIENT 1
#endif
#define UNKNOWNS 5  // gx, gy, and the second derivatives xx, xy, yy

__kernel void scale_normals(int size, float epsilon, __global const float *rho /* (6, size + 2, size + 2); -1: hole */,
                            __global const float *directions /* (6, size + 2, size + 2, 3) */,
                            __global float4 *normals /* (6, size, size): normal, rho */) {
  int first = get_global_id(0) * VW, texels = 6 * size * size, side = size + 2;
  if (first >= texels) return;
  VI texel = LANE_INDEX + first;
  texel = SEL(texel, (VI)(texels - 1), texel >= texels);
  VI node;
  for (int lane = 0; lane < VW; lane++) {
    int t = ((int *)&texel)[lane], row = t / size, face = row / size;
    ((int *)&node)[lane] = (face * side + row % size + 1) * side + t % size + 1;
  }
  VF dx = take(directions, 3 * node), dy = take(directions, 3 * node + 1), dz = take(directions, 3 * node + 2);
  VF here = take(rho, node), zero = 0.0f, one = 1.0f, gx = zero, gy = zero;
  VF ux, uy, uz, vx, vy, vz;
  tangents(dx, dy, dz, &ux, &uy, &uz, &vx, &vy, &vz);
  VF nx, ny, nz;
#if GRADIENT
  VF m[UNKNOWNS][UNKNOWNS], rhs[UNKNOWNS];
  for (int i = 0; i < UNKNOWNS; i++) {
    rhs[i] = zero;
    for (int j = 0; j <= i; j++) m[i][j] = i == j ? (VF)(1e-5f) : zero;
  }
  const float scale = 0.5f * size;  // about 1 a texel
  for (int k = 0; k < 9; k++) {
    if (k == 4) continue;
    VI at = node + ((k / 3 - 1) * side + k % 3 - 1);
    VF value = take(rho, at), ex = take(directions, 3 * at), ey = take(directions, 3 * at + 1);
    VF ez = take(directions, 3 * at + 2);
    VI use = value >= 0.0f;
    if (k % 2 == 0) {  // not the cube's corners, which belong to three texels
      VF inner = 1.0f - 0.25f / size;  // of the largest component over the middle one, everywhere else
      VF ax = SEL(ex, -ex, ex < 0.0f), ay = SEL(ey, -ey, ey < 0.0f), az = SEL(ez, -ez, ez < 0.0f);
      use = use & NOT((VMIN(VMIN(ax, ay), az) > inner * VMAX(VMAX(ax, ay), az)));
    }
    VF along = one / (ex * dx + ey * dy + ez * dz);
    VF x = (ex * ux + ey * uy + ez * uz) * along * scale, y = (ex * vx + ey * vy + ez * vz) * along * scale;
    VF f[UNKNOWNS] = {x, y, 0.5f * x * x, x * y, 0.5f * y * y}, d = value - here;
    for (int i = 0; i < UNKNOWNS; i++) {
      f[i] = SEL(zero, f[i], use);
      rhs[i] += f[i] * SEL(zero, d, use);
      for (int j = 0; j <= i; j++) m[i][j] += f[i] * f[j];
    }
  }
  for (int i = 0; i < UNKNOWNS; i++) {  // Cholesky, the reciprocals of the diagonal in its place
    for (int j = 0; j <= i; j++) {
      VF sum = m[i][j];
      for (int k = 0; k < j; k++) sum -= m[i][k] * m[j][k];
      m[i][j] = i == j ? one / VSQRT(VMAX(sum, (VF)(1e-9f))) : sum * m[j][j];
    }
    for (int k = 0; k < i; k++) rhs[i] -= m[i][k] * rhs[k];
    rhs[i] *= m[i][i];
  }
  for (int i = UNKNOWNS - 1; i >= 0; i--) {
    for (int k = i + 1; k < UNKNOWNS; k++) rhs[i] -= m[k][i] * rhs[k];
    rhs[i] *= m[i][i];
  }
  gx = rhs[0] * scale; gy = rhs[1] * scale;
  nx = here * dx - gx * ux - gy * vx; ny = here * dy - gx * uy - gy * vy; nz = here * dz - gx * uz - gy * vz;
#else
  VF p[4][3];
  for (int k = 0; k < 4; k++) {
    float s = k & 1 ? -epsilon : epsilon;
    VF x = dx + s * (k < 2 ? ux : vx), y = dy + s * (k < 2 ? uy : vy), z = dz + s * (k < 2 ? uz : vz);
    VF value = sample_scale(rho, size, x, y, z);
    value = SEL(value, here, value < 0.0f) / VSQRT(x * x + y * y + z * z);
    p[k][0] = value * x; p[k][1] = value * y; p[k][2] = value * z;
  }
  VF ax = p[0][0] - p[1][0], ay = p[0][1] - p[1][1], az = p[0][2] - p[1][2];
  VF bx = p[2][0] - p[3][0], by = p[2][1] - p[3][1], bz = p[2][2] - p[3][2];
  nx = ay * bz - az * by; ny = az * bx - ax * bz; nz = ax * by - ay * bx;
#endif
  VF length = VSQRT(nx * nx + ny * ny + nz * nz);
  VI none = NOT(length > 1e-20f);  // at the centre itself
  VF inverse = one / length;
  nx = SEL(nx * inverse, dx, none); ny = SEL(ny * inverse, dy, none); nz = SEL(nz * inverse, dz, none);
  for (int lane = 0; lane < VW && first + lane < texels; lane++)
    normals[first + lane] = (float4)(((float *)&nx)[lane], ((float *)&ny)[lane], ((float *)&nz)[lane],
                                     ((float *)&here)[lane]);
}
