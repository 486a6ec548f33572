// Normal maps of inner surfels from the triangles of a mesh: Holst and Schumann, Algorithm 2. The line through a texel
// along the surfel's normal hits a triangle, whose normals are interpolated by barycentric coordinates; of several
// triangles that face the surfel's way the one nearest to its plane counts. Twin: tests/reference/surfels.py,
// triangle_maps.
#include "build/surfel_maps.clh"

INLINE void add_triangle(Map *m, int3 corners, __global const float *vertices, __global const float *normals,
                         __global const float4 *lights, VF nearest[CHUNKS]) {
  float3 a = vload3(corners.x, vertices) - m->p, b = vload3(corners.y, vertices) - m->p;
  float3 c = vload3(corners.z, vertices) - m->p;
  float ax = dot(a, m->u), ay = dot(a, m->v), bx = dot(b, m->u) - ax, by = dot(b, m->v) - ay;
  float cx = dot(c, m->u) - ax, cy = dot(c, m->v) - ay, area = bx * cy - by * cx;
  if (area <= 0.0f) return;  // it faces away, or is seen from its edge
  float az = dot(a, m->n), bz = dot(b, m->n) - az, cz = dot(c, m->n) - az, inverse = 1.0f / area;
  float low = ay + (by < cy ? by < 0.0f ? by : 0.0f : cy < 0.0f ? cy : 0.0f);
  float high = ay + (by > cy ? by > 0.0f ? by : 0.0f : cy > 0.0f ? cy : 0.0f);
  int first, last;
  chunk_range(m, low, high, &first, &last);
  float3 na = vload3(corners.x, normals), nb = vload3(corners.y, normals) - na, nc = vload3(corners.z, normals) - na;
#if HAS_COLOR
  float4 la = lights[corners.x], lb = lights[corners.y] - la, lc = lights[corners.z] - la;
#endif
  for (int k = first; k <= last; k++) {
    VF x = m->x[k] - ax, y = m->y[k] - ay;
    VF s = (x * cy - y * cx) * inverse, t = (y * bx - x * by) * inverse;
    VF z = az + s * bz + t * cz;
    z = VMAX(z, -z);
    VI hit = (s >= 0.0f) & (t >= 0.0f) & (s + t <= 1.0f) & (z < nearest[k]);
    if (!any_lane(hit)) continue;
    nearest[k] = SEL(nearest[k], z, hit);
    m->nx[k] = SEL(m->nx[k], na.x + s * nb.x + t * nc.x, hit);
    m->ny[k] = SEL(m->ny[k], na.y + s * nb.y + t * nc.y, hit);
    m->nz[k] = SEL(m->nz[k], na.z + s * nb.z + t * nc.z, hit);
    m->weight[k] = SEL(m->weight[k], (VF)(1.0f), hit);
#if HAS_COLOR
    m->red[k] = SEL(m->red[k], la.x + s * lb.x + t * lc.x, hit);
    m->green[k] = SEL(m->green[k], la.y + s * lb.y + t * lc.y, hit);
    m->blue[k] = SEL(m->blue[k], la.z + s * lb.z + t * lc.z, hit);
    m->alpha[k] = SEL(m->alpha[k], la.w + s * lb.w + t * lc.w, hit);
#endif
  }
}

__kernel void triangle_maps(int first, int step, int count /* maps first, first + step, ... below count */,
                            int root /* one after the other; what lies below root counts */, int last, __global float *sums,
                            __global const float *nodes, __global const int2 *below /* first child, their number */,
                            __global const int2 *faces_below /* first triangle, their number */,
                            __global const float *vertices, __global const float *normals, __global const int *faces,
                            __global const float4 *vertex_lights, __global const float4 *lights,
                            __global const uchar *light_codes, __global uchar4 *texels, __global uchar4 *colors) {
  int id = get_global_id(0), map = id / ITEMS_OF_MAP, s = first + map * step;
  if (s >= count) return;
  Map m;
  open_map(nodes + (size_t)s * NODE_FLOATS, id % ITEMS_OF_MAP, &m);
  VF nearest[CHUNKS];
  for (int c = 0; c < CHUNKS; c++) nearest[c] = 2.0f * m.sphere;
#if RESUMED
  resume_map(&m, nearest, sums + SUMS * (size_t)id);
#endif
  int stack[STACK], waiting = 1;
  stack[0] = root;
  while (waiting > 0) {
    int node = stack[--waiting];
    int2 own = faces_below[node], children = below[node];
    for (int f = own.x; f < own.x + own.y; f++)
      add_triangle(&m, vload3(f, faces), vertices, normals, vertex_lights, nearest);
    for (int c = children.x; c < children.x + children.y; c++) {
      float3 d = vload3(0, nodes + (size_t)c * NODE_FLOATS) - m.p;
      float reach = m.sphere + nodes[(size_t)c * NODE_FLOATS + 3];
      if (dot(d, d) < reach * reach) stack[waiting++] = c;  // the bounding spheres intersect
    }
  }
#if RESUMED
  keep_map(&m, nearest[0], sums + SUMS * (size_t)id);
  if (!last) return;
#endif
#if HAS_COLOR
  float4 own = lights[s];
#else
  float4 own = 0.0f;
#endif
  close_map(&m, own, light_codes, texels + (size_t)map * TEXELS, colors + (size_t)map * TEXELS);
}
