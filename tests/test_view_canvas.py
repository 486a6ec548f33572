"""The viewer on rendercanvas's canvases: offscreen, in an executed notebook, in a terminal; which one is chosen."""

import base64
import fcntl
import io
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import time

import numpy as np
import pytest
from PIL import Image
from reference.surfaces import sphere

import clsurf
from clsurf.cli import main
from clsurf.errors import InputError
from clsurf.view import canvas as canvases


@pytest.fixture
def ball(tmp_path, monkeypatch, device):
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    clsurf.save(sphere(300), tmp_path / "ball.clsurf")
    return tmp_path / "ball.clsurf"


def test_offscreen(device):
    """Events reach the viewer through the canvas, and its pictures come back."""
    canvas = clsurf.view(sphere(300), backend="offscreen", size=(80, 60), device=device)
    first = np.array(canvas.draw())
    assert first.shape == (60, 80, 4) and (first != 255).any()
    canvas.submit_event({"event_type": "pointer_down", "x": 30, "y": 30, "button": 1})
    canvas.submit_event({"event_type": "pointer_move", "x": 50, "y": 30, "buttons": (1,)})
    canvas.submit_event({"event_type": "pointer_up", "x": 50, "y": 30, "button": 1})
    canvas.submit_event({"event_type": "key_down", "key": "c"})
    second = np.array(canvas.draw())
    assert canvas.viewer.state.channel == "normal" and (first != second).mean() > 0.1
    assert abs(canvas.viewer.camera.eye - canvas.viewer.home.camera.eye).max() > 0.1
    canvas.set_logical_size(40, 30)
    assert np.asarray(canvas.draw()).shape == (30, 40, 4)
    canvas.submit_event({"event_type": "key_down", "key": "q"})
    canvas.draw()
    assert canvas.get_closed() and canvas.viewer.closed
    canvas.viewer.close()


NOTEBOOK = """import clsurf
surface = clsurf.load({path!r})
canvas = clsurf.view(surface, size=(120, 90), device={device!r})
canvas
---
before = canvas.viewer.camera.eye.copy()
for event in ({{"type": "pointer_down", "x": 30, "y": 30, "button": 1, "buttons": [1], "modifiers": []}},
              {{"type": "pointer_move", "x": 60, "y": 30, "button": 1, "buttons": [1], "modifiers": []}},
              {{"type": "pointer_up", "x": 60, "y": 30, "button": 1, "buttons": [], "modifiers": []}}):
    canvas._rfb_handle_msg(canvas, {{**event, "timestamp": 0}}, [])
canvas.snapshot()
import asyncio
for _ in range(100):
    if canvas.viewer.times: break
    await asyncio.sleep(0.05)
---
print(canvas.viewer.size, abs(canvas.viewer.camera.eye - before).max() > 0.01, canvas._rfb_frame_index)
"""


def test_an_executed_notebook(ball, device, monkeypatch):
    """The cell's value is a widget, with a picture for where widgets are not shown; events from the page turn it, and
    its pictures go out."""
    import nbclient
    import nbformat
    cells = NOTEBOOK.format(path=str(ball), device=os.environ["CLSURF_DEVICE"]).split("---\n")
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    value = next(o for o in notebook.cells[0].outputs if o.output_type == "execute_result")
    assert "application/vnd.jupyter.widget-view+json" in value.data
    still = np.asarray(Image.open(io.BytesIO(base64.b64decode(value.data["image/png"]))))
    assert still.shape[:2] == (90, 120) and 0.2 < (still[..., 0] < 250).mean() < 0.8
    said = "".join(o.text for o in notebook.cells[2].outputs if o.output_type == "stream")
    size, turned, frames = said.rsplit(" ", 2)
    assert size == "(120, 90)" and turned == "True" and int(frames) >= 1
    assert any("<img src='data:image" in str(o.get("data", "")) for o in notebook.cells[1].outputs)


def test_a_terminal(ball):
    """In a pseudo-terminal: colours come, q ends it, and the terminal gets its own screen back."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ |= {"TERM": "xterm-256color", "COLORTERM": "truecolor", "LINES": "24", "COLUMNS": "60"}
        os.execv(sys.executable, [sys.executable, "-m", "clsurf", "view", str(ball), "--backend", "terminal", "-q"])
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 60, 0, 0))
    said, start, quits = b"", time.monotonic(), 0
    while time.monotonic() - start < 240:
        if select.select([terminal], [], [], 0.3)[0]:
            try:
                data = os.read(terminal, 65536)
            except OSError:
                break
            if not data:
                break
            said += data
        if said.count("▄".encode()) > 200 and time.monotonic() - start > 2 + 3 * quits:
            os.write(terminal, b"q")
            quits += 1
    else:
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(status) == 0, said[-2000:]
    assert b"\x1b[?1049h" in said and b"\x1b[?1049l" in said and b"\x1b[38;2;" in said
    assert b"Traceback" not in said


@pytest.mark.parametrize(("display", "ssh", "chosen"), [("", "", "browser"), (":0", "1 2 3 4", "browser")])
def test_without_a_display_the_browser_is_chosen(display, ssh, chosen, monkeypatch):
    if sys.platform not in ("win32", "darwin"):
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        monkeypatch.setenv("DISPLAY", display)
        monkeypatch.setenv("SSH_CONNECTION", ssh)
        assert canvases.chosen_backend("auto") == chosen
    assert canvases.chosen_backend("terminal") == "terminal"


def test_a_missing_package_names_the_extra(monkeypatch, device):
    monkeypatch.setitem(sys.modules, "rendercanvas.offscreen", None)
    with pytest.raises(InputError, match=r"clsurf\[view\]") as caught:
        clsurf.view(sphere(50), backend="offscreen", device=device)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="backend: expected one of"):
        clsurf.view(sphere(50), backend="hologram", device=device)


@pytest.mark.parametrize(("options", "says"), [
    (["--backend", "hologram"], "backend"), (["--backend", "offscreen"], "backend"), (["--folder", "gone"], "gone"),
    (["--camera", "a.json", "--eye", "1,2,3"], "got both"), (["--camera", "gone.json"], "gone.json"),
    (["--size", "big"], "size"), (["--port", "70000"], "port"), (["--host", "no.such.name.invalid"], "no.such.name"),
    (["--host", "203.0.113.7"], "203.0.113.7")])
def test_mistakes_are_one_line(ball, options, says, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(ball), "-q", *options]) == 2
    said = capsys.readouterr().err.strip()
    assert says in said and "\n" not in said


def test_importing_the_package_loads_no_canvas():
    code = "import clsurf, sys; print([m for m in ('rendercanvas', 'glfw', 'uvicorn', 'IPython') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
