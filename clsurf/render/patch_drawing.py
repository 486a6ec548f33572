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
        What fills a cell: "quads", two "triangles", or points less than a pixel apart that subdivide it, "bilinear" or
        "smooth" (C1 over the patch; it passes through the nodes). Points widen outlines by up to half a pixel.
    shading : str
        Light per "pixel", or at the nodes ("gouraud"), with colours interpolated.
    normals : str
        Interpolation of the nodes' normals: "bilinear", or "smooth", those of the C1 surface.
    normal_table : bool or str
        Take the nodes' normals from a table of 512 KB per compute unit: True, with the patches as they come; "ordered"
        by axis ratios; "precomputed", for patches of equal ratios. For 8-bit displacements; draws no coarser levels.
        Slower than computing them (1.35 times a frame, ordered 1.15).
    alpha : bool
        Draw cells with transparent nodes up to where their interpolated alpha is 1/2; an RGBA node has its own. Smooth
        edges come from supersampling.
    direct : bool
        Patches whose cells are nowhere larger than a pixel write their nodes directly ("quads" and "triangles").
    mip : bool
        Draw minified patches from coarser levels: the coarsest with nodes at most a pixel apart.
    cull : bool
        Leave out patches that are seen from behind only; right for closed surfaces. Not with "smooth" cells.
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
            if not isinstance(value, bool | str) or value not in choices:
                raise InputError(f"patches {name}: expected one of {', '.join(map(str, choices))}, got {value!r}")
        for name in ("alpha", "direct", "mip", "cull"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"patches {name}: expected True or False, got {getattr(self, name)!r}")
