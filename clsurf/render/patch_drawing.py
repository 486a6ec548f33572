"""How spatial patches are drawn."""

from dataclasses import dataclass

from ..errors import InputError

CHOICES = {"nodes": ("exact", "trilinear", "homogeneous"), "cells": ("quads", "triangles", "bilinear", "smooth"),
           "shading": ("pixel", "gouraud"), "normals": ("bilinear", "smooth"),
           "normal_table": (False, True, "ordered", "precomputed")}


@dataclass(frozen=True)
class PatchDrawing:
    """How spatial patches are drawn (paper, section 3); the default is the fastest way that leaves no holes.

    Parameters
    ----------
    nodes : str
        Projection of nodes: "exact"; "trilinear" from the projected corners of the patch's box, the paper's;
        "homogeneous", the same before the division, which is exact.
    cells : str
        What fills a cell: "quads", two "triangles", or subdivided points, "bilinear" or "smooth".
    shading : str
        Light per "pixel", or at the nodes ("gouraud").
    normals : str
        Interpolation of normals, "bilinear" or "smooth".
    normal_table : bool or str
        Take normals from a table of 512 KB; True, "ordered" or "precomputed".
    alpha : bool
        Draw cells with transparent nodes, their edge at half alpha.
    direct : bool
        Patches whose cells are nowhere larger than a pixel write their nodes directly.
    mip : bool
        Draw minified patches from coarser levels.
    cull : bool
        Leave out patches that are seen from behind only; right for closed surfaces.
    """

    nodes: str = "exact"
    cells: str = "quads"
    shading: str = "pixel"
    normals: str = "bilinear"
    normal_table: bool | str = False
    alpha: bool = False
    direct: bool = True
    mip: bool = True
    cull: bool = False

    def __post_init__(self):
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise InputError(f"patches {name}: expected one of {', '.join(map(str, choices))}, got {value!r}")
