"""The job `fuzz`: damaged files of every format that is read: no crash, no hang, no memory taken.

Small whole files of each format are cut, spliced, flipped and given absurd numbers; a reader in a process of its own
loads each. It may give a scan or raise one of clsurf's own errors; anything else, over `SECONDS`, or over
`MEMORY_BYTES` more than before counts. The files that failed are kept where `CLSURF_FUZZ` names a folder.
"""

import os
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import clsurf
from clsurf.surface.mesh import Mesh

from . import answers
from .build import WrongAnswer
from .table import print_table

SECONDS = 5.0
MEMORY_BYTES = 1 << 30
INPUTS, QUICK_INPUTS = 10_000, 60  # of each format
SEED = 1
HUGE = (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8, b"\x00\x00\x00\x00", b"\x01\x00\x00\x00")
WORDS = (b"99999999999", b"-1", b"1e999", b"nan", b"0", b"2147483648", b"\n", b" ", b"\x00")
READER = """
import resource, sys, time, warnings
import clsurf
from clsurf.io import load
warnings.simplefilter("ignore")
def peak():
    return int(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))) << 10
def reset():
    open("/proc/self/clear_refs", "w").write("5")
print("ready", flush=True)
for line in sys.stdin:
    reset(); before = peak(); start = time.perf_counter()
    try:
        load(line.rstrip(chr(10))); word = "read"
    except clsurf.Error as error:
        word = "refused" if chr(10) not in str(error) else "lines"
    except BaseException as error:
        word = "raised:" + type(error).__name__
    print(word, time.perf_counter() - start, peak() - before, flush=True)
"""


def seeds(folder: Path) -> dict[str, Path]:
    """Return a whole small file of each format; files that belong to one lie beside it."""
    size = answers.Size(60, (8, 8), 8)
    given = answers.scans(size)
    mesh, cloud = given["mesh"], clsurf.models.torus(60)
    found = {}
    for ending in (".ply", ".obj", ".stl", ".off", ".glb", ".xyz", ".pts", ".csv", ".npy", ".npz", ".las", ".laz"):
        path = folder / f"seed{ending}"
        clsurf.save(mesh if ending in (".obj", ".stl", ".off", ".glb") else cloud, path)
        found[ending] = path
    ascii_ply = folder / "ascii.ply"
    ascii_ply.write_text("ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
                         "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n"
                         "property list uchar int vertex_indices\nend_header\n0 0 0 255 0 0\n1 0 0 0 255 0\n0 1 0 0 0 9\n"
                         "0 0 1 1 2 3\n3 0 1 2\n3 0 2 3\n")
    found["ascii .ply"] = ascii_ply
    plain = Mesh(mesh.vertices[:24], np.arange(24, dtype=np.int32).reshape(-1, 3))
    clsurf.save(plain, folder / "mesh.ply")
    found["mesh .ply"] = folder / "mesh.ply"
    found["grid .ply"] = grid_ply(folder / "grid.ply")
    surface = clsurf.build_slim(cloud, error=0.05)
    for ending in (".clsurf", ".slim2t"):
        found[ending] = folder / f"seed{ending}"
        clsurf.save(surface, found[ending])
    patches = folder / "patches.clsurf"
    clsurf.save(clsurf.build_patches(mesh, patches=8, nodes=5), patches)
    found["patches .clsurf"] = patches
    found[".conf"] = folder / "seed.conf"
    found[".conf"].write_text("camera 0 0 0 0 0 0 1\nmesh grid.ply 0 0 0 0 0 0 1\n")
    frames = folder / "frames"
    (frames / "depth").mkdir(parents=True)
    image = given["ranges"].images[0]
    steps = (1000 * np.nan_to_num(image.depth)).astype(np.uint16)
    found["depth .png"] = frames / "depth" / "0.png"
    found["depth .png"].write_bytes(png_of(steps))
    found["camera .json"] = frames / "camera.json"
    found["camera .json"].write_text('{"width": 12, "height": 12, "intrinsic_matrix": [12, 0, 0, 0, 12, 0, 6, 6, 1]}')
    found["trajectory .log"] = frames / "trajectory.log"
    found["trajectory .log"].write_text("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    return found


def png_of(steps) -> bytes:
    """Return a depth image as the bytes of a 16-bit PNG."""
    import io

    from PIL import Image
    out = io.BytesIO()
    Image.fromarray(steps).save(out, "PNG")
    return out.getvalue()


def grid_ply(path: Path) -> Path:
    """Write a range grid as Stanford's scans have it."""
    head = ("ply\nformat ascii 1.0\nobj_info num_cols 3\nobj_info num_rows 2\nelement vertex 5\nproperty float x\n"
            "property float y\nproperty float z\nelement range_grid 6\nproperty list uchar int vertex_indices\n"
            "end_header\n")
    path.write_text(head + "0 0 0\n1 0 0\n2 0 0\n0 1 0\n1 1 0\n1 0\n1 1\n1 2\n1 3\n1 4\n0\n")
    return path


def damaged(whole: bytes, random) -> bytes:
    """Return a changed copy of a file: cut, spliced, with flipped bytes, or with absurd numbers in it."""
    data = bytearray(whole)
    for _ in range(random.integers(1, 4)):
        if not data:
            break
        way, at = random.integers(7), int(random.integers(len(data)))
        if way == 0:
            del data[at:]
        elif way == 1:
            data[at] = int(random.integers(256))
        elif way == 2:
            data[at] ^= 1 << int(random.integers(8))
        elif way == 3:
            word = HUGE[random.integers(len(HUGE))]
            data[at:at + len(word)] = word
        elif way == 4:
            word = WORDS[random.integers(len(WORDS))]
            data[at:at + int(random.integers(3))] = word
        elif way == 5:
            stop = at + int(random.integers(1, 64))
            data[at:at] = data[at:stop] * int(random.integers(1, 4))
        else:
            # Headers decide over memory: half of what is changed there.
            data[int(random.integers(min(len(data), 400)))] = int(random.integers(256))
    return bytes(data)


class Reader:
    """A process that loads files by name."""

    def __init__(self):
        self.process = None

    def start(self) -> None:
        """Start the process anew."""
        self.stop()
        self.process = subprocess.Popen([sys.executable, "-c", READER], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                        stderr=subprocess.DEVNULL, env={**os.environ,
                                                                        "PYTHONPATH": os.pathsep.join(sys.path)})
        self._line(120)

    def stop(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process.stdin.close()
            self.process.stdout.close()
            self.process = None

    def _line(self, seconds: float) -> str | None:
        if not select.select([self.process.stdout], [], [], seconds)[0]:
            return None
        return self.process.stdout.readline().decode(errors="replace")

    def read(self, path: Path) -> tuple[str, float, int]:
        """Return what became of a file, the seconds, and the bytes of memory beyond those before."""
        if self.process is None:
            self.start()
        start = time.perf_counter()
        self.process.stdin.write(f"{path}\n".encode())
        self.process.stdin.flush()
        line = self._line(4 * SECONDS)
        if not line:
            word = "hung" if line is None else f"ended:{self.process.wait()}"
            self.stop()
            return word, time.perf_counter() - start, 0
        word, seconds, memory = line.split()
        return word, float(seconds), int(memory)


def fuzz(name: str, seed: Path, count: int, folder: Path, keep: Path | None) -> dict:
    """Return what became of `count` damaged copies of the file `seed`."""
    random = np.random.default_rng(SEED)
    whole, reader = seed.read_bytes(), Reader()
    # Files that belong to a folder of frames are damaged in place; the folder is what is read.
    of_folder = "frames" in seed.parts
    path = seed if of_folder else seed.parent / f"damaged{seed.suffix}"
    target = next(part for part in seed.parents if part.name == "frames") if of_folder else path
    found = {"format": name, "inputs": count, "read": 0, "refused": 0, "failed": 0, "slowest_s": 0.0, "most_mb": 0.0,
             "first_failure": ""}
    try:
        reader.start()
        for i in range(count):
            path.write_bytes(damaged(whole, random))
            word, seconds, memory = reader.read(target)
            if word == "hung" or seconds > SECONDS or memory > MEMORY_BYTES:
                # A machine that was busy is no hang: only what is slow again counts.
                word, seconds, memory = reader.read(target)
            found["slowest_s"] = max(found["slowest_s"], seconds)
            found["most_mb"] = max(found["most_mb"], memory / 1e6)
            good = word in ("read", "refused") and seconds <= SECONDS and memory <= MEMORY_BYTES
            found[word if good else "failed"] += 1
            if not good:
                found["first_failure"] = found["first_failure"] or f"input {i}: {word}, {seconds:.1f} s"
                if keep is not None:
                    keep.mkdir(parents=True, exist_ok=True)
                    (keep / f"{i}-{seed.stem}{seed.suffix}").write_bytes(path.read_bytes())
    finally:
        reader.stop()
        if of_folder:
            path.write_bytes(whole)
        else:
            path.unlink(missing_ok=True)
    return found


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return what became of damaged files of each format.

    Raises
    ------
    WrongAnswer
        A file that ended the reader, raised another error than clsurf's own, hung it or took memory.
    """
    count = QUICK_INPUTS if quick else int(os.environ.get("CLSURF_FUZZ_INPUTS", INPUTS))
    keep = os.environ.get("CLSURF_FUZZ")
    with tempfile.TemporaryDirectory() as folder:
        rows = [fuzz(name, seed, count, Path(folder), Path(keep) if keep else None)
                for name, seed in seeds(Path(folder)).items()]
    print_table(["format", "inputs", "read", "refused", "failed", "slowest s", "most MB", "first failure"],
                [[row["format"], row["inputs"], row["read"], row["refused"], row["failed"], f"{row['slowest_s']:.2f}",
                  f"{row['most_mb']:.0f}", row["first_failure"]] for row in rows])
    wrong = [row for row in rows if row["failed"]]
    if wrong:
        raise WrongAnswer(f"bench fuzz: {', '.join(row['format'] for row in wrong)}: "
                          f"{sum(row['failed'] for row in wrong)} damaged files failed, first: {wrong[0]['first_failure']}"
                          ": CLSURF_FUZZ names a folder that keeps them")
    return {"inputs": count, "formats": rows}
