"""The job `fuzz`: damaged files of every format that is read: no crash, no hang, no memory taken.

Small whole files of each format are cut, spliced, flipped and given absurd numbers; a reader in a process of its own
reads each. It may give what was in the file or raise one of clsurf's own errors; anything else, over `SECONDS`, or over
`MEMORY_BYTES` more than before counts. The files that failed are kept where `CLSURF_FUZZ` names a folder;
`CLSURF_FUZZ_INPUTS` is how many of each format, and `CLSURF_FUZZ_FORMATS` names some of them, with commas.
"""

import logging
import os
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import clsurf
from clsurf.io.images import write_frame, write_image
from clsurf.surface.mesh import Mesh

from . import answers
from .build import WrongAnswer
from .table import print_table

SECONDS = 5.0
MEMORY_BYTES = 1 << 30
INPUTS, QUICK_INPUTS = 10_000, 60  # of each format
SEED = 1
COUNTED = ("read", "refused", "failed")
log = logging.getLogger("clsurf")
HUGE = (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8, b"\x00\x00\x00\x00",
        b"\x01\x00\x00\x00")
WORDS = (b"99999999999", b"-1", b"1e999", b"nan", b"0", b"2147483648", b"\n", b" ", b"\x00")
BATCH = 50  # inputs that a reader is given at once: on a busy machine every turn between two processes waits
READER = """
import sys, time, warnings
import clsurf
from clsurf.io import load
from clsurf.io.images import read_channels
from clsurf.render.skies import linear_picture
warnings.simplefilter("ignore")
def picture(path):
    linear_picture("picture", path, {})
    read_channels(path)
def stored(path):
    place = clsurf.open_surface(path)
    place.bounds, len(place), repr(place)
    place.read(0, 3)
    place.load()
READ = {"load": load, "cameras": clsurf.load_cameras, "path": clsurf.CameraPath.load, "picture": picture,
        "stored": stored}
def peak():
    return int(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))) << 10
def reset():
    open("/proc/self/clear_refs", "w").write("5")
print("ready", flush=True)
for line in sys.stdin:
    how, path = line.rstrip(chr(10)).split(" ", 1)
    reset(); before = peak(); start = time.perf_counter()
    try:
        READ[how](path); word = "read"
    except clsurf.Error as error:
        word = "refused" if chr(10) not in str(error) else "lines"
    except BaseException as error:
        word = "raised:" + type(error).__name__
    print(word, time.perf_counter() - start, peak() - before, flush=True)
"""


@dataclass(frozen=True)
class Seed:
    """Whole files of a format, in a folder of their own.

    Parameters
    ----------
    folder : Path
    damaged : tuple of str
        The files of the folder that are damaged, one at a time; none: any.
    read : str
        What the reader is given, "" the folder itself.
    how : str
        What it does with it, one of `READ`.
    """

    folder: Path
    damaged: tuple[str, ...]
    read: str
    how: str = "load"


def seeds(folder: Path, device) -> dict[str, Seed]:
    """Return whole small files of each format."""
    given = answers.scans(answers.Size(60, (8, 8), 8))
    mesh, cloud, found = given["mesh"], clsurf.models.torus(60), {}

    def enter(name: str, file: str, write, how: str = "load") -> None:
        place = folder / f"seed {len(found)}"
        place.mkdir()
        write(place / file)
        found[name] = Seed(place, (file,), file, how)

    for ending in (".ply", ".obj", ".stl", ".off", ".glb", ".xyz", ".pts", ".csv", ".npy", ".npz", ".las", ".laz"):
        of = mesh if ending in (".obj", ".stl", ".off", ".glb") else cloud
        enter(ending, f"seed{ending}", lambda path, of=of: clsurf.save(of, path))
    enter(".gltf", "seed.gltf", lambda path: path.write_text(GLTF))
    enter("ascii .ply", "seed.ply", lambda path: path.write_text(ASCII_PLY))
    plain = Mesh(mesh.vertices[:24], np.arange(24, dtype=np.int32).reshape(-1, 3))
    enter("mesh .ply", "seed.ply", lambda path: clsurf.save(plain, path))
    enter("grid .ply", "seed.ply", grid_ply)
    stores(folder, mesh, cloud, enter, found, device)
    frames(folder, given["ranges"].images[0], found)
    cameras(folder, enter, found)
    light = np.random.default_rng(0).random((12, 24, 3)).astype(np.float32)
    for ending in (".png", ".jpg", ".hdr"):
        enter(f"picture {ending}", f"seed{ending}", lambda path: write_picture(path, light), "picture")
    enter("picture .exr", "seed.exr", lambda path: write_frame(path, {"color": np.dstack([light, light[..., 0]])}),
          "picture")
    return found


def write_picture(path: Path, light) -> None:
    """Write a small picture; .hdr is one that panoramas come in."""
    if path.suffix != ".hdr":
        return write_image(path, np.uint8(255 * light))
    import OpenImageIO as oiio
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), oiio.ImageSpec(light.shape[1], light.shape[0], 3, "float"))
    out.write_image(light)
    out.close()
    return None


def stores(folder: Path, mesh, cloud, enter, found: dict, device) -> None:
    """Enter surfaces: zips that are read whole, and zips and folders of which parts are read."""
    kinds = {"": clsurf.build_slim(cloud, error=0.05, device=device),
             "patches ": clsurf.build_patches(mesh, patches=8, nodes=5, device=device),
             "surfels ": clsurf.build_surfels(cloud, map_size=4, device=device),
             "scale map ": clsurf.build_scale_map(mesh, size=4, device=device)}
    for name, surface in kinds.items():
        enter(f"{name}.clsurf", "seed.clsurf", lambda path, surface=surface: clsurf.save(surface, path))
    enter(".slim2t", "seed.slim2t", lambda path: clsurf.save(kinds[""], path))
    enter("stored .clsurf", "seed.clsurf", lambda path: clsurf.save(kinds[""], path), "stored")
    place = folder / "streamed"
    place.mkdir()
    clsurf.save(clsurf.models.torus(400), place.with_suffix(".ply"))
    clsurf.build_slim(place.with_suffix(".ply"), error=0.05, out=place / "seed.clsurf", memory_limit="1GB",
                      device=device)
    # Read as it is opened, and whole.
    found["folder .clsurf"] = Seed(place, (), "seed.clsurf", "stored")
    found["whole folder .clsurf"] = Seed(place, (), "seed.clsurf")


def frames(folder: Path, image, found: dict) -> None:
    """Enter range images: Stanford's list of grids, and a folder of frames."""
    place = folder / "conf"
    place.mkdir()
    grid_ply(place / "grid.ply")
    (place / "seed.conf").write_text("camera 0 0 0 0 0 0 1\nmesh grid.ply 0 0 0 0 0 0 1\n")
    found[".conf"] = Seed(place, ("seed.conf",), "seed.conf")
    place = folder / "frames"
    (place / "depth").mkdir(parents=True)
    (place / "depth" / "0.png").write_bytes(png_of((1000 * np.nan_to_num(image.depth)).astype(np.uint16)))
    (place / "camera.json").write_text('{"width": 12, "height": 12, "intrinsic_matrix": [12, 0, 0, 0, 12, 0, 6, 6, 1]}')
    (place / "trajectory.log").write_text("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    for name, file in (("depth .png", "depth/0.png"), ("intrinsics .json", "camera.json"),
                       ("trajectory .log", "trajectory.log")):
        found[name] = Seed(place, (file,), "")


def cameras(folder: Path, enter, found: dict) -> None:
    """Enter files of cameras: clsurf's JSON, and COLMAP's models as text and binary."""
    views = [clsurf.Camera.look_at((x, -3, 2), (0, 0, 0), up=(0, 0, 1), fov=40) for x in (0.0, 1.0)]
    enter("cameras .json", "seed.json", lambda path: clsurf.save_cameras(views, path), "cameras")
    enter("path .json", "seed.json", lambda path: clsurf.save_cameras(views, path), "path")
    lens, pose = (640, 480), (1.0, 0.0, 0.0, 0.0, 0.5, 0.25, 4.0)
    place = folder / "colmap text"
    place.mkdir()
    (place / "cameras.txt").write_text("# cameras\n1 PINHOLE 640 480 500 510 310.5 250.25\n2 SIMPLE_RADIAL 640 480 500 "
                                       "320 240 0\n")
    (place / "images.txt").write_text("".join(f"{i} {' '.join(map(str, pose))} {i} {i}.png\n1.5 2.5 -1 3 4 7\n"
                                              for i in (1, 2)))
    found["COLMAP .txt"] = Seed(place, ("cameras.txt", "images.txt"), "", "cameras")
    place = folder / "colmap binary"
    place.mkdir()
    (place / "cameras.bin").write_bytes(struct.pack("<QiiQQ4diiQQ4d", 2, 1, 1, *lens, 500, 510, 310.5, 250.25, 2, 2,
                                                    *lens, 500, 320, 240, 0))
    (place / "images.bin").write_bytes(struct.pack("<Q", 2) + b"".join(
        struct.pack("<i7di", i, *pose, i) + b"%d.png\0" % i + struct.pack("<QddqddQ", 2, 1, 2, -1, 3, 4, 7)
        for i in (1, 2)))
    found["COLMAP .bin"] = Seed(place, ("cameras.bin", "images.bin"), "", "cameras")


ASCII_PLY = ("ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
             "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n"
             "property list uchar int vertex_indices\nend_header\n0 0 0 255 0 0\n1 0 0 0 255 0\n0 1 0 0 0 9\n"
             "0 0 1 1 2 3\n3 0 1 2\n3 0 2 3\n")
GLTF = """{"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
"accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
{"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}],
"bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}],
"buffers": [{"byteLength": 44, "uri": "data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD\
8AAAAAAAABAAIAAAA="}]}"""


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
        self.process, self._answers = None, b""

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
            self.process, self._answers = None, b""

    def _line(self, seconds: float) -> str | None:
        """Return the next line, "" at the end; None where there is none for so long.

        Several may come at once: with those in a buffer of the stream's own, `select` would wait for more.
        """
        pipe = self.process.stdout.fileno()
        while b"\n" not in self._answers:
            if not select.select([pipe], [], [], seconds)[0]:
                return None
            got = os.read(pipe, 1 << 16)
            if not got:
                return ""
            self._answers += got
        line, self._answers = self._answers.split(b"\n", 1)
        return line.decode(errors="replace")

    def read(self, path: Path, how: str = "load") -> tuple[str, float, int]:
        """Return what became of a file, the seconds, and the bytes of memory beyond those before."""
        return self.read_all([path], how)[0]

    def read_all(self, paths: list[Path], how: str = "load") -> list[tuple[str, float, int]]:
        """Return what became of each of a few files."""
        found = []
        while len(found) < len(paths):
            if self.process is None:
                self.start()
            self.process.stdin.write("".join(f"{how} {path}\n" for path in paths[len(found):]).encode())
            self.process.stdin.flush()
            while len(found) < len(paths) and self.process is not None:
                found.append(self._answer())
        return found

    def _answer(self) -> tuple[str, float, int]:
        start = time.perf_counter()
        line = self._line(4 * SECONDS)
        if not line:
            word = "hung" if line is None else f"ended:{self.process.wait()}"
            self.stop()
            return word, time.perf_counter() - start, 0
        word, seconds, memory = line.split()
        return word, float(seconds), int(memory)


def damaged_copy(seed: Seed, place: Path, random) -> Path:
    """Make a copy of a seed's folder with one file damaged; return what is read of it."""
    shutil.copytree(seed.folder, place, copy_function=os.link)
    names = seed.damaged or sorted(str(path.relative_to(place)) for path in place.rglob("*") if path.is_file())
    target = place / names[random.integers(len(names))]
    whole = target.read_bytes()
    target.unlink()  # the whole one is linked here
    target.write_bytes(damaged(whole, random))
    return place / seed.read if seed.read else place


def fuzz(name: str, seed: Seed, count: int, folder: Path, keep: Path | None, reader: Reader) -> dict:
    """Return what became of `count` damaged copies of the files of `seed`."""
    random, work = np.random.default_rng(SEED), folder / "work"
    found = {"format": name, "inputs": count, "read": 0, "refused": 0, "failed": 0, "slowest_s": 0.0, "most_mb": 0.0,
             "first_failure": ""}
    try:
        for first in range(0, count, BATCH):
            numbers = range(first, min(first + BATCH, count))
            work.mkdir()
            paths = [damaged_copy(seed, work / str(i), random) for i in numbers]
            answered = reader.read_all(paths, seed.how)
            for i, path, (word, seconds, memory) in zip(numbers, paths, answered, strict=True):
                if word == "hung" or seconds > SECONDS or memory > MEMORY_BYTES:
                    # A machine that was busy is no hang: only what is slow again counts.
                    word, seconds, memory = reader.read(path, seed.how)
                found["slowest_s"] = max(found["slowest_s"], seconds)
                found["most_mb"] = max(found["most_mb"], memory / 1e6)
                good = word in ("read", "refused") and seconds <= SECONDS and memory <= MEMORY_BYTES
                found[word if good else "failed"] += 1
                if not good:
                    found["first_failure"] = found["first_failure"] or f"input {i}: {word}, {seconds:.1f} s"
                    if keep is not None:
                        shutil.copytree(work / str(i), keep / f"{name} {i}", dirs_exist_ok=True)
            shutil.rmtree(work)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return found


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return what became of damaged files of each format.

    Raises
    ------
    WrongAnswer
        A file that ended the reader, raised another error than clsurf's own, hung it or took memory.
    """
    count = QUICK_INPUTS if quick else int(os.environ.get("CLSURF_FUZZ_INPUTS", INPUTS))
    keep, only = os.environ.get("CLSURF_FUZZ"), os.environ.get("CLSURF_FUZZ_FORMATS", "").split(",")
    head = ["format", "inputs", "read", "refused", "failed", "slowest s", "most MB", "first failure"]
    with tempfile.TemporaryDirectory() as folder:
        rows, reader = [], Reader()
        try:
            for name, seed in seeds(Path(folder), device).items():
                if only == [""] or name in only:
                    rows.append(fuzz(name, seed, count, Path(folder), Path(keep) if keep else None, reader))
                    log.info("%s: %d read, %d refused, %d failed", name, *(rows[-1][key] for key in COUNTED))
        finally:
            reader.stop()
    print_table(head, [[row["format"], row["inputs"], row["read"], row["refused"], row["failed"],
                        f"{row['slowest_s']:.2f}", f"{row['most_mb']:.0f}", row["first_failure"]] for row in rows])
    wrong = [row for row in rows if row["failed"]]
    if wrong:
        raise WrongAnswer(f"bench fuzz: {', '.join(row['format'] for row in wrong)}: "
                          f"{sum(row['failed'] for row in wrong)} damaged files failed, first: "
                          f"{wrong[0]['first_failure']}: CLSURF_FUZZ names a folder that keeps them")
    return {"inputs": count, "formats": rows}
