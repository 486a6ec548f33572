// Where the surface seen ends between two neighbouring pixels, in front of another or of the background: bytes as those
// of `line_edges`, 0 before. A jump to a fringe, a last pixel of the farther surface that no other follows, does not
// count: normals and depths of such pixels at contours are wrong by more than jumps are. One work-item per VW pixels.
// Twin: tests/reference/lines.py.
#include "analysis/line_planes.clh"
enum { EDGE_RIGHT = 1, EDGE_DOWN = 2 };

// Where `hit` pixels are cut from the next ones: not linked, and none or the farther one being more than a fringe.
INLINE VI cut(VI own, VI next, VI before, VF depth, VF next_depth, int link) {
  VI alone = SEL((before & link) == 0, (next & link) == 0, next_depth > depth);
  return ((own & link) == 0) & (((own & next & HIT) == 0) | NOT(alone)) & (((own | next) & HIT) != 0);
}

__kernel void contour_edges(int width, int height, int stride, __global const int *links, __global const float *depths,
                            __global uchar *codes) {
  int x = get_global_id(0) * VW, y = get_global_id(1);
  if (x >= width || y >= height) return;
  size_t at = PLANE_AT(x, y);
  __global const int *here = links + at;
  VI own = LOAD_INT(here), right = LOAD_INT(here + 1), down = LOAD_INT(here + stride), px = x + LANE_INDEX;
  if (!any_lane((own | right | down) != 0)) return;
  VF depth = LOAD(depths + at);
  // Pixels on the picture's borders have nothing beyond to be cut from.
  VI cut_right = cut(own, right, LOAD_INT(here - 1), depth, LOAD(depths + at + 1), LINK_RIGHT) & (px + 1 < width);
  VI cut_down = cut(own, down, LOAD_INT(here - stride), depth, LOAD(depths + at + stride), LINK_DOWN) & (px < width);
  VI code = SEL((VI)(0), (VI)(EDGE_RIGHT), cut_right);
  if (y + 1 < height) code |= SEL((VI)(0), (VI)(EDGE_DOWN), cut_down);
  if (!any_lane(code != 0)) return;
  __global uchar *to = codes + (size_t)y * (stride - 2 * MARGIN_X) + x;
#if VW == 1
  *to = (uchar)code;
#else
  for (int i = 0; i < VW; i++) to[i] = (uchar)((int *)&code)[i];
#endif
}
