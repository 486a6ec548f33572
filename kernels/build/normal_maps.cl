// Normal maps of inner surfels from the base surfels: Holst and Schumann, Algorithm 1. Through every texel runs a line
// along the surfel's normal; the base surfels that it hits, among those whose bounding sphere meets the surfel's, are
// blended by a Gaussian of the distance from their middle. Base surfels that face away do not contribute, so that both
// sides of a thin sheet keep their own normals. Twin: tests/reference/surfels.py, normal_maps.
#include "build/surfel_maps.clh"

#define FALL 4.0f     // the Gaussian is exp(-FALL) at the rim of a base surfel
#define FACING 1e-3f  // cosine that a base surfel must have with the surfel

INLINE void add_base(Map *m, __global const float *node, __global const float4 *color) {
  float3 n = vload3(0, node + 4), d = vload3(0, node) - m->p;
  float along = dot(n, m->n);
  if (along <= FACING) return;
  float a = dot(d, m->u), b = dot(d, m->v), nu = dot(n, m->u), nv = dot(n, m->v), r = node[7];
  float tall = r * sqrt(1.0f - nv * nv > 0.0f ? 1.0f - nv * nv : 0.0f);
  int first, last;
  chunk_range(m, b - tall, b + tall, &first, &last);
  float inverse = 1.0f / (r * r), su = nu / along, sv = nv / along;
  float xx = (1.0f + su * su) * inverse, xy = 2.0f * su * sv * inverse, yy = (1.0f + sv * sv) * inverse;
#if HAS_COLOR
  float4 light = *color;
#endif
  for (int c = first; c <= last; c++) {
    VF x = m->x[c] - a, y = m->y[c] - b;
    VF t2 = x * (xx * x + xy * y) + yy * y * y;
    VF g = SEL((VF)(0.0f), falling(FALL * VMIN(t2, (VF)(1.0f))), t2 < 1.0f);
    m->nx[c] += g * n.x; m->ny[c] += g * n.y; m->nz[c] += g * n.z; m->weight[c] += g;
#if HAS_COLOR
    m->red[c] += g * light.x; m->green[c] += g * light.y; m->blue[c] += g * light.z; m->alpha[c] += g * light.w;
#endif
  }
}

__kernel void normal_maps(int first, int step, int count /* maps first, first + step, ... below count */,
                          int root /* one after the other; what lies below root counts */, int last, __global float *sums,
                          __global const float *nodes, __global const int2 *below /* first child and their number */,
                          __global const float4 *lights, __global const uchar *light_codes, __global uchar4 *texels,
                          __global uchar4 *colors) {
  int id = get_global_id(0), map = id / ITEMS_OF_MAP, s = first + map * step;
  if (s >= count) return;
  Map m;
  open_map(nodes + (size_t)s * NODE_FLOATS, id % ITEMS_OF_MAP, &m);
#if RESUMED
  float nearest = 0.0f;  // of triangles
  resume_map(&m, &nearest, sums + SUMS * (size_t)id);
#endif
  int stack[STACK], waiting = 1;
  stack[0] = root;
  while (waiting > 0) {
    int2 children = below[stack[--waiting]];
    for (int c = children.x; c < children.x + children.y; c++) {
      __global const float *node = nodes + (size_t)c * NODE_FLOATS;
      float3 d = vload3(0, node) - m.p;
      float reach = m.sphere + node[3];
      if (dot(d, d) >= reach * reach) continue;  // the bounding spheres do not intersect
      if (below[c].y == 0) add_base(&m, node, lights + c);
      else stack[waiting++] = c;
    }
  }
#if RESUMED
  keep_map(&m, nearest, sums + SUMS * (size_t)id);
  if (!last) return;
#endif
#if HAS_COLOR
  float4 own = lights[s];
#else
  float4 own = 0.0f;
#endif
  close_map(&m, own, light_codes, texels + (size_t)map * TEXELS, colors + (size_t)map * TEXELS);
}
