"""Benchmarks: each job checks its answer, then prints figures with the device, driver, commit and scene beside them.

`clsurf bench build|tiles|normals|scans|patches|surfels|scale_map|first [--json FILE]`, `clsurf bench compare A B`;
`python -m bench.report FILE` runs all.
"""

import importlib

JOBS = {
    "build": "scan to SLIM surface: time, size, error, overlap, memory",
    "tiles": "frames: time, time per stage and tile, holes, silhouettes, depth and normals against ray casting",
    "channels": "channels of curvature: errors on a torus, cost on a frame",
    "light": "materials, skies and anti-aliasing: energy, edges, cost on a frame",
    "lines": "feature lines: distance from analytic curves, frames with lines over them",
    "trace": "rays a second: primary, shadows, ambient occlusion, arbitrary ones, beside Embree",
    "sparsity": "surfels and floats by degree for one error, linear splats beside quadratic surfels",
    "normals": "neighbours, normals and their orientation",
    "curvature": "curvature at points: error and time on tori, MeshLab's filters",
    "smooth": "smoothing of noisy meshes: errors against the true shape, time, Taubin's method",
    "surfels": "surfel hierarchies: normal maps against float64, builds, normals by map size, frames beside SLIM",
    "scans": "meshes and clouds drawn as they are: errors against ray casting, frames, VTK",
    "fuzz": "damaged files of every format: crashes, hangs, memory",
    "devices": "one answer everywhere: hashes of all devices' answers and how far they are apart",
    "instances": "ten placements of a model: memory of the device and the host over that of one",
    "view": "the viewer: pictures a second while something moves, drawn alone and end to end to a browser",
    "scale_map": "spherical scale maps: closed forms and orders, builds, frames, geospheres, morphs",
    "first": "what one waits for: import, first pictures, surfaces as meshes and points",
    "stream": "scans larger than memory: time, peak memory, autzen's points within 0.3 m, scaling to 50 million points",
    "patches": "spatial patches: conversions, frames and modes, VTK, the paper's tables",
}


def run(job: str, device=None, json_path=None, quick: bool = False, profile: bool = False) -> dict:
    """Run the job `job`, print its figures and return them.

    Parameters
    ----------
    job : str
        One of `JOBS`.
    device : optional
        As everywhere in clsurf.
    json_path : path, optional
        Write the figures there.
    quick : bool
        A small generated scan, a few seconds.
    profile : bool
        Print the time of every kernel too.

    Returns
    -------
    dict
        ``job``, ``record`` (where the figures come from), ``figures``.

    Raises
    ------
    InputError
        An unknown job, or a file that cannot be written.
    """
    from clsurf.device import open_device
    from clsurf.errors import InputError

    from . import record
    if job not in JOBS:
        raise InputError(f"bench job: expected {', '.join(JOBS)} or compare, got {job!r}")
    opened = open_device(device)
    made = record.provenance(opened)
    print(f"{job}: {opened.name} ({opened.platform_name}, driver {opened.driver}), {made['cpu']}, commit "
          f"{made['commit']}")
    figures = importlib.import_module(f".{job}", __name__).measure(opened, quick=quick, profile=profile)
    result = {"job": job, "record": made, "figures": figures}
    if json_path is not None:
        record.write(json_path, result)
        print(f"figures: {json_path}")
    return result


def compare_files(before, after) -> list[dict]:
    """Print the ratios of two JSON files of figures and return them; see `compare`."""
    from .compare import compare_files
    return compare_files(before, after)
