"""Scale maps from meshes and surfaces: a ray from the centre through every texel of a cube map.

Source: Reiter, "Spherical Scale Mapping", 2005, section 2 and figure 6. Meshes and spatial patches are drawn onto the
faces of the cube (kernels/build/scale_hits.cl), which gives every hit of every ray; other surfaces are traced.
"""

import logging
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, open_device
from ..errors import Cancelled, InputError
from ..io import load
from ..surface.arrays import extent_of, finite_rows, lengths_of, squared_lengths, whole_faces
from ..surface.cube import interpolated, texel_angles, texel_directions
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.patch_mesh import patch_mesh
from ..surface.placed import Placed
from ..surface.scale_map import ScaleMap, encoded, encoded_normals
from ..trace.hits import trace
from .bounding import bounding_sphere

log = logging.getLogger("clsurf")
LARGE_SHARE = 0.05  # of rays with several hits: above it, a warning
LARGEST_SIZE, LARGEST_LAYERS = 4096, 64
BOUND_SHARE = 0.95
TOLERANCE = 1e-5  # of the radius: hits so far beyond the sphere still count as on it
VISIBLE_SIZE = 24  # texels across a face of the maps that look for the centre that sees most
TEXEL_TURNS = 2  # of loops for each texel that scale_hits.cl tests, on all six faces at worst
NEAR_SHARE = 0.03  # of the radius: how near a map must come to a sample to hold it
SAMPLES = 4000  # of the surface, for that


@dataclass(frozen=True, eq=False)
class RayHits:
    """What the rays of a cube map meet, distances in units of the radius."""

    distances: NDArray  # (layers, 6, s, s) float32, -1: a hole
    counts: NDArray  # (6, s, s) int32: hits of every ray
    normals: NDArray | None  # (layers, 6, s, s, 3) float32, unit, away from the centre


def build_scale_map(thing, size: int = 128, center=None, radius: float | None = None, bits: int = 8, layers: int = 1,
                    normals: bool = False, hit: str = "outermost", progress=None, device=None) -> ScaleMap:
    """Turn a mesh or a surface into a scale map.

    Parameters
    ----------
    thing : Mesh, surface, a placed one, a Scene or list of them, or the path of one
    size : int
        Texels along a side of a cube face.
    center : (3,) float or "visible", optional
        World. By default the centre of the bounding sphere; "visible": the place whose map holds the largest share
        of the model's surface, found by search.
    radius : float, optional
        Of the sphere that distances are relative to, world units; what lies outside is left out. By default it holds
        the model.
    bits : int
        8, 16, or 32 (floats) a texel. 8 bits alone cost up to 1/510 of the radius.
    layers : int
        Hits of a ray that are kept.
    normals : bool
        Store the model's normals, 8 bits a component, beside the scales.
    hit : str
        Which hit comes first: "outermost", or "innermost", the nearest to the centre.
    progress : function, optional
        ``progress(stage, share done)``; False stops the work.
    device : None, str or Device

    Returns
    -------
    ScaleMap
        With the share of the sphere's directions whose rays meet the model more than once, `multiple_share`: such
        shapes are not star-shaped about the centre, and lose what lies behind the kept hits (paper, section 5).

    Raises
    ------
    InputError
        Something without a surface, or an option that cannot be used.
    Cancelled
        `progress` returned False.
    """
    if isinstance(thing, str | os.PathLike):
        thing = load(thing)
    check_options(size, bits, layers, hit, radius)
    device, report = open_device(device), _Reporter(progress)
    report(0.0)
    source = _source(thing, device)
    center = _center(center, source, size, hit, report)
    reach = source.reach(center)
    sphere = reach if radius is None else float(radius)
    if not sphere > 0:
        raise InputError("scan: expected a surface with some extent around the centre, got none")
    report(0.5)
    hits = source.cast(center, sphere, size, layers, hit == "outermost", normals)
    if radius is None and bits != 32 and hits.distances.max() > 0 and not isinstance(source, _Triangles):
        # A surface's box is larger than the surface: the codes' range follows what was hit.
        largest = float(hits.distances.max())
        sphere, hits = sphere * largest, RayHits(np.where(hits.distances < 0, -1, hits.distances / largest),
                                                 hits.counts, hits.normals)
    valid = hits.distances >= 0
    share = float(((hits.counts > 1) * texel_angles(size)).sum())
    result = ScaleMap(center, sphere, encoded(np.minimum(hits.distances, 1), bits), valid,
                      encoded_normals(hits.normals) if normals else None, hit, share, source.diagonal)
    report(0.9)
    if not valid.any():
        raise InputError(f"center, radius: no ray from {np.round(center, 6).tolist()} meets the model within "
                         f"{sphere:g}: move the centre into it")
    if share > LARGE_SHARE:
        log.warning("scale map: %.1f %% of the rays meet the model more than once: it is not star-shaped about the "
                    "centre, and %s; center=\"visible\" looks for a better centre", 100 * share,
                    f"what lies behind the first {layers} hits is lost" if layers > 1
                    else f"only the {hit} hits are kept")
    bound, largest = radial_bounds(result, source.points)
    report(1.0)
    return ScaleMap(**{name: getattr(result, name) for name in ScaleMap.__dataclass_fields__}
                    | {"bound": bound, "bound_share": BOUND_SHARE, "bound_all": largest})


def radial_bounds(surface: ScaleMap, points: NDArray | None) -> tuple[float, float]:
    """Return the distances that the share `BOUND_SHARE` and all of points (n, 3) keep along rays from the centre.

    World units. The nearest distance is no larger. NaN without points.
    """
    if points is None or not len(points):
        return float("nan"), float("nan")
    points = points[::max(1, len(points) // 8_000)] - surface.center
    distance = lengths_of(points)
    points, distance = points[distance > 0], distance[distance > 0]
    best = np.full(len(points), np.inf)
    for k in range(surface.layers):
        there, known = interpolated(np.nan_to_num(surface.lambdas[k].astype(np.float64)), surface.valid[k], points)
        best = np.where(known, np.minimum(best, np.abs(there * surface.radius - distance)), best)
    if not len(best):
        return float("nan"), float("nan")
    found, largest = float(np.quantile(best, BOUND_SHARE, method="higher")), float(best.max())
    if surface.bits < 32:
        largest += surface.radius / (2 * (2**surface.bits - 1))  # of codes between the points' own
    return tuple(value if np.isfinite(value) else float("nan") for value in (found, largest))


def check_options(size=128, bits=8, layers=1, hit="outermost", radius=None) -> None:
    """Raise InputError unless the options can be used."""
    for name, value, most in (("size", size, LARGEST_SIZE), ("layers", layers, LARGEST_LAYERS)):
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or not 1 <= value <= most:
            raise InputError(f"{name}: expected a whole number from 1 to {most}, got {value!r}")
    if isinstance(bits, bool) or bits not in (8, 16, 32):
        raise InputError(f"bits: expected 8, 16 or 32 (floats), got {bits!r}")
    if hit not in ("outermost", "innermost"):
        raise InputError(f"hit: expected outermost or innermost, got {hit!r}")
    if radius is not None and not (isinstance(radius, int | float | np.number) and 0 < radius < np.inf):
        raise InputError(f"radius: expected a positive length, got {radius!r}")


class _Reporter:
    def __init__(self, progress):
        self.progress = progress

    def __call__(self, done: float) -> None:
        if self.progress is not None and self.progress("scale map", done) is False:
            raise Cancelled("scale map: stopped by the progress callback")


# What rays are cast at ------------------------------------------------------------------------------------------------


class _Triangles:
    """A mesh on the device."""

    def __init__(self, mesh: Mesh, matrix: NDArray | None, device: Device):
        finite = finite_rows(mesh.vertices)
        kept = mesh.faces[whole_faces(mesh.faces, finite)]
        if not len(kept):
            raise InputError("mesh: expected faces with finite corners, got none: build a surface from points first "
                             "(clsurf.build_slim)")
        if len(kept) > 1 << 30:
            raise InputError(f"mesh: expected at most {1 << 30:,} faces, got {len(kept):,}: split it")
        self.device, self.count, self.faces = device, len(kept), device.upload(kept)
        world = mesh.vertices.astype(np.float64) + mesh.origin
        self.normals = None if mesh.normals is None else mesh.normals
        if matrix is not None:
            world = world @ matrix[:3, :3].T + matrix[:3, 3]
            turn = (matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))).T.astype(np.float32)
            self.normals = None if self.normals is None else np.ascontiguousarray(self.normals @ turn)
        self.world = world
        used = np.zeros(len(world), bool)
        used[kept.ravel()] = True
        self.points = world[used]
        self.diagonal = float(np.linalg.norm(extent_of(self.points)))

    def sphere_center(self) -> NDArray:
        return bounding_sphere(self.points)[0]

    def reach(self, center) -> float:
        return float(np.sqrt(squared_lengths(self.points - center).max()))

    def samples(self) -> NDArray:
        """Return points (n, 3), world, evenly spread over the area, the same each time."""
        corners = self.world[self.device.download(self.faces)]
        edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        ends = np.cumsum(lengths_of(np.cross(edge, other)))
        face = np.searchsorted(ends, (np.arange(SAMPLES) + 0.5) / SAMPLES * ends[-1])
        u, v = np.random.default_rng(0).uniform(size=(2, SAMPLES, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        return corners[face, 0] + u * edge[face] + v * other[face]

    def cast(self, center, radius, size, layers, outermost, normals) -> RayHits:
        device, texels = self.device, 6 * size * size
        device.check_memory(vertices=12 * len(self.world), faces=12 * self.count, texels=(16 + 16 * layers) * texels)
        vertices = device.upload(((self.world - center) / radius).astype(np.float32))
        lanes = device.lanes
        places = device.zeros(texels, np.uint32)
        unused = device.empty(4, np.float32)

        rows = size if device.loop_turns is None else max(device.loop_turns // (6 * TEXEL_TURNS * size), 1)

        def draw(fill, ends, distances, triangles):
            kernel = device.kernel("build/scale_hits.cl", constants={"VW": lanes, "FILL": fill})
            for first in range(0, size, rows):
                kernel((self.count,), (64,), self.count, vertices, self.faces, size, first, first + rows - 1, places,
                       ends, distances, triangles)

        draw(0, places, unused, unused)
        ends = np.cumsum(device.download(places), dtype=np.uint64)
        if ends[-1] >= 1 << 32:
            raise InputError(f"size: the rays meet {ends[-1]:,} triangles, expected fewer than {1 << 32:,}: use a "
                             "smaller size")
        begins = np.concatenate([[0], ends[:-1]]).astype(np.uint32)
        total = max(int(ends[-1]), 1)
        device.check_memory(hits=8 * total)
        begins, ends = device.upload(begins), device.upload(ends.astype(np.uint32))
        device.write(places, device.download(begins))
        distances, triangles = device.empty(total, np.float32), device.empty(total, np.int32)
        device.fill(distances, -1)
        draw(1, ends, distances, triangles)
        own = None if not normals or self.normals is None else device.upload(self.normals)
        out, counts = device.empty((layers, texels), np.float32), device.empty(texels, np.int32)
        across = device.empty((layers, texels, 3), np.float32) if normals else unused
        device.kernel("build/pick_scale_hits.cl", constants={
            "LAYERS": layers, "OUTERMOST": outermost, "NORMALS": 0 if not normals else 1 if own is None else 2})(
            (texels,), (64,), size, 1 + TOLERANCE, begins, ends, distances, triangles, vertices, self.faces,
            unused if own is None else own, out, counts, across)
        shape = (6, size, size)
        return RayHits(device.download(out).reshape(layers, *shape), device.download(counts).reshape(shape),
                       device.download(across).reshape(layers, *shape, 3) if normals else None)


class _Traced:
    """Anything that `trace` takes, by rays from outside its box, or from the centre."""

    points = None

    def __init__(self, thing, device: Device):
        self.thing, self.device = thing, device
        box = np.asarray(thing.bounds, np.float64)
        if not np.isfinite(box).all():
            raise InputError("surface: expected one with some extent, got an empty one")
        self.corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
        self.diagonal = float(np.linalg.norm(box[1] - box[0]))

    def sphere_center(self) -> NDArray:
        return self.corners.mean(axis=0)

    def reach(self, center) -> float:
        return float(lengths_of(self.corners - center).max())

    def samples(self) -> NDArray:
        """Return the points (n, 3), world, that rays from the middle of the box meet."""
        center = self.sphere_center()
        found = trace(self.thing, center, texel_directions(VISIBLE_SIZE).reshape(-1, 3), "all", device=self.device)
        if not len(found.position):
            raise InputError("center: no ray from the middle of the box meets the model: name a centre")
        return found.position

    def cast(self, center, radius, size, layers, outermost, normals) -> RayHits:
        directions = texel_directions(size).reshape(-1, 3)
        found = trace(self.thing, center, directions, "all", far=radius * (1 + TOLERANCE), device=self.device)
        counts = np.diff(found.offsets)
        shape = (layers, len(directions))
        distances = np.full(shape, -1.0, np.float32)
        across = np.zeros((*shape, 3), np.float32) if normals else None
        for k in range(layers):
            some = counts > k
            at = (found.offsets[1:] - 1 - k if outermost else found.offsets[:-1] + k)[some]
            distances[k, some] = found.distance[at] / radius
            if normals:
                n = found.normal[at]
                across[k, some] = np.where((n * directions[some]).sum(axis=1, keepdims=True) < 0, -n, n)
        cube = (6, size, size)
        return RayHits(distances.reshape(layers, *cube), counts.reshape(cube).astype(np.int32),
                       None if across is None else across.reshape(layers, *cube, 3))


def _source(thing, device: Device):
    """Return `thing` ready for rays."""
    matrix = thing.matrix if isinstance(thing, Placed) else None
    own = thing.surface if isinstance(thing, Placed) else thing
    if isinstance(own, PatchSurface):
        own = patch_mesh(own)
    if isinstance(own, Mesh):
        return _Triangles(own, matrix, device)
    if isinstance(thing, list | tuple):
        from ..render.scene import as_scene
        thing = as_scene(thing)
    if not hasattr(thing, "bounds") or hasattr(thing, "images") or hasattr(thing, "scanners"):
        raise InputError(f"scale map: expected a Mesh or a surface, got {type(thing).__name__}: build a surface from a "
                         "scan first (clsurf.build_slim, clsurf.build_patches)")
    return _Traced(thing, device)


# Centres --------------------------------------------------------------------------------------------------------------


def _center(center, source, size, hit, report) -> NDArray:
    """Return the centre, world, that the option asks for."""
    if center is None:
        return np.asarray(source.sphere_center(), np.float64)
    if isinstance(center, str):
        if center != "visible":
            raise InputError(f"center: expected three numbers or \"visible\", got {center!r}")
        return _seeing_center(source, hit, report)
    try:
        center = np.asarray(center, np.float64)
    except (TypeError, ValueError):
        center = np.zeros(0)
    if center.shape != (3,) or not np.isfinite(center).all():
        raise InputError(f"center: expected three finite numbers or \"visible\", got {center!r:.60}")
    return center


def _seeing_center(source, hit, report) -> NDArray:
    """Return the place whose map holds the largest share of the model's surface, as samples of it tell.

    A grid of 4 x 4 x 4 places in the box and the sphere's centre, then steps along the axes, halved where none helps.
    The share of rays that meet the model once is no such measure: close to the surface it is large, and most of the
    model is seen at a glancing angle.
    """
    samples = source.samples()
    near = NEAR_SHARE * source.reach(source.sphere_center())

    def seen(center) -> float:
        sphere = 2 * source.reach(center)
        hits = source.cast(center, sphere, VISIBLE_SIZE, 1, hit == "outermost", False)
        apart = samples - center
        there, known = interpolated(hits.distances[0], hits.distances[0] >= 0, apart)
        return float(np.mean(known & (np.abs(there * sphere - lengths_of(apart)) < near)))

    middle = np.asarray(source.sphere_center(), np.float64)
    box = np.stack([np.min(source.points, axis=0), np.max(source.points, axis=0)]) if source.points is not None \
        else np.stack([source.corners.min(axis=0), source.corners.max(axis=0)])
    steps = (np.arange(4) + 0.5) / 4
    places = [middle, *(box[0] + (box[1] - box[0]) * np.array([x, y, z]) for x in steps for y in steps for z in steps)]
    shares = []
    for k, place in enumerate(places):
        shares.append(seen(place))
        report(0.35 * k / len(places))
    best = int(np.argmax(shares))
    center, share, step = places[best], shares[best], (box[1] - box[0]) / 8
    for k in range(5):
        for axis in range(3):
            for sign in (1, -1):
                place = center.copy()
                place[axis] += sign * step[axis]
                now = seen(place)
                if now > share:
                    center, share = place, now
        step = step / 2
        report(0.35 + 0.03 * k)
    return center
