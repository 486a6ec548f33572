"""The tables of the paper on spatial patches beside ours: models, Earths, what a picture takes, and triangles.

Ours are counted in the view that `views.direction(30, 20)` gives with the model filling the picture; the paper does not
say how large its models were.
"""

from clsurf.render.camera import Camera
from clsurf.render.normal_table import normal_statistics
from clsurf.report.statistics import patch_statistics

from . import views
from .table import print_table

FRAME_BYTES, NODE_BYTES = 40, 4  # RGB and an 8-bit displacement
# Tables 1 and 2, sections 4.3 and 4.5: patches, nodes, MB (10^6 bytes).
PAPER_MODELS = {"bunny": (1526, 441_014, 1.83), "mannequin": (1145, 330_905, 1.37), "earth 383": (383, 110_687, 0.45),
                "earth 1128": (1128, 325_992, 1.35), "earth 2712": (2712, 783_768, 3.17), "sphere": (1362, None, 0.440),
                "head": (837, 361_244, None)}
# Table 3, at 500x500: interpolated nodes; normals computed in % with a buffer, and with patches ordered too.
PAPER_VIEWS = {"bunny": (1_076_888, 76.0, 2.8), "mannequin": (863_600, 76.0, 3.7), "earth 1128": (541_462, 55.0, 1.9),
               "head": (263_589, 46.6, 18.2)}
PAPER_PLAIN = "85-95 % / 45-85 %"  # section 5, at 150x150: patches without interpolation, of those found cheaply
PAPER_TRIANGLES = 2.0  # section 5: operations of triangles over those of bilinear subdivision


def measure(surfaces: dict, paper_size, small_size) -> dict:
    """Return the figures beside those of the paper, by model."""
    return {name: row(surface, paper_size, small_size) for name, surface in surfaces.items()}


def row(surface, paper_size, small_size) -> dict:
    """Return the counts of one model in a picture of the paper's size and in a small one."""
    camera = Camera.framing(surface, views.direction(30, views.ELEVATION), views.FOV)
    large, small = (patch_statistics(surface, camera, size) for size in (paper_size, small_size))
    normals = normal_statistics(surface)
    operations = large.operations
    return {"patches": len(surface), "nodes": surface.node_count, "nbytes": surface.nbytes,
            "colored_nbytes": FRAME_BYTES * len(surface) + NODE_BYTES * surface.node_count,
            "visible_patches": large.visible_patches, "interpolated_nodes": large.interpolated_nodes,
            "normals": {"groups": normals.groups, **normals.shares},
            "plain_share": large.plain_share, "small_plain_share": small.plain_share,
            "small_cheap_share": small.cheap_share,
            "operations": {mode: counted.total for mode, counted in operations.items()},
            "triangles_over_bilinear": operations["triangles"].total / max(operations["bilinear"].total, 1)}


def show(tables: dict) -> None:
    """Print the tables; the paper's figures stand behind ours."""
    print("\nmodels: ours | paper (tables 1 and 2, sections 4.3 and 4.5); MB with RGB and 8-bit displacements")
    rows = []
    for name, ours in tables.items():
        patches, nodes, megabytes = PAPER_MODELS.get(name, (None,) * 3)
        own, colored = f"{ours['nbytes'] / 1e6:.3f}", f"{ours['colored_nbytes'] / 1e6:.2f}"
        paper = f" | {_text(megabytes, '.2f')}"
        own, colored = (own + paper, colored) if name == "sphere" else (own, colored + paper)
        rows.append((name, f"{ours['patches']:,} | {_text(patches, ',')}", f"{ours['nodes']:,} | {_text(nodes, ',')}",
                     own, colored))
    print_table(("model", "patches", "nodes", "MB", "MB coloured"), rows)
    print("\nviews at 500x500: ours | paper (table 3); normals computed with a buffer, with ordered patches, in %")
    rows = []
    for name, ours in tables.items():
        created, buffered, ordered = PAPER_VIEWS.get(name, (None,) * 3)
        shares = ours["normals"]
        rows.append((name, f"{ours['interpolated_nodes']:,} | {_text(created, ',')}",
                     f"{100 * shares['buffered']:.1f} | {_text(buffered, '.1f')}",
                     f"{100 * shares['ordered']:.1f} | {_text(ordered, '.1f')}", shares["groups"],
                     f"{ours['triangles_over_bilinear']:.2f} | {PAPER_TRIANGLES:g}"))
    print_table(("model", "interpolated nodes", "buffered", "ordered", "groups", "triangles / bilinear"), rows)
    print(f"\nviews at 150x150: patches without interpolation, of those found by the cheap test; paper {PAPER_PLAIN}")
    print_table(("model", "without", "found"), [(name, f"{ours['small_plain_share']:.1%}",
                                                 f"{ours['small_cheap_share']:.1%}") for name, ours in tables.items()])


def _text(value, form: str) -> str:
    return "-" if value is None else format(value, form)
