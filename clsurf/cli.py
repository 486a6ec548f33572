"""The command line: `clsurf demo | devices | doctor | info | build | convert | render | bench`.

Bad input ends with one line and exit code 2, never with a traceback; long work shows a bar on a terminal and a plain
line per step elsewhere.
"""

import contextlib
import math
import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from .errors import Error, InputError

PICTURES = (".png", ".jpg", ".jpeg", ".exr")

app = typer.Typer(name="clsurf", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  help="Compact surface models from scans, drawn on any OpenCL device.",
                  context_settings={"help_option_names": ["-h", "--help"]})

DeviceOption = Annotated[str, typer.Option("--device", "-d", help="gpu, cpu, pocl, intel, nvidia, amd, gpu:1 or part "
                                           "of a name; default: CLSURF_DEVICE, else a GPU, else the fastest CPU "
                                           "runtime.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
ErrorOption = Annotated[str, typer.Option(help="T_MDL relative to the bounding box's diagonal, or 'auto': from the "
                                          "scan's noise.")]
DegreeOption = Annotated[int, typer.Option(min=1, max=3, help="Degree of the surfels: 1, 2 or 3.")]
SizeOption = Annotated[str, typer.Option(help="Picture size, such as 1024x768.")]


class Steps:
    """Reports steps of work: a progress bar on a terminal, a plain line per finished step elsewhere."""

    def __init__(self, quiet: bool):
        self.quiet, self.times = quiet, {}
        self.bar = None
        if not quiet and sys.stderr.isatty():
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
            self.bar = Progress(TextColumn("{task.description:34}"), BarColumn(), TimeElapsedColumn(), transient=True)

    @contextlib.contextmanager
    def step(self, name: str):
        """Time one step; inside it, `progress` moves its bar."""
        start = time.perf_counter()
        if self.bar is not None:
            self.bar.start()
            self.task = self.bar.add_task(name, total=1.0)
        try:
            yield
        finally:
            if self.bar is not None:
                self.bar.remove_task(self.task)
                self.bar.stop()
        self.times[name] = time.perf_counter() - start
        self.say(f"{name:<34} {self.times[name]:8.3f} s")

    def progress(self, stage: str, done: float) -> None:
        """Move the bar of the running step; the callback that builders take."""
        if self.bar is not None:
            self.bar.update(self.task, completed=done, description=stage)

    def say(self, text: str) -> None:
        """Print a line unless quiet."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)


def checked_out(path: Path, endings=()) -> Path:
    """Return `path` if it can be written and ends in one of `endings`: told before the work, not after it."""
    if endings and path.suffix.lower() not in endings:
        raise InputError(f"output {path}: expected a name that ends in {', '.join(endings[:-1])} or {endings[-1]}")
    from .io.files import writable_place
    return writable_place(path)


def parsed_size(text: str) -> tuple[int, int]:
    """Return (width, height) of a text such as 1024x768."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise InputError(f"size: expected WIDTHxHEIGHT such as 1024x768, got {text!r}")
    return int(width), int(height)


def parsed_error(text: str) -> float | str:
    """Return T_MDL as a number, or 'auto'."""
    if text == "auto":
        return text
    try:
        value = float(text)
        if not 0 < value < 1:
            raise ValueError
    except ValueError:
        raise InputError(f"error: expected a number between 0 and 1 such as 0.01, or auto, got {text!r}") from None
    return value


def parsed_vector(name: str, text: str) -> tuple[float, float, float]:
    """Return three numbers of a text such as 1,0.5,2."""
    try:
        x, y, z = (float(part) for part in text.split(","))
        if not 0 < x * x + y * y + z * z < float("inf"):
            raise ValueError
    except ValueError:
        raise InputError(f"{name}: expected three numbers such as 1,0.5,2, not all 0, got {text!r}") from None
    return x, y, z


def print_version(wanted: bool):
    """Print the version and leave, where it is asked for."""
    if wanted:
        from . import __version__
        print(f"clsurf {__version__}")
        raise typer.Exit


@app.callback()
def options(version: Annotated[bool, typer.Option("--version", callback=print_version, is_eager=True,
                                                  help="Print the version.")] = False):
    """Compact surface models from scans, drawn on any OpenCL device."""


@app.command()
def demo(out: Annotated[Path, typer.Argument(help="Picture to write: .png, .jpg, .exr.")] = Path("clsurf-demo.png"),
         size: SizeOption = "1024x768", error: ErrorOption = "0.01", degree: DegreeOption = 2,
         device: DeviceOption = "", quiet: QuietOption = False):
    """Make a scan, build its surface, draw it, and say where the picture is and how long each step took."""
    import clsurf
    steps, start = Steps(quiet), time.perf_counter()
    picture_size, t_mdl = parsed_size(size), parsed_error(error)
    checked_out(out, PICTURES)
    with steps.step("open the device"):
        chosen = clsurf.open_device(device or None)
    steps.say(f"  {chosen.name} ({chosen.platform_name})")
    with steps.step("make a scan"):
        scan = clsurf.models.demo_scan()
    steps.say(f"  {scan}")
    with steps.step("build the surface"):
        surface = clsurf.build_slim(scan, degree=degree, error=t_mdl, device=chosen, progress=steps.progress)
    steps.say(f"  {surface}")
    camera = clsurf.Camera.framing(surface, aspect=picture_size[0] / picture_size[1])
    with steps.step("draw it"):
        frame = clsurf.render(surface, camera, picture_size, device=chosen)
    with steps.step("draw it again (kernels are ready)"):
        frame = clsurf.render(surface, camera, picture_size, device=chosen)
    with steps.step("write the picture"):
        frame.save(out)
    steps.say(f"picture: {out.resolve()} ({picture_size[0]} x {picture_size[1]}), all in "
              f"{time.perf_counter() - start:.1f} s")
    if quiet:
        print(out.resolve())


@app.command()
def devices(quiet: QuietOption = False):
    """List the OpenCL devices, the default one marked."""
    from .device import all_devices, choose_device, open_device
    found, named = all_devices(), os.environ.get("CLSURF_DEVICE", "")
    try:
        default = choose_device(named)
    except Error:
        if not found:
            raise
        default = None
    for cl_device in found:
        device = open_device(cl_device)
        form = f"{device.lanes} lanes a work-item" if device.lanes > 1 else "a work-group per tile"
        mark = "*" if cl_device == default else " "
        if quiet:
            print(device.name)
            continue
        print(f"{mark} {device.name}\n    {device.platform_name}, {device.kind}, {device.units} units, "
              f"{device.memory_bytes / 1e9:.1f} GB, {device.version}, driver {device.driver}, {form}")
    if default is None:
        print(f"clsurf: CLSURF_DEVICE={named} names none of them", file=sys.stderr)
        raise typer.Exit(2)
    if not quiet:
        print("* is the default; choose with --device NAME or CLSURF_DEVICE=NAME")


@app.command()
def doctor(quiet: QuietOption = False):
    """Say what was found, what is missing, and the one command that mends it."""
    from .device.doctor import examine
    findings = examine()
    for finding in findings:
        if quiet and finding.good:
            continue
        print(f"{'ok     ' if finding.good else 'MISSING'}  {finding.name}: {finding.detail}")
        if finding.mend:
            print(f"         {'mend' if not finding.good else 'add'} it: {finding.mend}")
    if not all(finding.good for finding in findings):
        raise typer.Exit(1)


@app.command()
def info(path: Annotated[Path, typer.Argument(help="A scan or a surface.")]):
    """Say what a file holds: counts, bytes, bounds."""
    import clsurf

    from .surface.slim import FLOATS, SlimSurface
    thing = clsurf.load(path)
    print(thing)
    low, high = thing.bounds
    print("bounds   " + " to ".join("[" + ", ".join(f"{v:.10g}" for v in corner) + "]" for corner in (low, high)))
    if isinstance(thing, SlimSurface):
        leaves = int(thing.leaf.sum())
        print(f"surfels  {len(thing):,}, of which {leaves:,} leaves on {int(thing.level.max(initial=0))} levels, "
              f"{len(thing.children):,} links")
        print(f"floats   {FLOATS[thing.degree] * leaves:,} in the leaves, {FLOATS[thing.degree]} a surfel")
        error = "T_MDL not stored" if math.isnan(thing.error) else f"T_MDL {thing.error:g}"
        bound = "not stored" if math.isnan(thing.bound) else \
            f"{thing.bound:g} for {thing.bound_share:.1%} of the scan's points"
        print(f"error    {error}, diagonal {thing.diagonal:g}; bound {bound}")
        return
    print("points   " + ", ".join(f"{name} {'yes' if getattr(thing, name, None) is not None else 'no'}"
                                  for name in ("normals", "colors")))


@app.command()
def build(scan: Annotated[Path, typer.Argument(help="A scan: PLY OBJ STL OFF GLB XYZ PTS CSV NPY LAS LAZ.")],
          out: Annotated[Path, typer.Argument(help="The surface to write: .clsurf or .slim2t.")],
          degree: DegreeOption = 2, error: ErrorOption = "0.01",
          device: DeviceOption = "", quiet: QuietOption = False):
    """Turn a scan into a SLIM surface."""
    import clsurf
    steps = Steps(quiet)
    t_mdl = parsed_error(error)
    checked_out(out, (".clsurf", ".slim2t"))
    with steps.step("load"):
        loaded = clsurf.load(scan)
    steps.say(f"  {loaded}")
    with steps.step("build"):
        surface = clsurf.build_slim(loaded, degree=degree, error=t_mdl, device=device or None,
                                    progress=steps.progress)
    steps.say(f"  {surface}\n  within {surface.bound:g} of {surface.bound_share:.1%} of the scan's points")
    with steps.step("save"):
        clsurf.save(surface, out)
    steps.say(f"surface: {out.resolve()}")


@app.command()
def convert(source: Annotated[Path, typer.Argument(help="A scan or a surface.")],
            out: Annotated[Path, typer.Argument(help="The file to write; its ending chooses the format.")],
            quiet: QuietOption = False):
    """Write a scan or a surface in another format."""
    import clsurf

    from .io.dispatch import WRITES
    steps = Steps(quiet)
    checked_out(out, WRITES)
    with steps.step("load"):
        thing = clsurf.load(source)
    steps.say(f"  {thing}")
    with steps.step("save"):
        clsurf.save(thing, out)
    steps.say(f"written: {out.resolve()}")


@app.command()
def render(source: Annotated[Path, typer.Argument(help="A surface, or a scan (its surface is then built first).")],
           out: Annotated[Path, typer.Argument(help="Picture: .png, .jpg, or .exr with every channel.")],
           size: SizeOption = "1024x768",
           direction: Annotated[str, typer.Option(help="From the target to the eye: x,y,z.")] = "1,0.5,2",
           up: Annotated[str, typer.Option(help="Upward: x,y,z.")] = "0,1,0",
           fov: Annotated[float, typer.Option(help="Vertical field of view, degrees.")] = 40.0,
           channels: Annotated[str, typer.Option(help="From color,depth,normal,position,level,count,cost,id; .png and "
                                                      ".jpg show color.")] = "color,depth,normal",
           shading: Annotated[str, typer.Option(help="phong, flat, ball_size or ball_level.")] = "phong",
           lod: Annotated[float, typer.Option(help="Projected diameter in pixels below which coarser surfels serve; 8 "
                                              "is the fast mode, 0 draws leaves only.")] = 4.0,
           degree: DegreeOption = 2, error: ErrorOption = "0.01",
           profile: Annotated[bool, typer.Option(help="Print the time of every kernel.")] = False,
           device: DeviceOption = "", quiet: QuietOption = False):
    """Draw a surface or a scan into a picture."""
    import clsurf

    from .device import Profile
    from .render.renderer import checked_channels, checked_lod, checked_size
    # Every option is checked before the work.
    steps, picture_size, t_mdl = Steps(quiet), checked_size(parsed_size(size)), parsed_error(error)
    wanted = checked_channels(filter(None, channels.split(",")))
    checked_out(out, PICTURES)
    if out.suffix.lower() != ".exr" and "color" not in wanted:
        raise InputError(f"channels: expected color among them for a {out.suffix} picture, got {channels}: add it, or "
                         "write .exr")
    toward, upward = parsed_vector("direction", direction), parsed_vector("up", up)
    if not 0 < fov < 180:
        raise InputError(f"fov: expected degrees between 0 and 180, got {fov:g}")
    looks, lod = clsurf.Shading(look=shading), checked_lod(lod)
    chosen = clsurf.open_device(device or None)
    with steps.step("load"):
        thing = clsurf.load(source)
    steps.say(f"  {thing}")
    if isinstance(thing, clsurf.Mesh | clsurf.PointCloud):
        with steps.step("build"):
            thing = clsurf.build_slim(thing, degree=degree, error=t_mdl, device=chosen, progress=steps.progress)
        steps.say(f"  {thing}")
    camera = clsurf.Camera.framing(thing, toward, fov, upward, aspect=picture_size[0] / picture_size[1])
    chosen.profile = Profile() if profile else None
    with steps.step("draw"):
        frame = clsurf.render(thing, camera, picture_size, wanted, looks, lod, device=chosen)
    if profile:
        print(chosen.profile)
        chosen.profile = None
    with steps.step("write"):
        frame.save(out)
    steps.say(f"picture: {out.resolve()}")


@app.command()
def bench(job: Annotated[str, typer.Argument(help="build, tiles, normals, or compare")],
          files: Annotated[list[Path] | None, typer.Argument(help="compare: two JSON files.")] = None,
          json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
          quick: Annotated[bool, typer.Option(help="A small generated scene, a few seconds.")] = False,
          profile: Annotated[bool, typer.Option(help="Print the time of every kernel.")] = False,
          device: DeviceOption = ""):
    """Measure clsurf on this machine: check the answer, then print figures."""
    package = bench_package()
    if job == "compare":
        if len(files or ()) != 2:
            raise InputError("bench compare: expected two JSON files")
        package.compare_files(*files)
        return
    package.run(job, device=device or None, json_path=json, quick=quick, profile=profile)


def bench_package():
    """Return the benchmarks: inside an installed package, beside it in a checkout."""
    import importlib.util
    here = Path(__file__).resolve().parent
    for folder in (here / "bench", here.parent / "bench"):
        if (folder / "views.py").exists():
            spec = importlib.util.spec_from_file_location("clsurf_bench", folder / "__init__.py",
                                                          submodule_search_locations=[str(folder)])
            module = importlib.util.module_from_spec(spec)
            sys.modules["clsurf_bench"] = module
            spec.loader.exec_module(module)
            return module
    raise InputError(f"bench: expected a folder 'bench' in or beside {here}, found none: reinstall clsurf")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code: 0, 1 (the doctor found a lack), 2 (bad input), 130 (Ctrl-C)."""
    import logging

    from rich.logging import RichHandler
    if sys.stderr is None:  # closed by the caller: nothing can be said to it
        sys.stderr = open(os.devnull, "w")
    quiet = any(a in ("-q", "--quiet") for a in (sys.argv[1:] if arguments is None else arguments))
    handler = RichHandler(show_time=False, show_path=False, show_level=False) if sys.stderr.isatty() \
        else logging.StreamHandler()
    logger = logging.getLogger("clsurf")
    logger.addHandler(handler)
    logger.setLevel(logging.ERROR if quiet else logging.INFO)
    try:
        # The option parser turns Ctrl-C and an exit asked for into a code that it returns.
        code = app(arguments, standalone_mode=False) or 0
        if code == 130:
            print("clsurf: stopped", file=sys.stderr)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except Error as error:
        print(f"clsurf: {error}", file=sys.stderr)
        return 2
    except (typer.Abort, KeyboardInterrupt):
        print("clsurf: stopped", file=sys.stderr)
        return 130
    except typer.Exit as leave:
        return leave.exit_code
    except (BrokenPipeError, SystemExit):
        # The reader of our output has gone (the option parser turns that into an exit); nothing more can be said to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except MemoryError:
        print("clsurf: not enough memory: use a smaller scan or picture", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"clsurf: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return 2
    except Exception as error:
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # a usage error of the option parser
            if error.format_message():  # empty where the help was printed instead
                print(f"clsurf: {error.format_message()} (clsurf --help)", file=sys.stderr)
            return 2
        raise
    finally:
        logger.removeHandler(handler)


if __name__ == "__main__":
    sys.exit(main())
