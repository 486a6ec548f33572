// One surfel per work-item: all radii of its golden-ratio segment at once, a radius per vector lane; where items are
// single (VW = 1), one after another.
//
// Lane i has the radius r_r g^(2 (14 - i) / 14), g the golden ratio: lane 0 is r_l, 7 is r_m, 14 is r_r (paper 003,
// equations 3-5); lane 15 repeats 14. All share the frame of the mean normal within r_m. Two passes over the ball's
// points: moments, residuals (e^2 by subtraction loses it to rounding). The radius of least E is taken among lanes with
// at least `need` points. A cubic's lanes with fewer than FULL points, enough for a quadratic, get the quadratic.
#include "common/frame.clh"
#include "build/gather_ball.clh"
#include "build/polynomial_fit.clh"
#include "build/moment_sums.clh"

#define SEGMENT 0 // minimise E over the segment
#define FORCED 1  // the same, but always a leaf
#define FIXED 2   // always a leaf, with radius r_r
#define INNER 3   // never a leaf
#define RECORD 16 // floats out: radius, normal, e, leaf, coefficients from 6

// Points of a cubic lane; with fewer it is a quadratic. Without lanes below 22 points at all, edges and rims stayed
// coarse: fandisk 0.103 % of the diagonal instead of 0.064 at T 0.01, and the bunny at 0.01 % took 9,607 cubic surfels,
// not 7,054. Cubics on 18 points turn the normals of a noisy torus by a quarter more.
#define FULL (DEGREE == 3 ? 2 * TERMS + 2 : 0)
#define CUBIC_LIMIT 1.0f       // |c r^2| of a cubic term; beyond it the cubic terms of a lane are dropped
#define NORMAL_SHARE 0.618034f // of the radius: the ball whose mean normal sets the frame
// A true minimum of E has e^2 = lambda (T/r)^2 / (degree + 1), above the noise; e^2 far above it is a plateau: detail
// smoothed away between scales (the demo's flutes and rosettes: 12 leaves of 16K, e^2 up to 2000 times the penalty).
#define PLATEAU 4.0f
#define NOISE_ALLOWED 3.0f // lambdas of e^2; lambda is about 0.7 of the noise's variance
// Points whose normals have a smaller cosine with the centre's are of the sheet behind. Right angles stay in: without
// those below 0.3, large leaves stand out over the edges of fandisk, RMS 0.07 to 0.46 % of the diagonal.
#define OTHER_SHEET -0.2f
#define SPARSE 6.0f    // point spacings: a quarter of a disc of that radius has more points than a quadratic needs
#define COMPANY 5      // points of a wide ball; fewer is alone
#define COMPACT 0.25f  // of r_r^2: a ball whose points all lie nearer is an island
#define POOR 0.05f     // e over the radius: a grown ball that fits worse is left to the next levels
#define LONE_DISC 3.0f // point spacings
// With a tolerance, a point that its ball's fit does not come near gets a disc of its own, as far as the nearest point
// that the disc misses: discs at other heights would pull it off. Forest from the air, 373,000 points, tolerance a
// quarter of the spacing, share that keeps it: 99.5 % at CLEAR 1.0, 97.8 at 1.3, 87.9 at 1.6; smaller discs gain nothing.
#define STRAY_DISC 0.55f  // of the points' mean distance: least radius
#define LARGEST_STRAY 0.8f // of the ball's radius
#define CLEAR 1.1f         // of the distance to that point
#define WITHIN_ERROR 0.5f // of the tolerance: largest e of a leaf. 0.4, 0.6: 99.5, 99.1 %, 3 % more, 5 % fewer leaves
#define ANY_NORMAL ((float4)(0.0f, 0.0f, 0.0f, 0.0f)) // of gather_ball's side

#ifdef WEIGHTED
#define TIMES_WEIGHT(g, i, p) g *= ((const float *)ball->k)[PW * (i) + (p)];
#else
#define TIMES_WEIGHT(g, i, p)
#endif

inline VF weight_of(float d2, VF inverse_r2) {
  VF g = 1.0f - d2 * inverse_r2;
  g = SEL(g, (VF)0.0f, g < 0.0f);
  return g * g * g;
}

typedef struct {
  float ux, uy, uz, vx, vy, vz, nx, ny, nz;
} Frame;

// Nudges a normal off the frame's seam z = 0: a stored one decodes to within rounding, which must not carry it over.
inline float off_seam(float z) { return z < 1e-5f && z > -1e-5f ? (z < 0.0f ? -1e-5f : 1e-5f) : z; }

// The frame of the ball's mean normal. Where the sum vanishes (two sheets), the centre's own normal is taken.
inline Frame frame_of_ball(const Ball *ball, float3 own_normal) {
  float3 n = (float3)(ball->normal_x, ball->normal_y, ball->normal_z), u, v;
  float s = n.x * n.x + n.y * n.y + n.z * n.z;
  if (!(s > 1e-12f)) {
    n = own_normal;
    s = 1.0f;
  }
  n *= 1.0f / sqrt(s);
  n.z = off_seam(n.z);
  frame_of_normal(n, &u, &v);
  Frame f = {u.x, u.y, u.z, v.x, v.y, v.z, n.x, n.y, n.z};
  return f;
}

// Points in the frame, in units of the ball's radius: u, v, w and d^2, points as lanes.
typedef struct {
  union { PF v; float s[PW]; } u, v, w, d2;
} Chunk;

inline void local_chunk(Chunk *c, PF x, PF y, PF z, const Frame *f, float inverse_r) {
  x *= inverse_r, y *= inverse_r, z *= inverse_r;
  c->u.v = f->ux * x + f->uy * y + f->uz * z;
  c->v.v = f->vx * x + f->vy * y + f->vz * z;
  c->w.v = f->nx * x + f->ny * y + f->nz * z;
  c->d2.v = x * x + y * y + z * z;
}

#define CHUNKS(count) (((count) + PW - 1) / PW)
#define IN_CHUNK(count, i) ((count) - PW * (i) < PW ? (count) - PW * (i) : PW)

// Sums of G u^i v^j (moment) and G u^i v^j w (right) for the lanes' radii. The monomials are made with points as lanes,
// then each point's are broadcast to the lanes of radii: one multiply-add a sum, a point and all radii.
inline void sum_moments(const Ball *ball, const Frame *frame, float inverse_r, VF inverse_r2, VF *moment, VF *right,
                        VI *inside) {
  VI n = 0;
  VF SUMS;
  for (int i = 0; i < CHUNKS(ball->count); ++i) {
    Chunk c;
    local_chunk(&c, ball->x[i], ball->y[i], ball->z[i], frame, inverse_r);
    union { PF v; float s[PW]; } m[MOMENTS + TERMS];
    MONOMIALS
    int points = IN_CHUNK(ball->count, i);
    for (int p = 0; p < points; ++p) {
      VF g = weight_of(POINT(c.d2, p), inverse_r2);
      n += ONES(g > 0.0f);
      TIMES_WEIGHT(g, i, p)
      ADD_SUMS
    }
  }
  *inside = n;
  STORE_SUMS
}

// Weighted mean of squared residuals, in units of the ball's radius squared.
inline VF mean_residual2(const Ball *ball, const Frame *frame, float inverse_r, VF inverse_r2, const VF *c) {
  VF sum = 0.0f, total = 1e-30f;
  for (int i = 0; i < CHUNKS(ball->count); ++i) {
    Chunk k;
    local_chunk(&k, ball->x[i], ball->y[i], ball->z[i], frame, inverse_r);
    int points = IN_CHUNK(ball->count, i);
    for (int p = 0; p < points; ++p) {
      VF g = weight_of(POINT(k.d2, p), inverse_r2);
      TIMES_WEIGHT(g, i, p)
      VF f = POINT(k.w, p) - height_at(c, POINT(k.u, p), POINT(k.v, p));
      sum += g * f * f;
      total += g;
    }
  }
  return sum / total;
}

#if DEGREE == 3
// Lanes with few points or wild cubic terms keep the quadratic fit.
inline void tame_cubic(const VF *moment, const VF *right, VF r, VI few, VF *c) {
  VF square[TERMS];
  for (int k = 6; k < 10; ++k) square[k] = 0.0f;
  solve_terms(moment, right, square, 6);
  VI wild = few | (c[6] != c[6]);
  VF limit = CUBIC_LIMIT / (r * r);
  for (int k = 6; k < 10; ++k) wild |= (c[k] > limit) | (c[k] < -limit);
  for (int k = 0; k < 10; ++k) c[k] = SEL(c[k], square[k], wild);
}
#endif

// The polynomials of the lanes' radii r (over the ball's radius) from `count` points, never wild and never NaN.
inline void fit_polynomials(const VF *moment, const VF *right, VF r, VI count, int terms, VF *c) {
  for (int k = terms; k < TERMS; ++k) c[k] = 0.0f;
  solve_terms(moment, right, c, terms);
#if DEGREE == 3
  if (terms == TERMS) tame_cubic(moment, right, r, count < FULL, c);
#endif
  for (int k = 0; k < TERMS; ++k) c[k] = SEL((VF)0.0f, c[k], (c[k] > -1e6f) & (c[k] < 1e6f));
}

#define EACH_CHUNK(body)                                                                              \
  {                                                                                                   \
    size_t n = padded / PW;                                                                           \
    uint list[BLOCK_LIST];                                                                            \
    Traversal t;                                                                                      \
    int blocks;                                                                                       \
    traversal_start(&t, top_level);                                                                   \
    while ((blocks = traversal_next(&t, boxes, node_offset, x, y, z, radius * radius, list)) > 0)     \
      for (int b = 0; b < BLOCK_POINTS * blocks; ++b) {                                               \
        __global const PF *block = (__global const PF *)sorted + NUMBER_IN(list, b);                  \
        Chunk c;                                                                                      \
        local_chunk(&c, block[0] - x, block[n] - y, block[2 * n] - z, frame, inverse_r);              \
        PF g = 1.0f - c.d2.v;                                                                         \
        g = SEL(g, (PF)0.0f, g < 0.0f);                                                               \
        g = POINT_WEIGHT(g * g * g, block, n);                                                        \
        body                                                                                          \
      }                                                                                               \
  }

// The fit over all points of one radius, points as lanes: what the thinned ball chose is made exact. Coefficients in
// units of the radius, the same in every lane; returns the weighted mean of squared residuals in these units.
inline float fit_all_points(int padded, __global const float *sorted, __global const float *boxes,
                            __global const int *node_offset, int top_level, float x, float y, float z, float radius,
                            const Frame *frame, VF *coefficient) {
  float inverse_r = 1.0f / radius;
  VF moment[MOMENTS], right[TERMS], sum = 0.0f, total = 0.0f;
  VF SUMS;
  EACH_CHUNK(union { PF v; } m[MOMENTS + TERMS]; MONOMIALS ADD_LANES)
  STORE_LANES
  fit_polynomials(moment, right, (VF)1.0f, (VI)FULL, TERMS, coefficient);
  EACH_CHUNK(PF f = c.w.v - height_at(coefficient, c.u.v, c.v.v); sum += g * f * f; total += g;)
  return sum_lanes(sum) / (sum_lanes(total) + 1e-30f);
}

#if DEGREE == 1
// The frame turns to the fitted plane; c[0] becomes its distance, the slopes vanish. Returns the cosine squared.
inline float turn_to_plane(const Frame *f, VF *normal, VF *c) {
  VF k = 1.0f / VSQRT(1.0f + c[1] * c[1] + c[2] * c[2]);
  normal[0] = (f->nx - c[1] * f->ux - c[2] * f->vx) * k;
  normal[1] = (f->ny - c[1] * f->uy - c[2] * f->vy) * k;
  normal[2] = (f->nz - c[1] * f->uz - c[2] * f->vz) * k;
  c[0] *= k;
  c[1] = c[2] = 0.0f;
  return ((float *)&k)[0] * ((float *)&k)[0];
}
#endif

// The fits of all radii: error and energy in unit-diagonal units, coefficients in units of the ball's radius.
typedef struct {
  Frame frame;
  union { float16 v; float s[16]; } c[TERMS], weight, e2, energy; // weight: the sum of G over the points
  union { int16 v; int s[16]; } count;
} Fits;

// Radii over the ball's: g^(2 (14 - i) / 14).
#define RATIOS 0.381966011f, 0.409151886f, 0.438272665f, 0.469466063f, 0.502879599f, 0.538671289f, 0.577010394f, \
               0.618033989f, 0.662021714f, 0.709140230f, 0.759612349f, 0.813676760f, 0.871589122f, 0.933623281f, \
               1.0f, 1.0f
__constant float RATIO[16] = {RATIOS};

inline void fit_radii(Fits *fits, const Ball *ball, float3 own_normal, float radius, int terms, float lambda_t2) {
  fits->frame = frame_of_ball(ball, own_normal);
  for (int i = 0; i < 16; i += VW) {
#if VW == 1
#define OF_RADIUS(value) (value).s[i]
    float r = RATIO[i];
#else
#define OF_RADIUS(value) (value).v
    VF r = (VF)(RATIOS);
#endif
    VF inverse_r2 = 1.0f / (r * r), moment[MOMENTS], right[TERMS], c[TERMS];
    VI count;
    sum_moments(ball, &fits->frame, 1.0f / radius, inverse_r2, moment, right, &count);
    fit_polynomials(moment, right, r, count, terms, c);
    VF e2 = mean_residual2(ball, &fits->frame, 1.0f / radius, inverse_r2, c) * (radius * radius);
    for (int k = 0; k < TERMS; ++k) OF_RADIUS(fits->c[k]) = c[k];
    OF_RADIUS(fits->count) = count;
    OF_RADIUS(fits->weight) = moment[0];
    OF_RADIUS(fits->e2) = e2;
    OF_RADIUS(fits->energy) = e2 + inverse_r2 * (lambda_t2 / (radius * radius));
  }
}

// The first lane with at least `need` points; 14 where none has.
inline int lowest_lane(const Fits *fits, int need) {
  int lowest = 14;
  while (lowest > 0 && fits->count.s[lowest - 1] >= need) --lowest;
  return lowest;
}

inline int is_plateau(const Fits *fits, int lane, float noise) {
  return fits->e2.s[lane] > PLATEAU * (fits->energy.s[lane] - fits->e2.s[lane]) + noise;
}

// The lane to take: a leaf's, or 14 for an internal surfel.
inline int choose_lane(const Fits *fits, float lambda, int need, int mode, int stride, int *leaf) {
  const float *e2 = fits->e2.s, *energy = fits->energy.s;
  int lowest = lowest_lane(fits, need), best = 14;
  for (int i = 13; i >= lowest; --i)
    if (energy[i] < energy[best]) best = i;
  if (mode == FIXED) best = 14;
  // A leaf: an interior minimum with e rising (condition 4), E still falling at r_r, or no smaller radius to try. Finer
  // levels resolve a plateau.
  int full = lowest; // e falls where a quadratic becomes a cubic: condition 4 is for radii of one degree
  while (full < 14 && fits->count.s[full] < FULL) ++full;
  int first = best < full ? lowest : full, middle = first > 7 ? first : 7;
  int rising = e2[first] <= e2[middle] && e2[middle] <= e2[14];
  int plateau = lowest == 0 && is_plateau(fits, best, NOISE_ALLOWED * lambda);
  *leaf = !plateau && (best == 14 || (best > lowest && rising) || (best == lowest && lowest > 0 && stride == 1));
  if (mode != SEGMENT) *leaf = mode != INNER;
  return *leaf ? best : 14;
}

// A small disc with the point's own normal.
inline void write_disc(__global float *o, float radius, float3 normal) {
  for (int i = 0; i < RECORD; ++i) o[i] = 0.0f;
  o[0] = radius;
  o[1] = normal.x;
  o[2] = normal.y;
  o[3] = off_seam(normal.z);
  o[5] = 1.0f;
}

// Radius of a point's own disc: up to the nearest point that its plane does not come within the tolerance of.
inline float stray_radius(const Ball *ball, float3 normal, float radius, float tolerance) {
  PF nearest = LARGEST_STRAY * LARGEST_STRAY * radius * radius;
  for (int i = 0; i < CHUNKS(ball->count); ++i) {
    PF x = ball->x[i], y = ball->y[i], z = ball->z[i];
    PF f = normal.x * x + normal.y * y + normal.z * z, d2 = x * x + y * y + z * z;
    PI real = LANE_INDEX < (PI)IN_CHUNK(ball->count, i);
    nearest = SEL(nearest, d2, real & ((f > tolerance) | (f < -tolerance)) & (d2 < nearest));
  }
  union { PF v; float s[PW]; } lanes;
  lanes.v = nearest;
  float least = lanes.s[0];
  for (int j = 1; j < PW; ++j) least = lanes.s[j] < least ? lanes.s[j] : least;
  float smallest = STRAY_DISC * radius * sqrt(3.14159265f / ball->count), clear = CLEAR * sqrt(least);
  return clear > smallest ? clear : smallest;
}

inline void write_surfel(__global float *o, const Frame *frame, const VF *coefficient, float radius, float share,
                         float error2, int leaf) {
  VF c[TERMS], normal[3] = {frame->nx, frame->ny, frame->nz};
  for (int k = 0; k < TERMS; ++k) c[k] = coefficient[k];
#if DEGREE == 1
  error2 *= turn_to_plane(frame, normal, c);
#endif
  o[0] = share * radius;
  for (int a = 0; a < 3; ++a) o[1 + a] = ((float *)&normal[a])[0];
  o[4] = sqrt(error2);
  o[5] = leaf;
  float scale[4] = {radius, 1.0f, 1.0f / radius, 1.0f / (radius * radius)}; // out of the units of the radius
  for (int k = 0; k < 10; ++k) o[6 + k] = 0.0f;
  for (int k = 0; k < (DEGREE == 1 ? 1 : TERMS); ++k)
    o[6 + k] = ((float *)&c[k])[0] * scale[TERM_U[k] + TERM_V[k]];
}

// Sparse places. A ball with too few points grows, to twice its size or to SPARSE point spacings, and makes do with a
// plane if it then still has too few; a point that is nearly alone gets a disc. Where the points fill less than half of
// the ball (an island), the next levels' smaller balls decide: grown, it would bridge to the next surface. A leaf that
// has no smaller radius to try and fits badly because a sheet behind is in its ball is fitted once more without it.
__kernel void fit_surfels(int surfels, __global const int *center, float r_r, float lambda, float lambda_t2,
                          float spacing, int need, int mode, float tolerance, int padded, __global const float *sorted,
                          __global const float *boxes, __global const int *node_offset, int top_level,
                          __global float *out) {
  int s = get_global_id(0);
  if (s >= surfels) return;
  __global const float *own = sorted + center[s];
  size_t n = padded;
  float x = own[0], y = own[n], z = own[2 * n];
  float3 own_normal = (float3)(own[3 * n], own[4 * n], own[5 * n]);
  Ball ball;
  Fits fits;
  float4 side = ANY_NORMAL;
  float radius = r_r, limit = r_r; // up to which the ball may grow
  int terms = TERMS, enough = need < FULL ? FULL : need, may_refit = mode != FIXED, refitted = 0;
  int wide = r_r > SPARSE * spacing, compact = 0, sparse = 0, alone = 0, leaf, lane;
  // A loop about one place that gathers and one that fits: compilers make a copy of all of it where it is called twice.
  for (int first = 1;; first = 0) {
    gather_ball(&ball, padded, sorted, boxes, node_offset, top_level, x, y, z, radius, NORMAL_SHARE * radius, side);
    if (refitted) {
      need = ball.count < need ? ball.count : need;
      if (need < TERMS) need = 1, terms = 3, mode = FIXED;
    } else {
      if (first) {
        compact = wide && ball.extent2 < COMPACT * r_r * r_r;
        if (compact && mode == SEGMENT) mode = INNER;
        sparse = ball.count < enough;
        if (sparse && mode == SEGMENT) mode = FORCED;
        limit = compact ? r_r : wide ? 2.0f * r_r : SPARSE * spacing;
        alone = sparse && wide && ball.count < (compact ? 2 : COMPANY);
      }
      if (!alone && ball.count < enough && 1.25f * radius <= limit) {
        radius *= 1.25f;
        continue;
      }
      if (alone || (sparse && wide && !compact && ball.count < need)) {
        write_disc(out + RECORD * (size_t)s, LONE_DISC * spacing, own_normal);
        return;
      }
      if (ball.count < need) {
        need = 1, terms = 3;
        if (mode == FORCED) mode = FIXED; // no choice among radii that hold two or three points
      }
    }
    fit_radii(&fits, &ball, own_normal, radius, terms, lambda_t2);
    lane = choose_lane(&fits, lambda, need, mode, ball.stride, &leaf);
    int no_smaller = mode != SEGMENT || fits.count.s[0] < need;
    if (refitted || !may_refit || !leaf || !no_smaller || ball.stride > 1 || !is_plateau(&fits, lane, 0.0f)) break;
    refitted = 1;
    side = (float4)(own_normal, OTHER_SHEET);
  }
#ifndef WEIGHTED
  // Evenly spread points weigh a quarter of their number; a stray whose neighbours all lie near the rim fits itself.
  if (leaf && wide && mode == SEGMENT && fits.weight.s[lane] < 0.125f * need) leaf = 0, lane = 14;
#endif
  if (leaf) { // what keeps farther from its points than allowed is split; what cannot be, is a disc at its point
    float most = WITHIN_ERROR * tolerance, aside = fits.c[0].s[lane] * radius;
    int splits = mode == SEGMENT && fits.count.s[0] >= need;
    if (fits.e2.s[lane] > most * most && splits) leaf = 0, lane = 14;
    else if (fits.e2.s[lane] > most * most || aside > tolerance || aside < -tolerance) {
      write_disc(out + RECORD * (size_t)s, stray_radius(&ball, own_normal, radius, tolerance), own_normal);
      return;
    }
  }
  float error2 = fits.e2.s[lane], share = RATIO[lane];
  if (wide && radius > r_r && mode == FORCED && error2 > POOR * POOR * radius * radius) { // strays, no sparse surface
    leaf = 0;
    share = r_r / radius;
  }
  VF c[TERMS];
  for (int k = 0; k < TERMS; ++k) c[k] = fits.c[k].s[lane];
  if (ball.stride > 1) { // a thinned ball chose the radius; the surfel is fitted to all points
    for (int k = 0; k < TERMS; ++k) c[k] = 0.0f;
    error2 = fit_all_points(padded, sorted, boxes, node_offset, top_level, x, y, z, share * radius, &fits.frame, c);
    error2 *= share * share * radius * radius;
    radius *= share;
    share = 1.0f;
  }
  write_surfel(out + RECORD * (size_t)s, &fits.frame, c, radius, share, error2, leaf);
}
