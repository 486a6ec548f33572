"""How many arithmetic operations a rendering unit of the paper's kind spends on patches, per mode: a model.

Source: the paper on spatial patches, sections 3 and 5. Its simulator counted operations; these tables derive them from
the steps of each mode. A value has the components x, y, depth (3) at a node and x, y, depth, red, green, blue (6) in a
cell; every operation is counted per component. Comparisons, reads and writes are not counted.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Operations:
    """Numbers of arithmetic operations, each on one component."""

    additions: float = 0  # and subtractions
    shifts: float = 0
    multiplications: float = 0
    divisions: float = 0

    @property
    def total(self) -> float:
        """All operations, a division counted as one."""
        return self.additions + self.shifts + self.multiplications + self.divisions

    def __add__(self, other: "Operations") -> "Operations":
        return Operations(*(a + b for a, b in zip(self.each(), other.each(), strict=True)))

    def __mul__(self, times: float) -> "Operations":
        return Operations(*(a * times for a in self.each()))

    def each(self) -> tuple[float, float, float, float]:
        """Return additions, shifts, multiplications, divisions."""
        return self.additions, self.shifts, self.multiplications, self.divisions


# A homogeneous corner to the screen: 3 x 3 products and sums, then x / w and y / w by one reciprocal.
_CORNER = Operations(additions=9, multiplications=9 + 2, divisions=1)

# Nodes. `patch` is spent once a visible patch, `node` once an opaque node of it (section 3, "nodes traversal").
NODES = {
    # Origin and three axes to homogeneous screen space; a node steps along x, adds d times z, and is divided.
    "exact": {"patch": Operations(additions=9 + 3 * 6, multiplications=4 * 9),
              "node": Operations(additions=3 + 3, multiplications=3 + 2, divisions=1)},
    # Eight projected corners; at a node the ends of its displacement range differ from their neighbours by one
    # addition a component each, then low + d times slope. No division: the paper's "drastically reduced" number.
    "trilinear": {"patch": _CORNER * 8, "node": Operations(additions=3 + 3 + 3, multiplications=3)},
    # The same between corners that are not divided yet, and then the division of every node.
    "homogeneous": {"patch": Operations(additions=9, multiplications=9) * 8,
                    "node": Operations(additions=3 + 3 + 3, multiplications=3 + 2, divisions=1)},
}

# Cells. `cell` is spent once a touched cell, the others once a part, created node, scan line or pixel of it.
CELLS = {
    # Four edge functions (2 differences, 2 products and a sum each), bilinear weights from the inverse of the mapping
    # at the first pixel (its quadratic: 3 cross products, a root by one division), then steps a pixel: 4 edge
    # functions, and for depth and colours two interpolations along and one across of 4 components each.
    "quads": {"cell": Operations(additions=4 * 3 + 3, multiplications=4 * 2 + 6, divisions=1),
              "pixel": Operations(additions=4 + 3 * 8, multiplications=3 * 4)},
    # Scan conversion of both triangles. Each has three edges (a height, its reciprocal, five slopes: x, depth, colours)
    # and constant steps along a line for depth and colours (an area of 2 products, one reciprocal, 3 products and a
    # sum a component); a line starts with six steps of the edges and the way to the first pixel's centre (four
    # components); a pixel takes four steps.
    "triangles": {"cell": Operations(additions=3 * 6 + 1 + 4, multiplications=3 * 5 + 2 + 4 * 3, divisions=3 + 1) * 2,
                  "line": Operations(additions=6 + 1 + 4, multiplications=4), "pixel": Operations(additions=4)},
    # Every part of the recursion is measured, the cell itself included (four edges, x and y: 8 differences); a new node
    # halves the sum of two (section 3: "no more than 1 addition and 1 bitwise shift per each new node").
    "bilinear": {"part": Operations(additions=8), "created": Operations(additions=6, shifts=6)},
    # The four-point midpoint (9 (b + c) - (a + d)) / 16, which is continuous in its first derivative: 4 additions and
    # 2 shifts, 9 s being (s << 3) + s (section 3: "about three times this number of operations").
    "smooth": {"part": Operations(additions=8), "created": Operations(additions=6 * 4, shifts=6 * 2)},
}


def counted_operations(patches: int, nodes: int, cells: int, parts: int, created: int, lines: int,
                       pixels: float) -> dict[str, Operations]:
    """Return the operations of every mode by name.

    Parameters
    ----------
    patches, nodes : int
        Visible patches and their opaque nodes.
    cells : int
        Touched cells.
    parts : int
        The touched cells and all parts that subdivision makes of them, of every level.
    created : int
        Nodes that subdivision creates.
    lines : int
        Scan lines of both triangles of every cell.
    pixels : float
        Pixels that the cells cover, each cell by itself.
    """
    numbers = {"patch": patches, "node": nodes, "cell": cells, "part": parts, "created": created, "line": lines,
               "pixel": pixels}
    return {mode: sum((cost * numbers[what] for what, cost in table.items()), Operations())
            for mode, table in (NODES | CELLS).items()}
