"""SLIM surfaces of scans larger than memory: read once in chunks, cut into cells, written part by part.

Every step (a run of a chunk, the plan, the coarse levels, the check of a cell, a cell) reads what is in the folder
NAME.part and adds files that appear whole. So a build that was killed goes on where it was, and steps of one kind can
run anywhere: their arguments are numbers (see `distributed`).
"""

import json
import logging
import os
import shutil
import threading
from dataclasses import asdict, astuple, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..device import Device, open_device
from ..device.arrays import give_back
from ..errors import InputError
from ..io.chunks import Source, open_source
from ..io.files import one_line, writable_place
from ..io.layout import from_arrays, to_arrays
from ..io.parts import part_folder, write_index, write_part
from ..io.store import load_store
from .patches import PatchRequest
from .radius import Noise, automatic_error
from .slim_levels import BOUND_SHARE, LEVELS, ROUNDING
from .stream_cells import (
    Coarse,
    Options,
    build_cell,
    build_coarse,
    cell_points,
    check_cell,
    checked,
)
from .stream_here import Here
from .stream_patches import no_patches
from .stream_plan import LARGEST, Plan, box_of, cut_cells, first_fine_level, measure, thinning
from .stream_runs import THINNED, Lattice, Runs, chunk_written, lattice_of, make_run, write_whole
from .stream_sizes import KEPT_PER_POINT, Sizes, sizes_of, with_halo

log = logging.getLogger("clsurf")

VERSION = 1  # of the files in NAME.part: others are begun anew


class Build:
    """A streamed build in a folder; every method that makes something leaves what is already made.

    Parameters
    ----------
    folder : Path
        NAME.part; holds `job.json`, which says all that the steps need.
    device : Device
    """

    def __init__(self, folder: Path, device: Device):
        self.folder, self.device = Path(folder), device
        self.work = self.folder / "work"
        job = json.loads((self.folder / "job.json").read_bytes())
        self.sizes, self.options = Sizes(**job["sizes"]), Options(**job["options"])
        self.source_path = Path(job["source"]["path"])
        self._lock, self._read = threading.RLock(), {}  # what the steps share is read once, whichever thread asks

    # Steps --------------------------------------------------------------------------------------------------------

    def source(self) -> Source:
        """Return the scan's file."""
        return open_source(self.source_path, self.sizes.chunk)

    def make_lattice(self, source: Source) -> None:
        """Decide the fine cells from the first chunk, and write it as run 0."""
        path = self.work / "lattice.json"
        if path.exists():
            return
        for number in range(source.chunks):
            chunk = source.read(number)
            if len(chunk.points) > 1:
                break
        else:
            raise InputError(f"{self.source_path}: expected points, got none that are finite")
        lattice_of(chunk, self.device).write(path)

    def lattice(self) -> Lattice:
        """Return the fine cells."""
        return Lattice.read(self.work / "lattice.json")

    def make_run(self, source: Source, number: int) -> None:
        """Write one chunk as a sorted run."""
        make_run(self.work / "runs", number, source, self.lattice())
        give_back()

    def make_plan(self) -> None:
        """Cut the cells and measure what they share."""
        path = self.work / "plan.npz"
        if path.exists():
            return
        runs = self.runs
        count = int(runs.counts.sum())
        if not count:
            raise InputError(f"{self.source_path}: expected points, got none that are finite")
        thin = thinning(count, self.sizes.thin)
        origin, diagonal = box_of(runs, thin // THINNED)
        if not diagonal > 0:
            raise InputError("scan: expected points with some extent, got all of them at one place")
        noise, neighbours = measure(runs, diagonal, self.device)
        error = automatic_error(noise) if self.options.error == "auto" else float(self.options.error)
        spacing, width = noise.spacing * diagonal, runs.lattice.width
        rings = int(np.ceil(2 * LARGEST * np.sqrt(thin / THINNED) * spacing / width))
        cuts = cut_cells(runs.cells, runs.counts, with_halo(self.sizes.cell, rings * width / max(spacing, 1e-300)))
        first = 1 if len(cuts) == 2 or self.options.patches is not None else first_fine_level(noise.spacing, thin)
        rings = 0 if len(cuts) == 2 else rings
        _write_arrays(path, origin=origin, cuts=cuts, numbers=np.array([
            diagonal, noise.variance, noise.spacing, error, thin, first, rings, neighbours]))

    @property
    def plan(self) -> Plan:
        """What the cells agree on."""
        return self._once("plan", self._read_plan)

    @property
    def runs(self) -> Runs:
        """The points on disk."""
        return self._once("runs", lambda: Runs(self.work / "runs", self.lattice()))

    def make_coarse(self) -> None:
        """Make the levels before the cells' from the thinned copy."""
        path = self.work / "coarse.npz"
        if not path.exists():
            coarse = build_coarse(self.runs, self.plan, self.options, self.device)
            _write_surface(path, coarse.surface, copy_points=coarse.points, copy_normals=coarse.normals)
            self.device.trim()

    def check(self, number: int) -> None:
        """Compare the coarse leaves with all points of a cell."""
        path = self.work / "checks" / f"{number:05d}.npz"
        if path.exists():
            return
        points = cell_points(self.runs, self.plan, number, halo=False)
        near, sums = check_cell(points, self.plan, self._made_coarse(), self.device)
        _write_arrays(path, near=near, sums=sums)

    def join_checks(self) -> None:
        """Write the coarse part with the leaves that fit all points."""
        if part_folder(self.folder, 0).exists():
            return
        coarse = self._made_coarse().surface
        if self.options.patches is not None:
            none = no_patches(self.plan, PatchRequest(*self.options.patches), coarse.colors is not None, coarse.origin)
            self._describe(0, none, np.zeros(0, np.float32))
            write_part(self.folder, 0, none)
            return
        sums = np.zeros((len(coarse), 2))
        for number in range(self.plan.cells):
            with np.load(self.work / "checks" / f"{number:05d}.npz") as data:
                sums[data["near"]] += data["sums"]
        surface = checked(coarse, sums, self.plan, self.options)
        self._describe(0, surface, np.zeros(0, np.float32))
        write_part(self.folder, 0, surface)

    def run_written(self, number: int) -> bool:
        """Return whether run `number` is there."""
        return chunk_written(self.work / "runs", number)

    def check_written(self, number: int) -> bool:
        """Return whether cell `number` has been checked."""
        return (self.work / "checks" / f"{number:05d}.npz").exists()

    def cell_written(self, number: int) -> bool:
        """Return whether cell `number` is there."""
        return part_folder(self.folder, number + 1).exists()

    def build(self, number: int) -> None:
        """Build cell `number` and write it as part number + 1."""
        if self.cell_written(number):
            return
        surface, distance = build_cell(cell_points(self.runs, self.plan, number), self.plan, self.options,
                                       self._checked_coarse(), self.device, int(self.runs.counts.sum()))
        self._describe(number + 1, surface, distance)
        write_part(self.folder, number + 1, surface)
        give_back()

    def finish(self, out: Path) -> None:
        """Write the index, drop what only the build needed, and give the folder its name."""
        about = []
        for number in range(self.plan.cells + 1):
            with np.load(self.work / "parts" / f"{number:05d}.npz") as data:
                about.append({name: data[name] for name in data.files})
        bounds, surfels = (np.stack([one[name] for one in about]) for name in ("bounds", "surfels"))
        distance = np.concatenate([one["distance"] for one in about])
        # Patches come with the bound of their cell: the largest holds for all.
        share = BOUND_SHARE if self.options.patches is None else 1.0
        bound = float(np.quantile(distance, share)) if len(distance) else float("nan")
        largest = float(distance.max()) if len(distance) and self.options.patches is None else float("nan")
        values = {"degree": self.options.degree, "error": self.plan.error, "diagonal": self.plan.diagonal,
                  "bound": bound if np.isfinite(bound) else None, "bound_share": BOUND_SHARE, "oriented": True,
                  "bound_all": largest + ROUNDING * self.plan.diagonal if np.isfinite(largest) else None,
                  "parts": len(about), "leaves": int(sum(one["leaves"] for one in about)),
                  "colored": bool(all(one["colored"] for one in about))}
        kind = "slim" if self.options.patches is None else "patches"
        write_index(self.folder, values, bounds, surfels, kind)
        shutil.rmtree(self.work)
        (self.folder / "job.json").unlink()
        if out.is_dir():
            shutil.rmtree(out)
        os.replace(self.folder, out)

    def _describe(self, part: int, surface, distance: NDArray) -> None:
        """Write what the index says of a part, before the part itself."""
        slim = self.options.patches is None
        surfels = np.bincount(surface.level, minlength=LEVELS + 1)[1:] if slim else np.array([len(surface)])
        leaves = surface.leaf.sum() if slim else len(surface)
        _write_arrays(self.work / "parts" / f"{part:05d}.npz", bounds=surface.bounds, surfels=surfels, leaves=leaves,
                      colored=surface.colors is not None, distance=distance)

    # What was made ------------------------------------------------------------------------------------------------

    def _once(self, name: str, read):
        with self._lock:
            if name not in self._read:
                self._read[name] = read()
            return self._read[name]

    def _read_plan(self) -> Plan:
        with np.load(self.work / "plan.npz") as data:
            diagonal, variance, spacing, error, *whole = data["numbers"].tolist()
            thin, first, rings, neighbours = map(int, whole)
            return Plan(data["origin"], diagonal, Noise(variance, spacing), error, thin, first, data["cuts"], rings,
                        neighbours)

    def _made_coarse(self) -> Coarse:
        return self._once("coarse", self._read_coarse)

    def _read_coarse(self) -> Coarse:
        with np.load(self.work / "coarse.npz") as data:
            arrays = {name: data[name] for name in data.files}
        values = json.loads(bytes(arrays.pop("values")).decode())
        points, normals = arrays.pop("copy_points"), arrays.pop("copy_normals")
        return Coarse(from_arrays("slim", arrays, values), points, normals)

    def _checked_coarse(self) -> Coarse:
        coarse = self._made_coarse()
        return self._once("checked", lambda: replace(coarse, surface=load_part(self.folder, 0)))


def load_part(folder: Path, number: int):
    """Return part `number` of an unfinished surface."""
    return load_store(part_folder(folder, number))


def _write_arrays(path: Path, **arrays: NDArray) -> None:
    path.parent.mkdir(exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with open(temporary, "wb") as file:
        np.savez(file, **arrays)
    os.replace(temporary, path)


def _write_surface(path: Path, surface, **more: NDArray) -> None:
    _, arrays, values = to_arrays(surface)
    _write_arrays(path, values=np.frombuffer(json.dumps(values).encode(), np.uint8), **arrays, **more)


def begin(path, out: Path, options: Options, sizes: Sizes, device: Device) -> Build:
    """Return the build in OUT.part: the one that was begun there with the same scan and options, or a new one."""
    folder = out.with_name(out.name + ".part")
    about = {"path": "", "size": 0, "modified": 0}  # of points in memory
    if not isinstance(path, Source):
        stat = Path(path).stat()
        about = {"path": str(Path(path).resolve()), "size": stat.st_size, "modified": stat.st_mtime_ns}
    job = {"version": VERSION, "source": about,
           "options": asdict(options), "sizes": asdict(sizes)}
    text = json.dumps(job)  # a tuple becomes a list: what is read is compared as text
    old = folder / "job.json"
    if folder.exists() and (not old.exists() or old.read_text() != text):
        if not (old.exists() or not any(folder.iterdir())):
            raise InputError(f"{folder}: expected an unfinished build or nothing, got a folder of other files: move it")
        log.info("%s: of another scan or of other options: begun anew", folder)
        shutil.rmtree(folder)
    elif folder.exists():
        log.info("%s: going on with it", folder)
    folder.mkdir(exist_ok=True)
    write_whole(old, text.encode())  # first: without it the folder is no build to go on with
    (folder / "work" / "runs").mkdir(parents=True, exist_ok=True)
    return Build(folder, device)


def build_streamed(path, out, degree=2, error="auto", tolerance=None, memory_limit=None, report=lambda *_: None,
                   device=None, scheduler=None, sizes: Sizes | None = None, patches=None) -> Path:
    """Build a SLIM surface from a file larger than memory; return the folder of its store.

    Parameters
    ----------
    path : path-like or Source
    report : callable
        report(stage, done) with done from 0 to 1; may raise to stop: what is done stays in OUT.part.
    scheduler : str or distributed.Client, optional
        Workers that take the steps; see `distributed`.
    sizes : Sizes, optional
        How much is taken at once, in place of what `memory_limit` says.
    patches : PatchRequest, optional
        Build patches, as `clsurf.build.patches` has them, in place of surfels.

    Raises
    ------
    InputError
        Also a disk that is full: what is done stays.
    """
    try:
        return _streamed(path, Path(out), degree, error, tolerance, memory_limit, report, device, scheduler, sizes,
                         patches)
    except OSError as problem:
        raise InputError(f"{out}: the build stopped: {one_line(problem.strerror or problem)}: what is done stays in "
                         f"{Path(out).name}.part, and the same call goes on with it") from problem


def _streamed(path, out, degree, error, tolerance, memory_limit, report, device, scheduler, sizes, patches) -> Path:
    name = device if isinstance(device, str) else None  # of the workers' device
    device = open_device(device)
    out = out if out.is_dir() else writable_place(out)
    sizes = sizes_of(memory_limit) if sizes is None else sizes
    source = path if isinstance(path, Source) else open_source(path, sizes.chunk)
    options = Options(int(degree), error if error == "auto" else float(error), tolerance, _orient(source),
                      None if patches is None else astuple(patches))
    build = begin(path, out, options, sizes, device)
    kept = device.keep(sizes.cell * KEPT_PER_POINT)
    steps = Here(build, source) if scheduler is None else _cluster(scheduler, build, name)
    try:
        report("read", 0.0)
        build.make_lattice(source)
        steps.runs(range(source.chunks), report)
        report("plan", 0.0)
        build.make_plan()
        build.make_coarse()
        steps.checks(range(build.plan.cells), report)
        build.join_checks()
        steps.cells(range(build.plan.cells), report)
        build.finish(out)
        report("cells", 1.0)
    finally:
        steps.close()
        device.keep(kept)
        device.trim()
    return out


def _cluster(scheduler, build: Build, device: str | None):
    from .distributed import OnCluster
    return OnCluster(scheduler, build, device)


def _orient(source: Source) -> str:
    return "up" if source.airborne else "graph"
