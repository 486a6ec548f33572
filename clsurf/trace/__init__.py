"""Ray tracing: the wide tree of every traced primitive, packets of rays, single rays."""
