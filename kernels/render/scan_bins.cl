// Turn the counts of each bin into offsets within it, chunk after chunk, and write the totals. Twin: scan_bins.
__kernel void scan_bins(__global uint *counts, int parts, int bin_count, __global uint *totals) {
  int bin = get_global_id(0);
  if (bin >= bin_count) return;
  uint sum = 0;
  for (int part = 0; part < parts; part++) {
    size_t at = (size_t)part * bin_count + bin;
    uint here = counts[at];
    counts[at] = sum;
    sum += here;
  }
  totals[bin] = sum;
}
