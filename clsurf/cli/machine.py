"""Commands about this machine: `devices`, `doctor`, `bench`."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from ..errors import Error, InputError
from .common import DeviceOption, ProfileOption, QuietOption


def devices(quiet: QuietOption = False):
    """List the OpenCL devices, the default one marked."""
    from ..device import all_devices, choose_device, open_device
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


def doctor(quiet: QuietOption = False):
    """Say what was found, what is missing, and the one command that mends it."""
    from ..device.doctor import examine
    findings = examine()
    for finding in findings:
        if quiet and finding.good:
            continue
        print(f"{'ok     ' if finding.good else 'MISSING'}  {finding.name}: {finding.detail}")
        if finding.mend:
            print(f"         {'mend' if not finding.good else 'add'} it: {finding.mend}")
    if not all(finding.good for finding in findings):
        raise typer.Exit(1)


def bench(job: Annotated[str, typer.Argument(help="build, tiles, normals, patches, or compare")],
          files: Annotated[list[Path] | None, typer.Argument(help="compare: two JSON files.")] = None,
          json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
          quick: Annotated[bool, typer.Option(help="A small generated scene, a few seconds.")] = False,
          profile: ProfileOption = False,
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
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "bench", here.parent / "bench"):
        if (folder / "views.py").exists():
            spec = importlib.util.spec_from_file_location("clsurf_bench", folder / "__init__.py",
                                                          submodule_search_locations=[str(folder)])
            module = importlib.util.module_from_spec(spec)
            sys.modules["clsurf_bench"] = module
            spec.loader.exec_module(module)
            return module
    raise InputError(f"bench: expected a folder 'bench' in or beside {here}, found none: reinstall clsurf")
