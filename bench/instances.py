"""The job `instances`: memory and time of one and of ten placements of a model on a ground, by kind.

The ground is there in both: patches that are alone in a picture are drawn without the planes of its bins.

Each count is drawn in a process of its own: bytes of the device's arrays that are alive after three frames, and how
much the process's resident memory rose over what it was before the model was loaded, kernels compiled and a small
picture drawn. On a CPU device the second holds the first.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from clsurf.build.patches import build_patches
from clsurf.build.surfels import build_surfels
from clsurf.io.dispatch import save
from clsurf.surface.mesh import Mesh

from . import scenes
from .build import WrongAnswer, built
from .table import print_table

COUNTS = (1, 10)
MOST = 1.15  # times the memory of one
SIZE = (1024, 768)
KINDS = {"slim": lambda scene, device: built(scene, 2, device),
         "mesh": lambda scene, device: scene.scan,
         "patches": lambda scene, device: build_patches(scene.scan, device=device),
         "surfels": lambda scene, device: build_surfels(scene.scan, device=device)}


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return by scene and kind, and by count: device_bytes, rise_bytes, frame_s; and the ratios of ten over one.

    Raises
    ------
    WrongAnswer
        Not every placement is seen, or ten of them take more than `MOST` times the memory of one.
    """
    figures = {}
    selector = "intel" if "intel" in device.platform_name.lower() else "pocl" if device.kind == "cpu" else device.name
    name, = scenes.chosen(("dragon",), quick)
    scene = scenes.scene(name)
    for kind, make in KINDS.items():
        with tempfile.TemporaryDirectory(prefix="clsurf-bench-") as folder:
            path = Path(folder) / "model.clsurf"
            save(make(scene, device), path)
            found = {count: _child(path, count, selector) for count in COUNTS}
        one, ten = (found[count] for count in COUNTS)
        figures[f"{name}, {kind}"] = {str(count): found[count] for count in COUNTS} | {
            "device_times": ten["device_bytes"] / one["device_bytes"],
            "rise_times": ten["rise_bytes"] / one["rise_bytes"]}
    show(figures)
    for case, f in figures.items():
        # A small model's rise is noise.
        if not f["device_times"] <= MOST or (not quick and not f["rise_times"] <= MOST):
            raise WrongAnswer(f"bench instances {case}: expected ten in at most {MOST} times the memory of one, got "
                              f"{f['device_times']:.2f} times the device's and {f['rise_times']:.2f} times the host's")
    return figures


def _child(path: Path, count: int, selector: str) -> dict:
    done = subprocess.run([sys.executable, "-m", "bench.instances", str(path), str(count), selector],
                          capture_output=True, text=True, cwd=Path(__file__).resolve().parents[1])
    if done.returncode:
        raise WrongAnswer(f"bench instances: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout)


def places(bounds, count: int) -> list:
    """Return matrices (4, 4) of `count` copies of what has `bounds` (2, 3), side by side in rows of five."""
    extent = 1.1 * (bounds[1] - bounds[0])
    out = []
    for i in range(count):
        matrix = np.eye(4)
        matrix[:3, 3] = extent[0] * (i % 5), 0, extent[2] * (i // 5)
        out.append(matrix)
    return out


def ground(bounds) -> Mesh:
    """Return two triangles under all copies."""
    low, extent = bounds[0], bounds[1] - bounds[0]
    x, z = low[0] + extent[0] * np.array([-0.5, 6.5]), low[2] + extent[2] * np.array([-0.5, 2.5])
    corners = np.array([[x[0], low[1], z[0]], [x[1], low[1], z[0]], [x[1], low[1], z[1]], [x[0], low[1], z[1]]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def live_bytes(device):
    """Return a function that gives the bytes of the device's arrays made from now on that are alive."""
    import weakref
    live = {}
    empty, upload = device.empty, device.upload

    def watched(make):
        def call(*arguments, **options):
            array = make(*arguments, **options)
            live[id(array)] = array.nbytes
            weakref.finalize(array, live.pop, id(array), None)
            return array
        return call
    device.empty, device.upload = watched(empty), watched(upload)
    return lambda: sum(live.values())


def drawn(path: str, count: int, selector: str) -> dict:
    """Return the figures of `count` placements; to be called in a process of its own."""
    import gc
    import time

    from clsurf.device import open_device
    from clsurf.io.dispatch import load
    from clsurf.render.camera import Camera
    from clsurf.render.renderer import Renderer
    from clsurf.render.scene import Scene

    from .memory import resident
    device = open_device(selector)

    def frames(model, size, number):
        copies = [model.moved(matrix) for matrix in places(model.bounds, number)]
        scene = Scene([*copies, ground(model.bounds)])
        renderer = Renderer(device)
        camera = Camera.framing(scene, direction=(0.3, 0.6, 1), aspect=size[0] / size[1])
        seconds = []
        for _ in range(3):
            start = time.perf_counter()
            frame = renderer.render(scene, camera, size, ("color", "depth", "normal", "id"))
            seconds.append(time.perf_counter() - start)
        if set(np.unique(frame.id)) != set(range(-1, number + 1)):
            raise WrongAnswer(f"bench instances: expected {number} placements in the picture, got the numbers "
                              f"{np.unique(frame.id).tolist()}")
        return renderer, frame, min(seconds)

    model = load(path)
    kept = frames(model, (64, 48), 1)  # drivers and kernels
    kept[0].close()
    del kept, model
    gc.collect()
    device.trim()
    before, alive = resident("VmRSS"), live_bytes(device)
    model = load(path)
    renderer, _, seconds = frames(model, SIZE, count)
    found = {"device_bytes": alive(), "rise_bytes": resident("VmRSS") - before, "frame_s": seconds,
             "model_bytes": getattr(model, "nbytes", 0)}
    renderer.close()
    return found


def show(figures: dict) -> None:
    """Print the figures."""
    rows = []
    for case, f in figures.items():
        one, ten = (f[str(count)] for count in COUNTS)
        rows.append((case, f"{one['model_bytes'] / 1e6:.1f}", f"{one['device_bytes'] / 1e6:.1f}",
                     f"{ten['device_bytes'] / 1e6:.1f}", f"{f['device_times']:.3f}", f"{one['rise_bytes'] / 1e6:.1f}",
                     f"{ten['rise_bytes'] / 1e6:.1f}", f"{f['rise_times']:.3f}", f"{1e3 * one['frame_s']:.1f}",
                     f"{1e3 * ten['frame_s']:.1f}"))
    print(f"{COUNTS[-1]} placements in a picture of {SIZE[0]}x{SIZE[1]}, MB; floor {MOST} times the memory of one")
    print_table(("model", "itself", "device, one", "ten", "times", "host, one", "ten", "times", "ms, one", "ten"), rows)


if __name__ == "__main__":
    print(json.dumps(drawn(sys.argv[1], int(sys.argv[2]), sys.argv[3])))
