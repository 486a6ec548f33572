"""Fragments of range images: connected cells of a block of the image, each seen by one plane."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..device import Device
from ..surface.arrays import finite_rows
from .range_fields import RangeField

SPACING = 1.2  # distance between nodes over that of samples (geometric mean of both directions)
MOST = 1.4  # the same over the smaller distance of samples
MARGIN = 1.5  # nodes of a patch beyond its fragment, each side
STRETCH = 1.5  # distance between nodes over that of the fragment's own samples beyond which a fragment is divided
LEAST_FACING = 0.5  # cosine to the fragment's normal
BEHIND = 0.02  # share of a fragment's area that may turn away farther than that
HALVINGS = 2  # of blocks, each way
LEAST_CELLS = 2  # of a fragment
FIELDS = 20  # floats of fit_fragments.cl


@dataclass(eq=False)
class Fragments:
    """What fit_fragments gives, `labels` the fragment of each cell, -1: none."""

    rects: NDArray  # (f, 5) int32: image, first row, first column, rows, columns of cells
    figures: NDArray  # (f, 20) float32
    labels: NDArray  # (n,) int32

    def __len__(self):
        return len(self.rects)

    center = property(lambda self: self.figures[:, 1:4])
    normal = property(lambda self: self.figures[:, 4:7])
    along = property(lambda self: self.figures[:, 7:10])
    sample_steps = property(lambda self: self.figures[:, 10:12])
    extent = property(lambda self: self.figures[:, 13:19].reshape(-1, 3, 2))  # (f, axis, least and most)
    weight = property(lambda self: self.figures[:, 19])


def margin_of(count: int) -> float:
    """Return the nodes that a patch of `count` nodes along an axis keeps beyond its fragment, each side."""
    return min(MARGIN, 0.1 * (count - 1))


def find_fragments(field: RangeField, nodes, ratio: float, device: Device) -> Fragments:
    """Divide the cells of all images into fragments.

    Parameters
    ----------
    nodes : (int, int)
        m, n of a patch.
    ratio : float
        Distance between nodes over that of samples, for fragments that fill their block.
    """
    inner = np.array([count - 1 - 2 * margin_of(count) for count in nodes])
    images = device.upload(np.ascontiguousarray(field.image_table[:, :3]))
    labels, kept_rects, kept_figures, total = np.full(len(field.cells), -1, np.int32), [], [], 0
    todo = {(0, 0): field.cells > 0}  # cells by how often their block is halved, rows and columns
    while todo:
        halved = min(todo, key=sum)
        mask = todo.pop(halved)
        rects, trial = _components(field, mask, inner, ratio, halved)
        if not len(rects):
            continue
        figures = fit_fragments(field, rects, trial, images, device)
        divide = _too_wide(figures, inner, ratio) & (np.array(halved) < HALVINGS)
        good = ~divide.any(axis=1) & (figures[:, 0] >= LEAST_CELLS) & finite_rows(figures)
        number = np.where(good, total + np.cumsum(good) - 1, -1).astype(np.int32)
        inside = np.flatnonzero(trial >= 0)
        fragment = trial[inside]
        labels[inside] = number[fragment]
        kept_rects.append(rects[good])
        kept_figures.append(figures[good])
        total += int(good.sum())
        for rows, columns in ((1, 0), (0, 1), (1, 1)):
            chosen = (divide == (rows > 0, columns > 0)).all(axis=1)
            if chosen.any():
                part = todo.setdefault((halved[0] + rows, halved[1] + columns), np.zeros(len(mask), bool))
                part[inside[chosen[fragment]]] = True
    return Fragments(np.concatenate([np.zeros((0, 5), np.int32), *kept_rects]),
                     np.concatenate([np.zeros((0, FIELDS), np.float32), *kept_figures]), labels)


def _components(field: RangeField, mask: NDArray, inner: NDArray, ratio: float, halved) -> tuple[NDArray, NDArray]:
    """Return the boxes (f, 5) int32 of the connected cells of `mask` within blocks, and the label (n,) of each cell."""
    rects, trial, count = [np.zeros((0, 5), np.int32)], np.full(len(mask), -1, np.int32), 0
    for k, (rows, columns) in enumerate(field.shapes):
        pitch, part = field.pitch[k], slice(field.first[k], field.first[k + 1])
        if not (pitch > 0).all() or not mask[part].any():
            continue
        node = min(ratio * float(pitch.prod()) ** 0.5, ratio * MOST / SPACING * float(pitch.min()))
        block = [max(2, round(inner[axis] * node / pitch[axis])) for axis in (1, 0)]
        here, found = block_components(mask[part].reshape(rows, columns), block, halved)
        trial[part] = np.where(here >= 0, here + count, -1).ravel()
        rects.append(np.concatenate([np.full((len(found), 1), k), found], axis=1).astype(np.int32))
        count += len(found)
    return np.concatenate(rects), trial


def fit_fragments(field: RangeField, rects: NDArray, labels: NDArray, images, device: Device) -> NDArray:
    """Return the figures (f, 20) float32 of the fragments whose cells carry `labels`."""
    out = device.empty((len(rects), FIELDS), np.float32)
    device.kernel("build/fit_fragments.cl")((len(rects),), (1,), len(rects), device.upload(rects), images, LEAST_FACING,
                                            field.samples, device.upload(labels), out)
    return device.download(out)


def _too_wide(figures: NDArray, inner: NDArray, ratio: float) -> NDArray:
    """Return which fragments (f, 2) bool to divide by rows and by columns.

    Those that turn too far for one plane, or would get nodes too far apart.
    """
    step = np.ptp(figures[:, 13:17].reshape(-1, 2, 2), axis=2) / inner
    wide = step > STRETCH * max(1.0, ratio / SPACING) * figures[:, 10:12]
    return wide[:, ::-1] | (figures[:, 12] > BEHIND)[:, None]


def block_components(mask: NDArray, block, halved=(0, 0)) -> tuple[NDArray, NDArray]:
    """Label the connected cells within each block of rows and columns of cells.

    Parameters
    ----------
    mask : (h, w) bool
    block : (int, int)
        Rows and columns.
    halved : (int, int)
        How often the rows and the columns of each block are divided by two.

    Returns
    -------
    labels : (h, w) int32
        From 0; -1 outside the mask.
    rects : (f, 4) int64
        First row, first column, rows and columns of each label's box.
    """
    lines = []
    for count, size, times in zip(mask.shape, block, halved, strict=True):
        at = np.arange(count)
        part = -(-size // 2 ** times)
        group = at // size * size + at % size // part
        lines.append(at + np.cumsum(np.diff(group, prepend=0) != 0))  # an empty line between blocks
    # By `take`, an axis at a time: 1 ms where np.ix_ takes 4.
    wide = np.pad(mask, ((0, 1), (0, 1)))
    for axis, line in enumerate(lines):
        at = np.full(line[-1] + 1, -1)
        at[line] = np.arange(len(line))
        wide = wide.take(at, axis)
    labels, count = ndimage.label(wide)
    labels = labels.take(lines[0], 0).take(lines[1], 1) - 1
    if not count:
        return labels, np.zeros((0, 4), np.int64)
    boxes = ndimage.find_objects(labels + 1)
    return labels, np.array([(a.start, b.start, a.stop - a.start, b.stop - b.start) for a, b in boxes])
