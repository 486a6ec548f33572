"""Where the viewer is shown: a window, a notebook, a browser, a terminal, or nowhere, all through rendercanvas."""

import contextlib
import importlib
import logging
import os
import secrets
import signal
import sys

from ..errors import InputError
from .viewer import Viewer

BACKENDS = ("auto", "window", "notebook", "browser", "terminal", "offscreen")
# Of each: rendercanvas's module, and what else it needs.
MODULES = {"window": ("glfw", ("glfw", "wgpu")), "notebook": ("anywidget", ("anywidget", "simplejpeg")),
           "browser": ("http", ("uvicorn", "websockets", "simplejpeg")), "terminal": ("terminal", ("blessed",)),
           "offscreen": ("offscreen", ())}
FASTEST = 200.0  # pictures a second that a canvas asks for: at 60 its waiting costs a browser a fifth of its pictures


def view(scene, camera=None, backend: str = "auto", size: tuple[int, int] = (1024, 768), up=(0, 1, 0),
         host: str = "127.0.0.1", port: int = 0, folder=".", device=None, report=None, scans=None,
         shows: str = "surface", **options):
    """Look at a scene interactively.

    Parameters
    ----------
    scene : Scene, surface, placed surface, or list of those
    camera : Camera, optional
        By default one that frames the scene.
    backend : str
        "window", "notebook", "browser", "terminal", "offscreen"; "auto": the notebook where there is one, else a window
        where there is a display, else the browser.
    size : (int, int)
        Of the window or widget, in its own pixels.
    up : (3,)
        What orbiting keeps upright, world space.
    host, port : str, int
        Browser: where it is served, by default to this machine alone at a free port. Wider, such as "0.0.0.0", whoever
        has the URL, which holds a token, can look and steer.
    folder : path-like
        Where screenshots go.
    device : optional
        See `clsurf.open_device`.
    report : callable, optional
        Called with lines worth telling (the URL, distances, screenshots); by default they are printed, or in a notebook
        only shown in the picture.
    scans : Mesh, PointCloud, RangeScan, placed, or list of those or None, optional
        What each of the surfaces was made from: the key t shows the scan as it is, or both.
    shows : str
        What is shown at first: "surface", "scan" or "both".
    options
        Of `Renderer.render`, such as shading, points, background; `budget`: bytes for each `StoredSurface`.

    Returns
    -------
    Viewer or canvas
        In a notebook and offscreen, at once: a canvas of rendercanvas with the attribute `viewer`; a notebook shows it
        as the value of its cell. Otherwise, once the user has left: the `Viewer`, with its last `camera` and
        `distance`.

    Raises
    ------
    InputError
        A scene, option or backend that cannot be used, or one that is not installed.
    """
    chosen = chosen_backend(backend)
    module = backend_module(chosen)
    if report is None:
        report = (lambda line: None) if chosen in ("notebook", "offscreen", "terminal") else _tell
    viewer = Viewer(scene, camera, size, up, folder, device, report, scans=scans, shows=shows, **options)
    # Its word on Ctrl-C is none of the user's business.
    logging.getLogger("rendercanvas").setLevel(logging.ERROR)
    try:
        if chosen in ("notebook", "offscreen"):
            # Offscreen there is no loop: every picture is the full one, then the fine one, as it is asked for.
            loop = module.loop if chosen == "notebook" else None
            return attached(viewer, _canvas_class(chosen, module)(size=size, max_fps=FASTEST), loop)
        if chosen == "browser":
            _browser(viewer, module, size, host, port)
        elif chosen == "window":
            _window(viewer, module, size)
        else:
            attached(viewer, module.RenderCanvas(title="clsurf", max_fps=20), module.loop)
            _run(module.loop)
    except BaseException:
        viewer.close()
        raise
    viewer.close()
    return viewer


def chosen_backend(backend: str) -> str:
    """Return which backend "auto" means here; another name as it is, or raise InputError."""
    if backend not in BACKENDS:
        raise InputError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    if backend != "auto":
        return backend
    if _in_notebook():
        return "notebook"
    display = sys.platform in ("win32", "darwin") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if display and not os.environ.get("SSH_CONNECTION"):
        try:
            backend_module("window")
            return "window"
        except InputError:
            pass
    return "browser"


def backend_module(backend: str):
    """Return rendercanvas's module of a backend, or raise InputError that says what to install."""
    name, needs = MODULES[backend]
    try:
        for need in needs:
            importlib.import_module(need)
        return importlib.import_module(f"rendercanvas.{name}")
    except ImportError as error:
        lacks = (error.name or "rendercanvas").split(".")[0]
        raise InputError(f"backend {backend}: {lacks} is not installed: pip install 'clsurf[view]'") from None
    except Exception as error:  # such as glfw without its library
        raise InputError(f"backend {backend}: cannot be used here: {' '.join(str(error).split())[:150]}: "
                         "try another, such as browser") from None


def attached(viewer: Viewer, canvas, loop, leave=None):
    """Connect a viewer with a canvas of rendercanvas, and return it; `leave` is called where the user asks to."""
    context = canvas.get_context("bitmap")
    waiting, left = [], []  # whether a refinement is on its way, and whether the user has been let go

    def draw():
        if viewer.closed:
            return
        width, height = canvas.get_physical_size()
        if (width, height) != viewer.size and min(width, height) > 0:
            ratio = canvas.get_pixel_ratio()
            viewer.handle({"event_type": "resize", "width": width / ratio, "height": height / ratio,
                           "pixel_ratio": ratio})
        context.set_bitmap(viewer.draw())
        refine()

    def refine():
        seconds = viewer.due()
        if seconds is None or waiting or loop is None or canvas.get_closed():
            return
        waiting.append(True)

        def again():
            waiting.clear()
            rest = viewer.due()
            if rest is not None and rest > 0:  # it has moved meanwhile
                refine()
            elif rest is not None and not canvas.get_closed():
                canvas.request_draw()
        # At once would leave events no time; later ones are then asked for by the next picture.
        loop.call_later(max(seconds, 0.01), again)

    @canvas.add_event_handler("pointer_down", "pointer_move", "pointer_up", "wheel", "key_down", "resize", "close")
    def handle(event):
        if not viewer.closed and viewer.handle(event):
            canvas.request_draw()
        if viewer.closed and not left:
            left.append(True)  # closing tells of it again
            (leave or canvas.close)()
    canvas.request_draw(draw)
    canvas.viewer = viewer
    return canvas


def _canvas_class(backend: str, module):
    if backend == "offscreen":
        class OffscreenCanvas(module.RenderCanvas):
            """A canvas whose pictures know of the events before them."""

            def draw(self):
                self._process_events()  # no loop does
                return super().draw()
        return OffscreenCanvas

    class NotebookCanvas(module.RenderCanvas):
        """A widget that leaves a still picture where widgets are not shown: in a saved or exported notebook."""

        viewer = None

        def _repr_mimebundle_(self, **kwargs):
            from ..io.images import png_bytes
            bundle = super()._repr_mimebundle_(**kwargs)
            if bundle is None or self.viewer is None or self.viewer.closed:
                return bundle
            data, metadata = bundle if isinstance(bundle, tuple) else (bundle, {})
            from base64 import b64encode
            picture = png_bytes(self.viewer.still()[..., :3])
            return {**data, "image/png": b64encode(picture).decode()}, metadata
    return NotebookCanvas


def _window(viewer: Viewer, module, size) -> None:
    try:
        canvas = attached(viewer, module.RenderCanvas(size=size, title="clsurf", max_fps=FASTEST), module.loop)
    except Exception as error:
        raise InputError(f"backend window: cannot be opened: {' '.join(str(error).split())[:150]}: "
                         "try --backend browser") from None
    _run(module.loop)
    canvas.close()


def _run(loop) -> None:
    """Run a loop until the user leaves, by Ctrl-C and by a closed terminal too."""
    before = None
    with contextlib.suppress(ValueError, AttributeError):  # not the main thread, Windows
        before = signal.signal(signal.SIGHUP, lambda *_: loop.stop())
    try:
        loop.run()
    finally:
        if before is not None:
            signal.signal(signal.SIGHUP, before)


def _browser(viewer: Viewer, module, size, host: str, port: int) -> None:
    from . import server
    listener, token = server.listening(host, port), secrets.token_urlsafe(24)
    loopback = server.is_loopback(host)
    url = server.address(listener, host, token)
    stops = []
    # Made before the server's loop: rendercanvas starts its tasks once that runs.
    canvas = attached(viewer, module.RenderCanvas(size=size, title="clsurf", max_fps=FASTEST), module.loop,
                      lambda: [stop() for stop in stops])
    viewer.prepare()

    def ready(stop):
        stops.append(stop)
        viewer.report(f"open {url}")
        if not loopback:
            viewer.report("whoever has this URL can look and steer, over a connection that is not encrypted")
        if _has_display():
            import webbrowser
            webbrowser.open(url)
    try:
        server.serve(listener, token, loopback, ready)
    finally:
        canvas.close()


def _has_display() -> bool:
    return bool(sys.platform in ("win32", "darwin") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _in_notebook() -> bool:
    """Whether this runs in a Jupyter kernel or another notebook that shows widgets."""
    if "marimo" in sys.modules and sys.modules["marimo"].running_in_notebook():
        return True
    shell = sys.modules.get("IPython")
    shell = shell.get_ipython() if shell is not None else None
    return shell is not None and hasattr(shell, "kernel")


def _tell(line: str) -> None:
    print(line, flush=True)
