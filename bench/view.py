"""The job `view`: pictures a second that the viewer shows while a surface is turned, at 800x600.

The answer is checked first: what a browser shows of the still surface is the viewer's own picture. Then the time of a
moving picture alone (drawn and turned into bytes, and with its JPEG), and pictures that a headless browser has loaded
in a few seconds of dragging: events there, drawing, encoding, and the browser's decoding share the machine.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from clsurf.errors import InputError
from clsurf.io.dispatch import save
from clsurf.view.canvas import backend_module
from clsurf.view.viewer import Viewer

from . import record, scenes
from .build import WrongAnswer, built
from .chromium import Browser, browser_path, wait_for
from .table import print_table

FLOOR, AIM = 15.0, 30.0  # pictures a second
SIZE = (800, 600)
SECONDS = 4.0  # of dragging


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of the viewer; `device` is an opened one."""
    figures = {}
    for name in scenes.chosen(("bunny", "dragon"), quick):
        surface = built(scenes.scene(name), 2, device)
        figures[name] = drawn(surface, device, 20 if quick else 100)
        figures[name] |= in_a_browser(surface, device, SECONDS / 4 if quick else SECONDS)
    show(figures)
    return figures


def drawn(surface, device, count: int) -> dict:
    """Return the time of moving pictures, and of their JPEG."""
    encode = None
    try:
        backend_module("browser")
        from rendercanvas.core.encoders import encode_array
        encode = encode_array
    except InputError:
        pass
    pictures, jpegs, sizes = [], [], []
    with Viewer(surface, size=SIZE, device=device) as viewer:
        viewer.prepare()
        for _ in range(count):
            viewer.handle({"event_type": "key_down", "key": "ArrowLeft"})
            start = time.perf_counter()
            pixels = viewer.draw()
            pictures.append(time.perf_counter() - start)
            sizes.append(pixels.shape[1])
            if encode is not None:
                start = time.perf_counter()
                encode(pixels, 80)
                jpegs.append(time.perf_counter() - start)
    found = {"picture": record.timing(pictures[count // 5:]), "width_px": int(np.median(sizes))}
    return found | ({"jpeg": record.timing(jpegs[count // 5:])} if jpegs else {})


def in_a_browser(surface, device, seconds: float) -> dict:
    """Return the pictures a second that a headless browser loads while the surface is dragged; nothing without one."""
    if browser_path() is None:
        return {}
    try:
        backend_module("browser")
    except InputError:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "surface.clsurf"
        save(surface, path)
        process = subprocess.Popen([sys.executable, "-m", "clsurf", "view", str(path), "--backend", "browser",
                                    "--quiet", "--device", _name(device)], stdout=subprocess.PIPE, text=True)
        try:
            line = process.stdout.readline()
            if not line.startswith("open "):
                raise WrongAnswer(f"bench view: expected the viewer's URL, got {line!r}")
            with Browser(Path(folder) / "profile", *SIZE) as browser:
                browser.open(line.split()[1])
                wait_for(lambda: browser.value("document.images.length && document.images[0].naturalWidth") == SIZE[0],
                         120)
                time.sleep(1.5)  # the fine picture
                _check(browser.picture(), surface, device)
                return _dragged(browser, seconds)
        finally:
            process.terminate()
            process.communicate(timeout=30)


def _name(device) -> str:
    """Return a name that another process finds the device by."""
    for word, name in (("Intel", "intel"), ("Portable", "pocl")):
        if word in device.platform_name:
            return name
    return device.name


def _check(picture, surface, device) -> None:
    """Raise WrongAnswer unless the browser shows the viewer's picture, but for words at the bottom."""
    with Viewer(surface, size=SIZE, device=device) as viewer:
        wanted = viewer.still()[:540, :, :3].astype(int)
    off = np.abs(picture[:540].astype(int) - wanted).max(axis=2)
    if (off > 24).mean() > 0.005:
        raise WrongAnswer(f"bench view: expected the viewer's picture in the browser, {(off > 24).mean():.2%} of its "
                          "pixels differ")


def _dragged(browser, seconds: float) -> dict:
    browser.value("window.loads = []; document.images[0].addEventListener('load', () => "
                  "loads.push([performance.now(), document.images[0].naturalWidth])); 0")
    browser.mouse("mousePressed", 200, 300)
    start, moves = time.perf_counter(), 0
    while (now := time.perf_counter() - start) < seconds:
        browser.mouse("mouseMoved", 400 + 200 * np.sin(2 * now), 300 + 60 * np.sin(3 * now))
        moves += 1
        time.sleep(max(0.0, moves / 60 - (time.perf_counter() - start)))
    loads = np.array(browser.value("loads"))
    browser.mouse("mouseReleased", 200, 300)
    gaps = np.diff(loads[:, 0]) / 1000
    return {"browser_fps": len(gaps) / gaps.sum(), "browser_gap": record.timing(gaps),
            "browser_width_px": int(np.median(loads[:, 1])), "moves_a_second": moves / seconds}


def show(figures: dict) -> None:
    """Print the figures."""
    print(f"a moving picture of {SIZE[0]}x{SIZE[1]} (a second; floor {FLOOR:g}, aim {AIM:g}, end to end to a headless "
          "browser on the same machine)")
    rows = []
    for name, f in figures.items():
        jpeg = f"{1e3 * f['jpeg']['median_s']:.1f}" if "jpeg" in f else "-"
        browser = f"{f['browser_fps']:.1f} ({f['browser_width_px']} px wide)" if "browser_fps" in f else "no browser"
        rows.append((name, f"{1e3 * f['picture']['median_s']:.1f}", f"{1 / f['picture']['median_s']:.0f}",
                     f"{f['width_px']}", jpeg, browser))
    print_table(("surface", "drawn, ms", "a second", "width, px", "JPEG, ms", "browser, a second"), rows)
