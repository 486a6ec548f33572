"""Shared fixtures: the device under test, and the real scans."""

import os
from pathlib import Path

import pytest

from bench.answer_scenes import forms
from clsurf.device import open_device
from clsurf.render.renderer import Renderer
from clsurf.render.tiles import Scratch
from clsurf.trace.single import has_doubles

_without_data: list[str] = []


@pytest.fixture(scope="session", autouse=True)
def _own_caches(tmp_path_factory):
    """Give every pytest-xdist worker its own PoCL cache: concurrent workers break a shared one."""
    if os.environ.get("PYTEST_XDIST_WORKER") and "POCL_CACHE_DIR" not in os.environ:
        os.environ["POCL_CACHE_DIR"] = str(tmp_path_factory.mktemp("pocl-cache"))


@pytest.fixture(scope="session")
def device():
    """The device under test: CLSURF_DEVICE, else PoCL. No device is a failure, not a skip."""
    return open_device(os.environ.get("CLSURF_DEVICE") or "pocl")


def pytest_collection_modifyitems(config, items):
    """What a device has not is left out: kernels in float64, and of several lanes where it works on single items.

    Nobody gets those kernels there (clsurf/trace/single.py, clsurf/device).
    """
    doubles = [item for item in items if item.get_closest_marker("float64")]
    if doubles and not has_doubles(open_device(os.environ.get("CLSURF_DEVICE") or "pocl")):
        config.hook.pytest_deselected(items=doubles)
        items[:] = [item for item in items if item not in set(doubles)]
    asked = [(item, item.callspec.params.get(name)) for item in items if hasattr(item, "callspec")
             for name in ("lanes", "form", "either_form")]
    wide = {item: lanes for item, lanes in asked if lanes in (4, 8, 16)}
    if not wide:
        return
    most = max(forms(open_device(os.environ.get("CLSURF_DEVICE") or "pocl")))
    left_out = [item for item, lanes in wide.items() if lanes > most]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


@pytest.fixture(scope="session", autouse=True)
def _no_wider_pictures():
    """On such a device tests that draw in several forms draw in its own each time."""
    if "CLSURF_DEVICE" not in os.environ or (most := max(forms(open_device(os.environ["CLSURF_DEVICE"])))) == 16:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        for kind in (Renderer, Scratch):
            def narrowed(self, device=None, lanes=None, *rest, made=kind.__init__, **options):
                made(self, device, most if lanes in (4, 8, 16) else lanes, *rest, **options)
            patch.setattr(kind, "__init__", narrowed)
        yield


@pytest.fixture(params=[16, 8, 4, 1])
def lanes(request, device, monkeypatch):
    """Both kernel forms, and narrower vectors."""
    monkeypatch.setattr(device, "lanes", request.param)
    return request.param


@pytest.fixture
def largest_buffer(device, monkeypatch):
    """Return a function that limits the bytes of a buffer: a larger one is an error, as on a device of this limit."""
    limits = []

    def checked(array):
        assert not limits or array.nbytes <= limits[-1], f"a buffer of {array} where {limits[-1]:,} bytes are the most"
        return array

    def limit(nbytes: int):
        limits.append(nbytes)
        monkeypatch.setattr(device, "largest_buffer_bytes", nbytes)

    for name in ("empty", "upload"):
        made = getattr(device, name)
        monkeypatch.setattr(device, name, lambda *a, made=made, **options: checked(made(*a, **options)))
    return limit


@pytest.fixture(scope="module")
def renderers(device):
    """Renderers in both kernel forms, and one of small tiles."""
    first = forms(device)[0]
    with Renderer(device, lanes=first) as lanes, Renderer(device, lanes=1) as items, Renderer(device, tile=8) as small:
        yield lanes, items, small


def data_folder() -> Path:
    """Return the folder of real scans: CLSURF_DATA, else `shared/data` beside the checkout."""
    named = os.environ.get("CLSURF_DATA")
    return Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"


def scan_path(name: str) -> Path:
    """Return the path of a real scan; where the data is missing, the test is skipped and counted in the last line."""
    path = data_folder() / name
    if not path.exists():
        _without_data.append(name)
        pytest.skip(f"needs the scan {name}: set CLSURF_DATA")
    return path


def pytest_terminal_summary(terminalreporter):
    """Say how many tests lacked their scan; nothing is skipped silently."""
    skipped = terminalreporter.stats.get("skipped", [])
    count = sum("needs the scan" in str(report.longrepr) for report in skipped)
    if count:
        terminalreporter.write_line(f"{count} tests not run: their scans are missing (CLSURF_DATA names the folder)")
