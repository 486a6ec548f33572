// Vertices as the camera sees them, see triangles.clh. One work-item for `run` vertices.
// Twin: tests/reference/render_triangles.py, project_vertices.
//
// Every triangle of a vertex reads the same four floats, so that neighbours agree on their edge to the bit.
#include "render/triangles.clh"

__kernel void project_vertices(__global const float *view, __global const float4 *positions, int count, int run,
                               __global float4 *points) {
  int begin = get_global_id(0) * run, end = begin + run < count ? begin + run : count;
  int perspective = view[PERSPECTIVE] > 0.0f;
  float tiny = 1e-6f * view[CUT];
  float4 m[4];  // columns of the map to (x w, y w, depth)
  for (int c = 0; c < 4; c++) {
    float X = c < 3 ? view[SCALE] * view[c] : view[OFFSET], Y = c < 3 ? view[SCALE] * view[3 + c] : view[OFFSET + 1];
    float Z = c < 3 ? view[SCALE] * view[6 + c] : view[OFFSET + 2], w = perspective ? -Z : c < 3 ? 0.0f : 1.0f;
    m[c] = (float4)(view[FX] * X + view[CX] * w, -view[FY] * Y + view[CY] * w, -Z, 0.0f);
  }
  for (int i = begin; i < end; i++) {
    float4 p = positions[i], q = m[0] * p.x + m[1] * p.y + m[2] * p.z + m[3];
    float z = q.z;
    if (perspective) {
      z = z < tiny && z > -tiny ? tiny : z;
      float inv = 1.0f / z;
      q = (float4)(q.x * inv, q.y * inv, -inv, z);
    } else q.w = z;
    float4 none = q - q;  // NaN where q is not finite
    points[i] = none.x + none.y + none.z + none.w == 0.0f ? q : (float4)(0.0f, 0.0f, 0.0f, -INFINITY);
  }
}
