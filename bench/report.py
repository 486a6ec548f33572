"""All jobs on some devices, and one Markdown table of what clsurf must show beside what was measured.

    python -m bench.report figures.md [--devices pocl,intel] [--json FOLDER] [--reuse]
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from clsurf.errors import Error

from . import JOBS, record, run
from .smooth import GOALS


@dataclass(frozen=True)
class Row:
    """One line of the table: a figure, what is asked of it, and where it is found among the jobs' figures."""

    title: str
    floor: str
    aim: str
    show: Callable[[dict], str]  # all figures of one device, by job, to text; KeyError: not measured


def _ms(*path):
    return lambda f: f"{1e3 * _at(f, *path):.1f} ms"


def _s(*path):
    return lambda f: f"{_at(f, *path):.3f} s"


def _at(figures, *path):
    for key in path:
        figures = figures[key]
    return figures


def _picture(figures, scene):
    return figures["tiles"]["pictures"][scene]


def _dragon_result(f) -> str:
    d = f["build"]["dragon"]
    return f"{d['leaves']:,} leaves, {d['rms_percent']:.4f} %, {d['overlap_min']:.3f}"


def _memory(f) -> str:
    return ", ".join(f"{f['build'][name]['memory']['mb_per_million_points']:.0f} MB ({name})"
                     for name in ("dragon", "bunny"))


def _pair(name, digits, unit):
    return lambda f: " / ".join(f"{_picture(f, scene)[name]:.{digits}f}" for scene in ("bunny", "dragon")) + unit


def _silhouettes(f) -> str:
    d = _picture(f, "dragon")
    return f"{d['mean_outside']:.1f} / {d['mean_missing']:.1f} / {d['worst_fragments']:.0f}"


def _faster(f) -> str:
    frames = f["tiles"]["frames"]
    return ", ".join(f"{frames[case]['times_faster_than_open3d']:.1f}x ({case})"
                     for case in ("bunny 500", "dragon 1024"))


def _cubic(f) -> str:
    frames = f["tiles"]["frames"]
    slower = frames["dragon 1024 cubic"]["frame"]["median_s"] / frames["dragon 1024"]["frame"]["median_s"]
    return f"{f['build']['dragon']['cubic_leaf_ratio']:.2f}; {slower:.2f}x"


def _fandisk(f) -> str:
    e = f["build"]["fandisk"]["quadratic"]
    return f"{e['edge_rms_percent']:.3f} % / {e['elsewhere_rms_percent']:.4f} %"


def _happy(f) -> str:
    h = f["normals"]["happy"]
    return f"{h['seconds']:.2f} s, {100 * h['wrong']:.1f} % wrong"


def _patches(*path):
    return lambda f: _at(f["patches"], *path)


def _patch_bunny(f) -> str:
    b = f["patches"]["conversions"]["bunny"]
    return f"{b['rms']:.4f} / {b['max_vertices']:.3f} ({b['patches']:,} patches, {b['nodes']:,} nodes)"


def _covered(f) -> str:
    found = f["patches"]["conversions"]
    return ", ".join(f"{name} {found[name]['points_covered']:.2%} / {found[name]['nodes_supported']:.2%} at "
                     f"{found[name]['node_spacings']:.2f}" for name in ("bunny scans", "happy scans", "lion"))


def _earth_frames(f) -> str:
    frames = f["patches"]["frames"]
    return " / ".join(f"{1e3 * frames[f'earth 1128 {size}']['frame']['median_s']:.2f}"
                      for size in ("500x500", "150x150", "1920x1080")) + " ms"


def _vtk(f) -> str:
    frames = f["patches"]["frames"]
    return ", ".join(f"{frames[case]['times_faster_than_vtk']:.0f}x ({case})" for case in frames
                     if "times_faster_than_vtk" in frames[case])


def _closed(f) -> str:
    found = f["patches"]["pictures"]
    sphere = found["sphere"]
    specks = [sum(found[name][f"{kind}_speckle"] for kind in ("depth", "color", "normal"))
              for name in ("sphere", "earth 1128")]
    return (f"{sphere['off_facing']} px ({sphere['depth_facing']:.4f}), radial {sphere['radial']:.4f}; pinholes "
            f"{sphere['pinholes']} / {found['earth 1128']['pinholes']}, specks {specks[0]} / {specks[1]}")


def _curvature(f) -> str:
    found = f["curvature"]
    return ", ".join(f"{found[kind]['0.0']['rms']:.1e} / {found[kind]['0.001']['rms']:.4f} ({kind})"
                     for kind in ("torus", "mesh"))


def _smooth(scene):
    def text(figures) -> str:
        found = figures["smooth"][scene]["normals"]
        return f"{found['surface']:.4f} % / {found['vertex_normal']:.2f} degrees"
    return text


ROWS = (
    Row("dragon build, 435K points with normals, T 0.01, quadratic, links included", "PoCL 1.0 s, Intel 0.7 s",
        "0.4 s", _s("build", "dragon", "build", "median_s")),
    Row("its result: leaves, RMS to the blended surface in % of the diagonal, least overlap of the points",
        "30-45K, 0.010 %, 0.1", "fewer at the same error", _dragon_result),
    Row("bunny build, T 0.01", "0.15 s", "0.06 s", _s("build", "bunny", "build", "median_s")),
    Row("memory of a build beyond its input, per million points", "150 MB", "60 MB", _memory),
    Row("raw happy scans, 1.1M points: normals and orientation without sensor positions", "4 s PoCL, 2 % wrong",
        "2 s, 1 %", _happy),
    Row("shaded frame with depth and normals, bunny 500x500", "5 ms PoCL, 4 ms Intel", "2.5 ms, 2 ms",
        _ms("tiles", "frames", "bunny 500", "frame", "median_s")),
    Row("same, dragon 1024x1024", "28 ms PoCL, 22 ms Intel", "14 ms, 10 ms",
        _ms("tiles", "frames", "dragon 1024", "frame", "median_s")),
    Row("against Open3D's bare ray casting of the mesh, same camera", "3x faster", "6x", _faster),
    Row("dragon 100 px high in a 1024x1024 picture", "10 ms PoCL", "4 ms",
        _ms("tiles", "frames", "dragon 100 px high", "frame", "median_s")),
    Row("holes inside the silhouette eroded by 3 px, worst view, bunny / dragon", "8 px", "0",
        _pair("worst_holes", 0, " px")),
    Row("median depth error along the viewing axis, bunny / dragon, % of the diagonal", "0.012 / 0.005", "half",
        _pair("mean_depth_median", 4, "")),
    Row("the same across the surface", "", "", _pair("mean_distance_median", 4, "")),
    Row("median normal error against the mesh's vertex normals, bunny / dragon", "1.5 degrees", "1",
        _pair("mean_normal_median", 2, "")),
    Row("dragon 1024x1024, 8 views: pixels more than 1 px outside / missing more than 1 px inside (mean) / isolated "
        "fragments (worst)", "2 / 6 / 1", "0 / 3 / 0", _silhouettes),
    Row("cubic/quadratic leaf ratio; cubic frame", "0.6-0.8; 1.8x quadratic", "", _cubic),
    Row("`clsurf demo`, first run / second run", "60 s / 5 s", "30 s / 2 s",
        lambda f: f"{f['demo']['first_s']:.1f} s / {f['demo']['second_s']:.1f} s"),
    Row("fandisk: RMS error within 2 spacings of sharp edges / elsewhere", "", "", _fandisk),
    Row("spatial patches of the bunny, at most 1526 / 441K nodes: RMS both ways / max of original vertices, % of the "
        "diagonal", "0.010 / 0.12", "0.007 / 0.08", _patch_bunny),
    Row("enclosed hole pixels over four 500x500 views of it", "15", "0",
        lambda f: f"{_patches('conversions', 'bunny', 'holes')(f)}"),
    Row("its conversion", "1.5 s PoCL", "0.5 s", _s("patches", "conversions", "bunny", "build", "median_s")),
    Row("fandisk's patches: enclosed hole pixels over four views; overhang beyond silhouettes, nodes", "0; 0.5", "0",
        lambda f: f"{_patches('conversions', 'fandisk', 'holes')(f)}; "
                  f"{_patches('conversions', 'fandisk', 'overhang')(f):.2f}"),
    Row("raw bunny and happy scans, lion cloud: points covered / nodes supported at node over point spacing",
        "99.5 % both at 1.5", "99.9 %", _covered),
    Row("640x480 depth and colour frame, files to shaded picture, kernels cached", "1 s PoCL", "0.3 s",
        _s("patches", "conversions", "depth frame", "first_frame", "median_s")),
    Row("frame of Earth 1128 (326K nodes), 500x500 / 150x150 / 1920x1080", "1.7 / 0.7 / 6 ms PoCL, 1.0 / 0.3 / 3.5 "
        "Intel", "1.0 / 0.4 / 3.5 ms PoCL", _earth_frames),
    Row("against VTK's software rendering of the same nodes as a mesh", "40x", "100x", _vtk),
    Row("perfect sphere at 1920x1080, 4 views: pixels more than 0.02 off its depth where seen at up to 70 degrees "
        "(largest), and of it / Earth 1128: pinholes, isolated pixels", "0", "", _closed),
    Row("mean curvature of a torus of 51,200 points, relative RMS exact / with 0.1 % noise, nothing set by hand",
        "0.0005 / 0.025", "0.00005 / 0.02", _curvature),
    Row("its time per 100K points, exact", "0.4 s", "0.1 s", _s("curvature", "torus", "0.0", "median_s")),
    *(Row(f"smoothing of {scene}, distance from the true surface (root mean square of the diagonal) / vertex normals "
          "(mean)", f"{floor[0]:.3f} % / {floor[1]:.1f}", f"{aim[0]:.3f} % / {aim[1]:.1f}", _smooth(scene))
      for scene, (floor, aim) in GOALS.items()),
    Row("smoothing the bunny", "0.3 s", "0.15 s", _s("smooth", "bunny + 0.2 %", "seconds")),
)


def cell(row: Row, figures: dict) -> str:
    """Return the row's text for one device; a dash where it was not measured."""
    try:
        return row.show(figures)
    except (KeyError, TypeError):
        return "-"


def markdown(by_device: dict[str, dict], records: dict[str, dict]) -> str:
    """Return the table and, above it, where its figures come from."""
    lines = []
    for name, made in records.items():
        lines.append(f"{name}: {made['device']} ({made['platform']}, driver {made['driver']}), {made['cpu']}, commit "
                     f"{made['commit']}, {made['date']}.  ")
    lines += ["", "| " + " | ".join(["figure", "floor", "aim", *by_device]) + " |",
              "|" + "---|" * (3 + len(by_device))]
    lines += [f"| {row.title} | {row.floor} | {row.aim} | "
              + " | ".join(cell(row, figures) for figures in by_device.values()) + " |" for row in ROWS]
    return "\n".join(lines) + "\n"


def demo_seconds(device: str) -> dict:
    """Return the seconds of `clsurf demo` with empty caches, and again: whole processes, start of Python included."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"XDG_CACHE_HOME": folder, "POCL_CACHE_DIR": str(Path(folder) / "pocl")}
        Path(folder, "pocl").mkdir()
        seconds = []
        for _ in range(2):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-m", "clsurf", "demo", str(Path(folder) / "demo.png"), "--device", device],
                           env=environment, check=True, capture_output=True, timeout=300)
            seconds.append(time.perf_counter() - start)
    return {"first_s": seconds[0], "second_s": seconds[1]}


def main(arguments=None) -> int:
    """Run the jobs and write the table; a job that fails is said and leaves dashes."""
    parser = argparse.ArgumentParser(prog="python -m bench.report", description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--devices", default="pocl,intel")
    parser.add_argument("--json", type=Path, help="folder that keeps the figures of every job")
    parser.add_argument("--reuse", action="store_true", help="take figures that are already in that folder")
    options = parser.parse_args(arguments)
    by_device, records, failed = {}, {}, 0
    for device in options.devices.split(","):
        by_device[device] = {}
        for job in JOBS:
            path = options.json / f"{job}-{device}.json" if options.json else None
            try:
                reuse = options.reuse and path is not None and path.exists()
                result = record.read(path) if reuse else run(job, device, path)
            except Error as error:
                print(f"{job} on {device}: {error}", file=sys.stderr)
                failed += 1
                continue
            by_device[device][job], records[device] = result["figures"], result["record"]
        try:
            by_device[device]["demo"] = demo_seconds(device)
        except subprocess.SubprocessError as error:
            print(f"clsurf demo on {device}: {error}", file=sys.stderr)
            failed += 1
    options.out.write_text(markdown(by_device, records))
    print(f"table: {options.out}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
