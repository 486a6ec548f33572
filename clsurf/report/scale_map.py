"""What a report says of scale maps."""

import numpy as np

from ..render.tiles import BIN
from ..surface.cube import texel_angles
from ..surface.placed import Placed
from .charts import columns
from .sections import Section, View, table

BARS = 20


def scale_map_sections(surface, view: View, number: int) -> list[Section]:
    """Return what is to be said of a scale map: its texels and scales, the rays it loses, and what the view shows."""
    own = surface.surface if isinstance(surface, Placed) else surface
    several = "not known" if np.isnan(own.multiple_share) else f"{own.multiple_share:.2%} of the sphere of directions"
    rows = [("Texels", f"6 x {own.size} x {own.size}, {own.layers} layer{'s' * (own.layers > 1)}"),
            ("Bits of a scale", own.bits), ("Normals", "none" if own.normals is None else "24 bits a texel"),
            ("Radius of the sphere", f"{own.radius:.6g}"), ("Hits kept", own.hit),
            ("Rays without a hit", f"{((~own.valid[0]) * texel_angles(own.size)).sum():.2%}"),
            ("Rays with several hits", several), ("Data size", f"{own.nbytes / 1e6:.2f} MB")]
    scales = own.lambdas[0][own.valid[0]]
    counts = np.histogram(scales, BARS, (0, 1))[0] if len(scales) else np.zeros(BARS, int)
    chart = columns([f"{k / BARS:g}" for k in range(BARS)], counts.tolist(), "texels by their scale",
                    "distance from the centre over the radius")
    model = Section("Model", table((), rows) + "<h3>Scales</h3>" + chart)
    shown = view.frame.id == number
    if not shown.any():
        return [model, Section("View", "<p>No pixel shows this surface.</p>")]
    cost = view.frame.cost[shown] / BIN ** 2
    facts = [("Pixels that show it", f"{int(shown.sum()):,}"),
             ("Tests of a cell a pixel", f"mean {cost.mean():.1f}, median {np.median(cost):.3g}, at most "
                                         f"{cost.max():.3g}")]
    facts += [(f"Pixels of layer {k}", f"{int((view.frame.level[shown] == k).sum()):,}") for k in range(own.layers)
              if own.layers > 1]
    return [model, Section("View", table((), facts))]
