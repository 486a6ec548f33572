"""What is to be said of a surfel hierarchy: its levels and maps, and what the view draws."""

import numpy as np

from ..render.tiles import BIN
from ..surface.placed import Placed
from .charts import columns
from .sections import Section, View, table


def surfel_sections(surface, view: View, number: int) -> list[Section]:
    """Return what is to be said of a surfel hierarchy and of a frame with "id", "level", "count" and "cost"."""
    own = surface.surface if isinstance(surface, Placed) else surface
    levels, inner = int(own.level.max(initial=0)), len(own) - len(own.base)
    finest = ("Triangles", f"{len(own.triangles):,}") if own.hybrid else ("Base surfels", f"{len(own.base):,}")
    covered = float(np.mean(own.normal_atlas[:, 3] > 0)) if len(own.normal_atlas) else 1.0
    maps = own.map_size[:inner]
    rows = [finest, ("Inner surfels", f"{inner:,}"), ("levels", levels), ("Spacing", f"{own.spacing:.4g}"),
            ("Normal maps", f"{int(maps.min(initial=64))} to {int(maps.max(initial=0))} texels across"),
            ("Texels", f"{len(own.normal_atlas):,}, {covered:.1%} covered"),
            ("Data size", f"{own.nbytes / 1e6:.2f} MB")]
    names, by_level = [str(k) for k in range(1, levels + 1)], np.bincount(own.level, minlength=levels + 1)[1:]
    chart = columns(names, by_level.tolist(), "surfels by level", "level, surfels")
    model = Section("Model", table(("", "this model"), rows) + "<h3>Surfels by level</h3>" + chart)
    frame = view.frame
    shown = frame.id == number
    if not shown.any():
        return [model, Section("View", "<p>No pixel shows this surface.</p>")]
    spread = lambda v: f"mean {v.mean():.1f}, median {np.median(v):.3g}, at most {v.max():.3g}"  # noqa: E731
    blended = frame.count[shown]
    facts = [("Pixels that show it", f"{int(shown.sum()):,}"), ("Surfels blended at a pixel", spread(blended)),
             ("Evaluations a pixel", spread(frame.cost[shown] / BIN**2))]
    drawn = np.bincount(np.maximum(frame.level[shown], 0), minlength=levels + 1)[1:levels + 1]
    pixels = columns(names, drawn.tolist(), "pixels by level", "level of the surfel in front, pixels")
    return [model, Section("View", table((), facts) + f"<h3>Levels drawn</h3>{pixels}")]
