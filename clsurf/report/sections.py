"""What a report says about each kind of surface."""

from dataclasses import dataclass
from html import escape

import numpy as np

from ..render.camera import Camera
from ..render.frame import Frame
from ..surface.placed import Placed
from .charts import bars, columns, stacked
from .operations import CELLS, NODES
from .slim import slim_statistics
from .statistics import PatchStatistics, patch_statistics

SMALL = 150  # longest side in pixels of the second view that the paper tells of


@dataclass(frozen=True)
class Section:
    """A heading and what stands below it, as HTML."""

    title: str
    html: str


@dataclass(frozen=True, eq=False)
class View:
    """What a report looks at."""

    camera: Camera
    size: tuple[int, int]  # width, height, pixels
    frame: Frame  # with the channels of clsurf.report.page.CHANNELS


def table(head, rows) -> str:
    """Return a table; the first cell of a row is its heading, indented where it is in lower case. Texts are escaped."""
    lines = ["<thead><tr>", *(f'<th scope="col">{escape(c)}</th>' for c in head), "</tr></thead>"] if head else []
    lines.append("<tbody>")
    for first, *rest in rows:
        part = ' class="part"' if head and first[:1].islower() else ""
        lines += [f'<tr{part}><th scope="row">{escape(first)}</th>', *(f"<td>{escape(str(c))}</td>" for c in rest),
                  "</tr>"]
    kind = "numbers" if head else "facts"
    return f'<div class="wide"><table class="{kind}">{"".join(lines)}</tbody></table></div>'


# Spatial patches ------------------------------------------------------------------------------------------------------


def patch_sections(surface, view: View, number: int) -> list[Section]:
    """Return what is to be said of spatial patches: the paper's Table 3, cells, operations by mode."""
    views = [patch_statistics(surface, view.camera, view.size)]
    longest = max(view.size)
    if longest > SMALL:
        small = tuple(max(1, round(n * SMALL / longest)) for n in view.size)
        views.append(patch_statistics(surface, view.camera, small))
    return [_characteristics(surface, views), _cells(views[0]), _operations(views[0])]


def _characteristics(surface, views: list[PatchStatistics]) -> Section:
    def line(name, value):
        return name, *map(value, views)
    share = lambda part, whole: f"{part:,} ({part / whole:.1%})" if whole else f"{part:,}"  # noqa: E731
    percent = lambda value: "-" if np.isnan(value) else f"{value:.1%}"  # noqa: E731
    rows = [
        line("Patches", lambda s: f"{s.patches:,}"),
        line("visible", lambda s: share(s.visible_patches, s.patches)),
        line("across the picture's border", lambda s: f"{s.partial_patches:,}"),
        line("facing the eye", lambda s: share(s.facing_patches, s.patches)),
        line("Patch nodes", lambda s: f"{s.nodes:,}"),
        line("opaque", lambda s: share(s.opaque_nodes, s.nodes)),
        line("projected", lambda s: f"{s.projected_nodes:,}"),
        line("Cells", lambda s: f"{s.cells:,}"),
        line("touched", lambda s: share(s.cells_touched, s.cells)),
        line("Interpolated nodes", lambda s: f"{s.interpolated_nodes:,}"),
        line("Patches without interpolation", lambda s: percent(s.plain_share)),
        line("of those, found by the cheap test", lambda s: percent(s.cheap_share)),
        line("Normals with buffer", lambda s: percent(s.normals.shares["buffered"])),
        line("with buffer, ordered", lambda s: percent(s.normals.shares["ordered"])),
        line("with a table computed beforehand", lambda s: percent(s.normals.shares["precomputed"])),
        line("Data size", lambda s: f"{s.nbytes / 1e6:.2f} MB"),
    ]
    heads = [f"{w} x {h}" for w, h in (s.size for s in views)]
    one = views[0]
    chart = stacked([(head, [s.cheap_patches, s.plain_patches - s.cheap_patches, s.visible_patches - s.plain_patches],
                      f"{s.visible_patches:,}") for head, s in zip(heads, views, strict=True)],
                    ["plain, found cheaply", "plain", "interpolated"], "visible patches by what their cells need")
    nodes = bars([("patch nodes", one.nodes, f"{one.nodes:,}"), ("projected", one.projected_nodes,
                  f"{one.projected_nodes:,}"), ("interpolated", one.interpolated_nodes, f"{one.interpolated_nodes:,}")],
                 "nodes of the model, projected, interpolated")
    own = surface.surface if isinstance(surface, Placed) else surface
    sizes = f"{own.size[0, 0]} x {own.size[0, 1]} nodes each" if len(own) and own.equal_sizes else "several sizes"
    return Section("Model and view", f"<p>Spatial patches, {sizes}; the rows of the paper's Table 3 and the shares of "
                   f"its section 5, at this size and, same camera, small.</p>{table(('', *heads), rows)}"
                   f"<h3>Visible patches</h3>{chart}<h3>Nodes</h3>{nodes}")


def _cells(s: PatchStatistics) -> Section:
    levels = [f"1/{2 ** k}" if k else "whole" for k in range(len(s.cell_levels))]
    chart = columns(levels, list(s.cell_levels), "touched cells by how far they are subdivided",
                    "parts of a cell's longer side that are a pixel long at most")
    text = f"<p>{s.cells_touched:,} cells are touched; together they cover {s.pixels:,.0f} pixels " \
           f"({s.pixels / max(s.cells_touched, 1):.2f} each).</p>"
    return Section("Cells", text + (chart if s.cell_levels else ""))


def _operations(s: PatchStatistics) -> Section:
    kinds = ["additions", "shifts", "multiplications", "divisions"]
    names = [*((mode, f"nodes: {mode}") for mode in NODES), *((mode, f"cells: {mode}") for mode in CELLS)]
    rows = [(name, s.operations[mode]) for mode, name in names]
    chart = stacked([(name, list(o.each()), f"{o.total / 1e6:.2f} M") for name, o in rows], kinds,
                    "operations by mode")
    numbers = table(("Mode", *kinds, "all"), [(name, *(f"{v:,.0f}" for v in o.each()), f"{o.total:,.0f}")
                                              for name, o in rows])
    ratio = s.operations["triangles"].total / max(s.operations["bilinear"].total, 1)
    text = f"<p>A model of the paper's rendering unit (clsurf.report.operations). Triangles take {ratio:.2f} times " \
           "the operations of bilinear subdivision here; the paper says double on average.</p>"
    return Section("Operations by mode", text + chart + numbers)


# SLIM -----------------------------------------------------------------------------------------------------------------


def slim_sections(surface, view: View, number: int) -> list[Section]:
    """Return what is to be said of a SLIM surface: its levels, and what the view evaluates."""
    s = slim_statistics(surface, view.frame, number)
    levels = range(1, len(s.leaves_by_level) + 1)
    rows = [("Surfels", f"{s.surfels:,}"), ("leaves", f"{s.leaves:,}"), ("levels", len(levels)),
            ("links", f"{s.links:,}"), ("Floats in the leaves", f"{s.floats:,}"),
            ("Data size", f"{s.nbytes / 1e6:.2f} MB")]
    chart = stacked([(f"level {k}", [int(s.leaves_by_level[k - 1]), int(s.internal_by_level[k - 1])],
                      f"{s.leaves_by_level[k - 1] + s.internal_by_level[k - 1]:,}") for k in levels],
                    ["leaves", "internal"], "surfels by level")
    model = Section("Model", table(("", "this model"), rows) + "<h3>Surfels by level</h3>" + chart)
    if not s.covered:
        return [model, Section("View", "<p>No pixel shows this surface.</p>")]
    spread = lambda v: f"mean {v.mean():.1f}, median {np.median(v):.3g}, at most {v.max():.3g}"  # noqa: E731
    facts = [("Pixels that show it", f"{s.covered:,}"), ("Surfels blended at a pixel", spread(s.blended)),
             ("Evaluations a pixel", spread(s.cost))]
    drawn = columns([str(k) for k in levels], s.pixels_by_level.tolist(), "pixels by level",
                    "level of the surfel in front, pixels")
    most = int(np.percentile(s.blended, 99)) + 1
    counts = np.bincount(np.minimum(s.blended, most), minlength=most + 1)
    labels = [str(k) for k in range(most)] + [f"{most}+"]
    blended = columns(labels, counts.tolist(), "pixels by the number of surfels blended", "surfels blended, pixels")
    return [model, Section("View", table((), facts) + f"<h3>Levels drawn</h3>{drawn}<h3>Surfels blended</h3>{blended}")]
