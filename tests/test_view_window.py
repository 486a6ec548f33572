"""The viewer in a window: on a screen that no one sees, under a pointer and keys that no one holds; how it closes."""

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import ImageGrab
from reference.surfaces import sphere

import clsurf

SIZE = (320, 240)
PATIENCE = 180.0  # seconds: a software driver compiles its shaders first


def wait_for(condition):
    """Return what the condition gives once it is something."""
    end = time.monotonic() + PATIENCE
    while True:
        found = condition()
        if found is not None and found is not False:
            return found
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.2)


class Screen:
    """An X server without hardware; a context manager."""

    def __init__(self):
        self.server = subprocess.Popen(["Xvfb", "-displayfd", "1", "-screen", "0", "640x480x24", "-nolisten", "tcp"],
                                       stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.name = ":" + self.server.stdout.readline().strip()
        self.environment = {**os.environ, "DISPLAY": self.name}
        self.environment.pop("WAYLAND_DISPLAY", None)

    def picture(self):
        """Return what is shown, (h, w, 3) uint8."""
        return np.asarray(ImageGrab.grab(xdisplay=self.name).convert("RGB"))

    def still(self):
        """Return what is shown once it no longer changes, and is more than a blank window."""
        seen = [self.picture()]

        def same():
            time.sleep(0.5)
            seen.append(self.picture())
            return (seen[-1] == seen[-2]).all() and len(np.unique(seen[-1].reshape(-1, 3), axis=0)) > 20
        wait_for(same)
        return seen[-1]

    def changed(self, before):
        """Return what is shown once it differs from `before`, and no longer changes."""
        wait_for(lambda: bool((self.picture() != before).any(axis=2).mean() > 0.005))
        return self.still()

    def does(self, *arguments) -> list[str]:
        """Have the pointer and the keys do something; return the words that are said of it."""
        done = subprocess.run(["xdotool", *map(str, arguments)], env=self.environment, capture_output=True, text=True)
        return done.stdout.split()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.server.terminate()
        self.server.wait(timeout=30)


@pytest.fixture
def screen():
    if shutil.which("Xvfb") is None or shutil.which("xdotool") is None:  # as with the browser
        (pytest.fail if os.environ.get("CI") else pytest.skip)(
            "needs a screen: apt-get install xvfb xdotool mesa-vulkan-drivers")
    with Screen() as screen:
        yield screen


@pytest.fixture
def shown(screen, tmp_path, device):
    """A running `clsurf view` in a window of the screen."""
    clsurf.save(sphere(300), tmp_path / "ball.clsurf")
    name = "intel" if "Intel" in device.platform_name else "pocl"
    process = subprocess.Popen([sys.executable, "-m", "clsurf", "view", str(tmp_path / "ball.clsurf"), "--device", name,
                                "--backend", "window", "--size", "320x240", "-q"], env=screen.environment,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def window():
        if process.poll() is not None:
            pytest.fail(process.stderr.read())
        return screen.does("search", "--name", "^clsurf$") or None
    try:
        number, = wait_for(window)
        yield SimpleNamespace(screen=screen, process=process, window=int(number))
    finally:
        process.kill()
        process.communicate()


def press_close_button(display: str, window: int) -> None:
    """Tell a window what a window manager tells it when its close button is pressed."""
    x11 = ctypes.CDLL("libX11.so.6")
    for name, result, arguments in (("XOpenDisplay", ctypes.c_void_p, [ctypes.c_char_p]),
                                    ("XInternAtom", ctypes.c_ulong, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int]),
                                    ("XSendEvent", ctypes.c_int, [ctypes.c_void_p, ctypes.c_ulong, ctypes.c_int,
                                                                  ctypes.c_long, ctypes.c_void_p]),
                                    ("XCloseDisplay", ctypes.c_int, [ctypes.c_void_p])):
        getattr(x11, name).restype, getattr(x11, name).argtypes = result, arguments

    class Message(ctypes.Structure):  # XClientMessageEvent, padded to an XEvent
        _fields_ = [("kind", ctypes.c_int), ("serial", ctypes.c_ulong), ("sent", ctypes.c_int),
                    ("display", ctypes.c_void_p), ("window", ctypes.c_ulong), ("message", ctypes.c_ulong),
                    ("format", ctypes.c_int), ("data", ctypes.c_long * 5), ("rest", ctypes.c_long * 24)]
    opened = x11.XOpenDisplay(display.encode())
    protocols, delete = (x11.XInternAtom(opened, name, 0) for name in (b"WM_PROTOCOLS", b"WM_DELETE_WINDOW"))
    message = Message(33, 0, 1, opened, window, protocols, 32, (ctypes.c_long * 5)(delete))
    assert x11.XSendEvent(opened, window, 0, 0, ctypes.byref(message))
    x11.XCloseDisplay(opened)


def test_pointer_and_keys_in_a_window_and_its_close_button(shown):
    """Orbit, dolly, pan, channel and size change what the screen shows; then the window is closed: exit code 0."""
    screen = shown.screen
    picture = screen.still()
    window = picture[:SIZE[1], :SIZE[0]]
    assert (window[2, 2] == 255).all() and 0.2 < (window < 250).any(axis=2).mean() < 0.8
    screen.does("mousemove", 160, 120, "mousedown", 3, "mousemove", 175, 130, "mousemove", 190, 140, "mouseup", 3)
    panned = screen.changed(picture)
    screen.does("click", 4, "click", 4, "click", 4)
    nearer = screen.changed(panned)
    assert (nearer < 250).any(axis=2)[:240, :320].sum() > (panned < 250).any(axis=2)[:240, :320].sum()
    screen.does("key", "c")
    colored = screen.changed(nearer).astype(int)
    assert (colored.max(axis=2) - colored.min(axis=2)).max() > 100  # normals as colours
    screen.does("mousemove", 160, 120, "mousedown", 1, "mousemove", 190, 120, "mousemove", 220, 150, "mouseup", 1)
    screen.does("key", "z")  # through the middle: the inside, and the orbit, are seen
    cut = screen.changed(colored.astype(np.uint8))
    screen.does("windowsize", shown.window, 500, 400)
    larger = screen.changed(cut)
    assert (larger[390, 10] == 255).all() and (cut[390, 10] == 0).all()
    press_close_button(screen.name, shown.window)
    assert shown.process.wait(timeout=60) == 0
    assert "Traceback" not in shown.process.stderr.read()


@pytest.mark.parametrize("how", ["Ctrl-C", "closed terminal", "q"])
def test_it_ends_cleanly(shown, how):
    shown.screen.still()
    if how == "q":
        shown.screen.does("mousemove", 160, 120, "key", "q")
    else:
        shown.process.send_signal(signal.SIGINT if how == "Ctrl-C" else signal.SIGHUP)
    assert shown.process.wait(timeout=60) == 0
    assert "Traceback" not in shown.process.stderr.read()
