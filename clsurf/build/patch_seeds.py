"""Lloyd's iteration over the places and normals of points: the first division of a cloud into regions."""

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import lengths_of
from .orientation import cell_numbers

ROUNDS = 6
FIRST = 1.3  # cubes that the first seeds stand in, over the width of a patch: 1 gave a quarter more regions
FLATNESS = 3.0  # weight of squared distances from a region's plane, over those along it
BEND = 2.0  # cost of 1 - cosine between normals, over the squared width of a patch: 30 degrees cost half a width


def first_seeds(sheet, side: float) -> NDArray:
    """Return a label (n,) for each point: its cube of side `side` and the cube face that its normal points to."""
    cell, _ = cell_numbers(sheet.position.astype(np.float32), side)
    axis = np.argmax(np.abs(sheet.normals), axis=1)
    face = 2 * axis + (sheet.normals[np.arange(len(axis)), axis] < 0)
    return renumbered(cell * 6 + face)[1]


def lloyd(sheet, label: NDArray, side: float) -> NDArray:
    """Return the labels (n,) after `ROUNDS` rounds of moving seeds to the means of their points."""
    tree = sheet.points.tree
    device = tree.device
    kernel = device.kernel("build/assign_regions.cl", constants={"VW": device.lanes})
    on_device = np.zeros(tree.padded, np.int32)
    for number in range(ROUNDS):
        seeds, label = seed_records(sheet, label)
        if number == ROUNDS // 2:  # what lost its points to better seeds
            seeds, label = without_small(seeds, label)
        order, boxes = sorted_seeds(seeds)
        place = np.empty(len(order), np.int32)
        place[order] = np.arange(len(order))
        on_device[:len(label)] = place[label]
        labels = device.empty(tree.padded, np.int32)
        device.write(labels, on_device)
        kernel((-(-tree.count // device.lanes),), (1,), tree.count, tree.padded, tree.sorted, len(seeds),
               device.upload(seeds[order]), device.upload(boxes), FLATNESS, BEND * side**2, labels)
        label = device.download(labels)[:tree.count]
    return label


def seed_records(sheet, label: NDArray) -> tuple[NDArray, NDArray]:
    """Return the seeds (s, 8) float32 of the labels in use (place, unit normal, 0, 0), and the labels renumbered."""
    used, label = renumbered(label)
    sizes = np.bincount(label, minlength=used)
    out = np.zeros((used, 8), np.float32)
    for k in range(3):
        out[:, k] = np.bincount(label, sheet.position[:, k], used) / sizes
        out[:, 3 + k] = np.bincount(label, sheet.normals[:, k], used)
    length = lengths_of(out[:, 3:6], keepdims=True)
    out[:, 3:6] = np.where(length > 1e-6, out[:, 3:6] / np.maximum(length, 1e-6), [0, 0, 1])
    return out, label


def renumbered(label: NDArray) -> tuple[int, NDArray]:
    """Return how many labels 0, 1, ... are in use, and the labels without the unused; negative ones stay."""
    used = np.bincount(label[label >= 0])
    number = np.cumsum(used > 0) - 1
    return int((used > 0).sum()), np.where(label >= 0, number[np.maximum(label, 0)] if len(number) else -1, -1)


def without_small(seeds: NDArray, label: NDArray) -> tuple[NDArray, NDArray]:
    """Drop the seeds with less than a quarter of the median number of points; these start anew at seed 0."""
    sizes = np.bincount(label, minlength=len(seeds))
    keep = sizes >= 0.25 * np.median(sizes)
    number = np.where(keep, np.cumsum(keep) - 1, 0)
    return seeds[keep], number[label]


def sorted_seeds(seeds: NDArray) -> tuple[NDArray, NDArray]:
    """Return the order (s,) of seeds along a Morton curve, and the boxes (ceil(s / 16), 8) of 16 each."""
    place = seeds[:, :3]
    low, high = place.min(axis=0), place.max(axis=0)
    cell = ((place - low) / max(float((high - low).max()), 1e-30) * 1023).astype(np.int64)
    code = np.zeros(len(seeds), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.lexsort((*seeds.T[:6], code))
    starts = np.arange(0, len(seeds), 16)
    boxes = np.zeros((len(starts), 8), np.float32)
    boxes[:, :3] = np.minimum.reduceat(place[order], starts)
    boxes[:, 3:6] = np.maximum.reduceat(place[order], starts)
    return order, boxes
