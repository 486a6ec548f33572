"""The scenes of the jobs that stand for all kernels (answers.py): scans, the surfaces made of them, the camera."""

from dataclasses import dataclass, replace

import numpy as np

import clsurf
from clsurf.surface.mesh import Mesh
from clsurf.surface.ranges import RangeImage, RangeScan


@dataclass(frozen=True)
class Size:
    """How large the scenes are: "tiny" for checkers that take a thousand times longer, "small" for comparisons."""

    points: int
    picture: tuple[int, int]
    rays: int
    lit: tuple[int, int] = (480, 360)  # pictures with traced light, whose pixels cost ten times as much
    occlusion: int = 32  # directions
    sky_cells: int | None = None  # along a side of the maps of image lights; None: as always


SIZES = {"tiny": Size(300, (40, 32), 40, (20, 16), 8, 8), "small": Size(20_000, (480, 360), 20_000)}


def scans(size: Size) -> dict:
    """Return the scans that the jobs read: a torus as cloud and mesh, a wavy range image."""
    cloud = clsurf.models.torus(size.points)
    ring = max(8, int(np.sqrt(2 * size.points)))
    mesh = torus_mesh(ring, max(6, ring // 2))
    return {"cloud": cloud, "mesh": mesh, "ranges": wavy_ranges(max(12, int(np.sqrt(size.points))))}


def torus_mesh(around: int, across: int) -> Mesh:
    """Return a closed, coloured mesh of the torus with radii 1 and 0.4."""
    t, s = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(across) * 2 * np.pi / across, indexing="ij")
    ring = 1 + 0.4 * np.cos(s)
    points = np.stack([ring * np.cos(t), ring * np.sin(t), 0.4 * np.sin(s)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    here, on = i * across + j, (i + 1) % around * across + j
    up, both = i * across + (j + 1) % across, (i + 1) % around * across + (j + 1) % across
    faces = np.stack([here, on, both, here, both, up], axis=-1).reshape(-1, 3)
    colors = np.full((len(points), 4), 255, np.uint8)
    colors[:, :3] = 40 + 180 * (points - points.min(axis=0)) / np.ptp(points, axis=0)
    return Mesh(points, faces, colors=colors)


def wavy_ranges(n: int) -> RangeScan:
    """Return one coloured depth image of a wavy sheet with a step in it."""
    y, x = np.mgrid[:n, :n]
    depth = (2 + 0.1 * np.sin(6 * x / n) * np.cos(4 * y / n) + 0.4 * (x > n // 2)).astype(np.float32)
    depth[:2, :3] = np.nan
    color = np.zeros((n, n, 4), np.uint8)
    color[..., 0], color[..., 1], color[..., 3] = 255 * x // n, 255 * y // n, 255
    intrinsics = np.array([[n, 0, n / 2], [0, n, n / 2], [0, 0, 1.0]])
    return RangeScan([RangeImage(depth=depth, intrinsics=intrinsics, color=color, pose=np.eye(4))])


def surfaces(device, size: Size) -> dict:
    """Return the surfaces that the jobs draw and measure, made on `device`."""
    given = scans(size)
    made = {f"slim{degree}": clsurf.build_slim(given["mesh"], degree=degree, error=0.02, device=device)
            for degree in (1, 2, 3)}
    made["patches"] = clsurf.build_patches(given["mesh"], patches=max(12, size.points // 200), nodes=9, device=device)
    made["surfels"] = clsurf.build_surfels(given["mesh"], map_size=4, device=device)
    made["hybrid"] = clsurf.build_surfels(given["mesh"], map_size=4, hybrid=True, device=device)
    made["scale_map"] = clsurf.build_scale_map(given["mesh"], size=16, normals=True, device=device)
    return made


def forms(device) -> tuple[int, ...]:
    """Return the lanes of the forms of the kernels that are run: 16 and single items, or those alone (llvmpipe)."""
    return (1,) if device.lanes == 1 and device.kind == "cpu" else (16, 1)


def camera(size: Size):
    """Return the camera of every picture: the torus from above, with some of its inside."""
    return clsurf.Camera.look_at((1.3, -2.2, 2.4), (0, 0, 0), up=(0, 0, 1), fov=40)


def in_levels(surface):
    """Return a surface whose surfels are the third level, below wider copies of every eighth and every 32nd."""
    n = len(surface)
    coarse, middle, fine = np.arange(0, n, 32), np.arange(0, n, 8), np.arange(n)
    rows = np.concatenate([coarse, middle, fine])
    level = np.repeat([1, 2, 3], [len(coarse), len(middle), n]).astype(np.int32)
    # Children stand in order: of each coarse one the next four of the middle, of those the next eight.
    count = np.concatenate([np.diff(np.append(4 * np.arange(len(coarse)), len(middle))),
                            np.diff(np.append(middle, n)), np.zeros(n, int)])
    take = lambda name: None if getattr(surface, name) is None else getattr(surface, name)[rows]  # noqa: E731
    names = ("centers", "normals", "coefficients", "fit_error", "footprint", "colors")
    return replace(surface, **{name: take(name) for name in names}, radii=surface.radii[rows] * 2.0 ** (3 - level),
                   level=level, leaf=level == 3, child_offset=np.append(0, np.cumsum(count)).astype(np.int32),
                   children=np.arange(len(coarse), len(rows), dtype=np.int32))
