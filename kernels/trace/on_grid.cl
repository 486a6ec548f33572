// Whether rays lie on a grid (clsurf/trace/grids.py): *off becomes 1 where one is farther than `tolerance` from its
// place in the plane of the grid. A work-item a ray.
#pragma OPENCL EXTENSION cl_khr_fp64 : enable

// `grid`: 4 vectors, the common origin or unit direction, the corner, the steps right and down.
__kernel void on_grid(int count, int width, int perspective, __global const double *grid, double tolerance,
                      __global const double *origins, int origin_step, __global const double *directions,
                      int direction_step, __global int *off) {
  int i = get_global_id(0);
  if (i >= count) return;
  __global const double *o = origins + (size_t)i * origin_step, *d = directions + (size_t)i * direction_step;
  double x = i % width, y = i / width, apart = 0.0, length = 0.0, along = 0.0, at[3];
  for (int a = 0; a < 3; a++) {
    at[a] = grid[3 + a] + x * grid[6 + a] + y * grid[9 + a];
    length += d[a] * d[a];
    along += d[a] * (perspective ? at[a] : grid[a]);
  }
  for (int a = 0; a < 3; a++) {
    double same = perspective ? o[a] - grid[a] : o[a] - at[a];
    // How far the grid's point is from the ray; unit vectors may differ by 1e-9.
    double turned = perspective ? at[a] - d[a] * (along / length) : (grid[a] - d[a] * (along / length)) * tolerance * 1e9;
    apart += (perspective && same != 0.0 ? 1e300 : perspective ? 0.0 : same * same) + turned * turned;
  }
  if (!(apart <= tolerance * tolerance && along > 0.0 && length < INFINITY)) *off = 1;
}
