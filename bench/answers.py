"""What every device must agree on: jobs that between them run every kernel, and the arrays they give.

The surfaces that are drawn, traced and measured are made once, so that a difference is of the kernel that is looked at
and not of a build before it. `python -m bench.answers FILE [--surfaces FILE]` runs the jobs on one device in a process
of its own, which is how the job `devices` and the memory checks under Oclgrind use them.
"""

import argparse
import hashlib
from collections.abc import Callable
from contextlib import nullcontext
from unittest import mock

import numpy as np

import clsurf
from clsurf.build.point_tree import build_point_tree
from clsurf.build.stream_cells import covered_by, records_of
from clsurf.render import sky
from clsurf.surface.mesh import Mesh
from clsurf.view.picture import to_bytes

from .answer_scenes import SIZES as SIZES
from .answer_scenes import Size, camera, forms, in_levels, scans
from .answer_scenes import surfaces as surfaces

KINDS = ("contours", "suggestive_contours", "ridges", "valleys", "parabolic")
JOBS: dict[str, Callable] = {}


def job(function):
    """Enter ``function(device, size, surfaces) -> arrays by name`` as the job of its name."""
    JOBS[function.__name__] = function
    return function


def channels_of(frame) -> dict:
    """Return the channels of a frame."""
    return dict(frame.channels)


@job
def normals(device, size, made):
    """Neighbours, normals and their orientation, with fixed and with chosen k."""
    cloud = clsurf.PointCloud(clsurf.models.torus(size.points).points)
    return {f"k_{k}": clsurf.estimate_normals(cloud, k=k, device=device).normals for k in ("auto", 8, 30)}


@job
def build_slim(device, size, made):
    """SLIM surfaces of every degree, with colours, weights and from range images."""
    given, out = scans(size), {}
    for degree in (1, 2, 3):
        built = clsurf.build_slim(given["mesh"], degree=degree, error=0.02, device=device)
        out |= {f"centers{degree}": built.centers, f"coefficients{degree}": built.coefficients,
                f"colors{degree}": built.colors, f"footprint{degree}": built.footprint}
    auto = clsurf.build_slim(given["ranges"], error="auto", device=device)
    return out | {"auto": auto.centers}


@job
def build_patches(device, size, made):
    """Spatial patches from a mesh, a cloud in both ways, and range images."""
    given, out = scans(size), {}
    count = max(12, size.points // 200)
    for name, scan, options in (("areas", given["mesh"], {"patches": count}), ("local", given["cloud"], {}),
                                ("views", given["cloud"], {"method": "global_views", "views": 6}),
                                ("precise", given["mesh"], {"patches": count, "precise": True}),
                                ("ranges", given["ranges"], {})):
        built = clsurf.build_patches(scan, nodes=9, device=device, **options)
        out |= {f"{name}_displacements": built.displacements, f"{name}_origins": built.origins}
    return out


@job
def draw_slim(device, size, made):
    """Pictures of SLIM surfaces in both kernel forms, with every channel."""
    out, plain = {}, ("color", "depth", "normal", "position", "id", "count", "level", "cost")
    second = ("mean", "gaussian", "k1", "k2", "direction1", "direction2", "radial")
    third = ("derivative1", "derivative2", "radial_derivative")
    for lanes in forms(device):
        with clsurf.Renderer(device, lanes=lanes) as renderer:
            for degree in (1, 2, 3):
                extra = () if degree == 1 else second if degree == 2 else (*second, *third)
                frame = renderer.render(made[f"slim{degree}"], camera(size), size.picture, (*plain, *extra))
                out |= {f"{name}_{degree}_{lanes}": array for name, array in frame.channels.items()}
            for look in ("ball_size", "ball_level", "reflection", "flat"):
                out[f"{look}_{lanes}"] = renderer.render(made["slim2"], camera(size), size.picture, ("color",),
                                                         shading=look).color
            far = clsurf.Camera.look_at((0, -40, 20), (0, 0, 0))
            out[f"depth_far_{lanes}"] = renderer.render(made["slim2"], far, size.picture, ("depth",), lod=30).depth
            out[f"function_{lanes}"] = renderer.render(made["slim2"], camera(size), size.picture, ("mean",),
                                                       slim=clsurf.SlimDrawing("function")).mean
            out[f"average_{lanes}"] = renderer.render(made["slim2"], camera(size), size.picture, ("color", "depth"),
                                                      supersampling=2).color
    return out


@job
def draw_patches(device, size, made):
    """Pictures of patches in both kernel forms and in every mode."""
    modes = {"plain": {}, "trilinear": {"nodes": "trilinear"}, "homogeneous": {"nodes": "homogeneous"},
             "triangles": {"cells": "triangles"}, "bilinear": {"cells": "bilinear"}, "smooth": {"cells": "smooth"},
             "gouraud": {"shading": "gouraud"}, "table": {"normal_table": True}, "ordered": {"normal_table": "ordered"},
             "alpha": {"alpha": True}, "culled": {"cull": True}, "smooth_normals": {"normals": "smooth"}}
    out = {}
    for lanes in forms(device):
        with clsurf.Renderer(device, lanes=lanes) as renderer:
            for name, options in modes.items():
                frame = renderer.render(made["patches"], camera(size), size.picture,
                                        patches=clsurf.PatchDrawing(**options))
                out |= {f"{channel}_{name}_{lanes}": array for channel, array in frame.channels.items()}
            both = renderer.render([made["patches"], made["slim2"]], camera(size), size.picture, ("id", "depth"))
            far = renderer.render(made["patches"], clsurf.Camera.look_at((0, -30, 20), (0, 0, 0)), (24, 24), ("level",))
            out |= {f"id_both_{lanes}": both.id, f"depth_both_{lanes}": both.depth, f"level_far_{lanes}": far.level}
    return out


@job
def build_surfels(device, size, made):
    """Surfel hierarchies of points and of triangles, with their normal maps."""
    given, out = scans(size), {}
    for name, scan, hybrid in (("pure", given["cloud"], False), ("hybrid", given["mesh"], True)):
        built = clsurf.build_surfels(scan, map_size=4, hybrid=hybrid, device=device)
        out |= {f"{name}_atlas": built.normal_atlas, f"{name}_positions": built.positions}
    return out


@job
def build_scale_map(device, size, made):
    """Scale maps drawn from a mesh and traced from a surface, and what lies between two."""
    mesh = clsurf.build_scale_map(scans(size)["mesh"], size=16, layers=2, bits=16, device=device)
    traced = clsurf.build_scale_map(made["slim2"], size=8, device=device)
    return {"mesh": mesh.scales, "valid": mesh.valid, "traced": traced.scales,
            "morphed": clsurf.morph(mesh, made["scale_map"], 0.5, device=device).scales}


@job
def draw_others(device, size, made):
    """Pictures of surfels, scale maps, meshes and clouds in both kernel forms, cut open, and with covered edges."""
    given, out = scans(size), {}
    things = {name: made[name] for name in ("surfels", "hybrid", "scale_map")}
    things |= {"mesh": given["mesh"], "cloud": given["cloud"], "bare": clsurf.PointCloud(given["cloud"].points)}
    channels = ("color", "depth", "normal", "position", "id", "count", "level", "cost")
    for lanes in forms(device):
        with clsurf.Renderer(device, lanes=lanes) as renderer:
            for name, thing in things.items():
                frame = renderer.render(thing, camera(size), size.picture, channels)
                out |= {f"{channel}_{name}_{lanes}": array for channel, array in frame.channels.items()}
                cut = renderer.render(thing, camera(size), size.picture, ("depth",), clip=(1, 0, 0, 0))
                out[f"depth_cut_{name}_{lanes}"] = cut.depth
            sphere = clsurf.ScaleMapDrawing("geosphere", 3, "neighbours")
            out[f"depth_geosphere_{lanes}"] = renderer.render(made["scale_map"], camera(size), size.picture,
                                                              scale_map=sphere).depth
            out[f"covered_{lanes}"] = renderer.render(list(things.values()), camera(size), size.picture, ("color",),
                                                      antialias="coverage").color
    return out


@job
def materials(device, size, made):
    """Materials, image light and backgrounds."""
    lamps = (clsurf.Light("image", picture="sky"), clsurf.Light("spot", (1.0, -1.0, 3.0), direction=(-1, 1, -3)))
    looks = [clsurf.Material("physical", metallic=1.0, roughness=0.3), clsurf.Material("matcap"),
             clsurf.Material("normal"), clsurf.Material("phong", mirror=0.5)]
    names, out = ("slim2", "patches", "surfels", "scale_map"), {}
    scene = clsurf.Scene([made[name].moved(raised(0.6 * i)) for i, name in enumerate(names)], lights=lamps,
                         materials=looks)
    for lanes in forms(device):
        with clsurf.Renderer(device, lanes=lanes) as renderer, of_few_cells(size):
            out[f"color_{lanes}"] = renderer.render(scene, camera(size), size.lit, ("color",), background="sky",
                                                    shading=clsurf.Shading(occlusion=size.occlusion)).color
    return out


def of_few_cells(size: Size):
    """Return a context in which image lights have maps of few cells, where the size says so."""
    if size.sky_cells is None:
        return nullcontext()
    return mock.patch.multiple(sky, MIRROR_CELLS=(size.sky_cells,) * len(sky.MIRROR_CELLS), MATTE_CELLS=size.sky_cells,
                               LAST_LEVEL=7)


@job
def light(device, size, made):
    """Shadows, ambient occlusion and a mirror, in both kernel forms."""
    lamps = (clsurf.Light("directional", (1, 1, 2)), clsurf.Light("point", (2.0, -2.0, 3.0)))
    shading = clsurf.Shading(shadows=True, occlusion=size.occlusion, mirror=0.3)
    scene = clsurf.Scene([made["slim2"], made["patches"].moved(raised(0.7))], lights=lamps)
    out = {}
    for lanes in forms(device):
        with clsurf.Renderer(device, lanes=lanes) as renderer:
            out[f"color_{lanes}"] = renderer.render(scene, camera(size), size.lit, ("color",),
                                                    shading=shading).color
    return out


def raised(z: float) -> np.ndarray:
    """Return the matrix that moves by `z` along the z axis."""
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def rays(size: Size):
    """Return origins around the torus and directions into it."""
    origins = clsurf.models.sphere(size.rays, radius=3.0).points.astype(np.float64)
    return origins, 0.3 * np.roll(origins, 1, axis=0) - origins


@job
def trace(device, size, made):
    """Rays against every kind, for every query."""
    origins, directions = rays(size)
    things, out = {**made, "mesh": scans(size)["mesh"]}, {}
    for name, thing in things.items():
        for query in ("closest", "any", "all"):
            hits = clsurf.trace(thing, origins, directions, query, device=device)
            out[f"hit_{name}_{query}"] = hits.hit if query == "any" else hits.distance
            if query == "closest":
                out[f"primitive_{name}"] = hits.primitive
    return out


@job
def project(device, size, made):
    """The nearest places on a surface, and distances between scans and surfaces."""
    points = clsurf.models.sphere(size.rays, radius=1.2).points.astype(np.float64)
    names = ("slim1", "slim2", "slim3", "surfels", "scale_map")
    found = {name: clsurf.project(made[name], points, device=device).position for name in names}
    error = clsurf.error(made["patches"], scans(size)["mesh"], device=device)
    return {f"position_{name}": value for name, value in found.items()} | {"error": np.array([error.rms])}


@job
def curvature(device, size, made):
    """Curvature of a scan and of a surface at points."""
    given = scans(size)
    found = clsurf.curvature(given["cloud"], device=device)
    return {"mean": found.mean, "gaussian": found.gaussian,
            "surface_mean": clsurf.curvature(made["slim2"], given["cloud"].points, device=device).mean}


@job
def smooth(device, size, made):
    """A mesh and a cloud without their noise."""
    given = scans(size)
    noise = 0.004 * np.sin(np.arange(3 * len(given["mesh"].vertices)) * 12.9898).reshape(-1, 3)
    rough = Mesh(given["mesh"].vertices + noise, given["mesh"].faces)
    cloud = clsurf.PointCloud(rough.vertices)
    out = {method: clsurf.smooth(rough, method=method, device=device).vertices for method in ("normals", "quadrics")}
    return out | {"cloud": clsurf.smooth(cloud, device=device).points}


@job
def lines(device, size, made):
    """Feature lines of a picture, drawn over it."""
    frame = clsurf.render(made["slim3"], camera(size), size.picture, ("color", *clsurf.line_channels(KINDS)),
                          device=device)
    found = clsurf.lines(frame, KINDS, device=device)
    return {"points": found.points, "drawn": found.draw(frame).color}


@job
def search_levels(device, size, made):
    """Pictures for which the hierarchy is searched: of three levels, from where their surfels are small."""
    out, thing = {}, in_levels(made["slim2"])
    far = clsurf.Camera.look_at((0, -40, 20), (0, 0, 0))
    for lanes in forms(device):
        with clsurf.Renderer(device, lanes=lanes) as renderer:
            for lod in (3, 30):
                out[f"level_{lod}_{lanes}"] = renderer.render(thing, far, (24, 24), ("level",), lod=lod).level
    return out


@job
def trace_grid(device, size, made):
    """The rays of a picture, which go to packets where there are enough of them."""
    origins, directions = camera(size).rays((80, 56))
    hits = clsurf.trace(made["slim2"], origins, directions, device=device)
    return {"hit_distance": hits.distance, "primitive": hits.primitive, "normal": hits.normal}


@job
def stream(device, size, made):
    """What streamed builds ask of a cell's points: how leaves made before fit and cover them."""
    cloud, surface = scans(size)["cloud"], made["slim2"]
    place, record = records_of(surface, np.flatnonzero(surface.leaf), cloud.origin)
    tree = build_point_tree(cloud.points, cloud.normals, np.zeros(3, np.float32), 1 / surface.diagonal, device)
    sums, own = device.empty((len(place), 2), np.float32), device.upload(np.ones(tree.padded, np.uint8))
    device.kernel("build/check_leaves.cl")((len(place),), (1,), len(place), device.upload(place),
                                           device.upload(record), 6, tree.padded, tree.sorted, own,
                                           *tree.arguments[2:], sums)
    covered = covered_by(tree, place, record, np.inf, surface.degree)
    return {"sums": device.download(sums), "covered": device.download(covered)}


@job
def helpers(device, size, made):
    """The kernels that test a device and the helpers of others, and the viewer's bytes."""
    rng, out = np.random.default_rng(0), {}
    numbers, normal = rng.normal(size=(2, 64)).astype(np.float32), rng.normal(size=(64, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    given = (rng.normal(0, 0.3, (64, 32)), rng.uniform(-0.5, 0.5, (64, 3)), normal, np.ones(64))
    for lanes in forms(device):
        a, b = (device.upload(row) for row in numbers)
        made_of = [device.empty(64, np.float32) for _ in range(4)] + [device.empty((64 // lanes, 2), np.int32)]
        device.kernel("common/probe_lanes.cl", constants={"VW": lanes})((64 // lanes,), (1,), a, b, *made_of)
        out |= {f"lanes_{i}_{lanes}": device.download(array) for i, array in enumerate(made_of[:4])}
        target = device.empty(64, np.float32)
        device.kernel("common/self_test.cl", constants={"VW": lanes})((64 // lanes,), (1,), a, target, 2.0)
        out[f"self_test_{lanes}"] = device.download(target)
        root = device.empty((64, 7), np.float32)
        device.kernel("common/probe_slim.cl", constants={"VW": lanes, "DEGREE": 3})(
            (64,), None, *(device.upload(array, np.float32) for array in given), 64, root)
        out[f"root_{lanes}"] = device.download(root)
    frame = device.empty((64, 6), np.float32)
    device.kernel("common/probe_frame.cl")((64,), None, device.upload(normal), frame)
    out["frame"] = device.download(frame)
    out["bytes"] = to_bytes(device, rng.uniform(-0.5, 1.5, (9, 13, 4)).astype(np.float32))
    return out


def digest(array) -> str:
    """Return the first digits of a hash of an array's type, shape and bytes."""
    array = np.ascontiguousarray(array)
    return hashlib.sha256(f"{array.dtype} {array.shape}".encode() + array.tobytes()).hexdigest()[:12]


def answers(device, size: Size, made: dict, names=None) -> dict[str, np.ndarray]:
    """Return the arrays of the jobs `names` (by default all), named "job/array"."""
    return {f"{name}/{key}": np.asarray(array) for name in (names or JOBS)
            for key, array in JOBS[name](device, size, made).items() if array is not None}


def main(arguments=None) -> None:
    """Run jobs on one device; write their arrays."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", help="the arrays, .npz")
    parser.add_argument("--device", default=None)
    parser.add_argument("--size", choices=SIZES, default="small")
    parser.add_argument("--jobs", default="", help="some of them, with commas: " + ", ".join(JOBS))
    parser.add_argument("--surfaces", help="folder of surfaces that another device has made")
    parser.add_argument("--lanes", type=int, help="another form of the kernels than the device's own")
    chosen = parser.parse_args(arguments)
    device, size = clsurf.open_device(chosen.device), SIZES[chosen.size]
    device.lanes = chosen.lanes or device.lanes
    made = surfaces(device, size) if chosen.surfaces is None else load_surfaces(chosen.surfaces)
    names = [name for name in chosen.jobs.split(",") if name] or None
    np.savez_compressed(chosen.file, **answers(device, size, made, names))


def save_surfaces(folder, made: dict) -> None:
    """Write the surfaces into a folder."""
    for name, surface in made.items():
        clsurf.save(surface, f"{folder}/{name}.clsurf")


def load_surfaces(folder) -> dict:
    """Return the surfaces of a folder by name."""
    from pathlib import Path
    return {path.stem: clsurf.load(path) for path in sorted(Path(folder).glob("*.clsurf"))}


if __name__ == "__main__":
    main()
