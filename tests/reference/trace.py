"""Plain float64 twins of the packet kernels in kernels/trace: every ray asks every surfel, without a tree."""

import numpy as np

from . import render


def trace_pixels(surface, view, size):
    """Depth, gradient, weight and number of surfels of every pixel: what the tile renderer's twin sees of leaves."""
    keep = np.flatnonzero(surface.leaf)
    footprint = None if surface.footprint is None else surface.footprint[keep]
    return render.tile_slim(surface.degree, view, render.project_slim(view, surface)[keep], render.pixel_centres(size),
                            surface.oriented, footprint)
