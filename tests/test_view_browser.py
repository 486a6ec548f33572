"""The viewer in a browser: one that turns, switches and takes pictures; who the server lets in; how it ends."""

import asyncio
import http.client
import os
import signal
import subprocess
import sys
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
from conftest import scan_path
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import clsurf
from bench.chromium import Browser, browser_path, wait_for
from clsurf.io.images import read_image
from clsurf.view import server


@pytest.fixture(scope="module")
def bunny(tmp_path_factory, device):
    path = tmp_path_factory.mktemp("bunny") / "bunny.clsurf"
    clsurf.save(clsurf.build_slim(clsurf.load(scan_path("bunny/bunny.obj")), device=device), path)
    return path


def started(path, folder, device, *options):
    """Return a running `clsurf view` and its URL."""
    name = "intel" if "Intel" in device.platform_name else "pocl"
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    process = subprocess.Popen(
        [sys.executable, "-m", "clsurf", "view", str(path), "--device", name, "--folder", str(folder), *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    line = process.stdout.readline()
    assert line.startswith("open http://"), process.stderr.read() if process.poll() is not None else line
    return process, line.split()[1]


@pytest.fixture(scope="module")
def served(bunny, tmp_path_factory, device):
    folder = tmp_path_factory.mktemp("shots")
    process, url = started(bunny, folder, device)
    yield SimpleNamespace(process=process, url=url, folder=folder)
    process.kill()
    process.communicate()


def colorfulness(picture) -> float:
    """Return how far the largest and the least of red, green and blue are apart where a picture is not white."""
    shown = picture[(picture < 250).any(axis=2)].astype(int)
    return float((shown.max(axis=1) - shown.min(axis=1)).mean()) if len(shown) else 0.0


def test_the_bunny_in_a_browser(served, tmp_path):
    """Dragging orbits, a key switches the channel, another takes a screenshot; the page changes each time."""
    def changed(browser, before):
        def look():
            now = browser.picture()
            return [now] if (np.abs(now.astype(int) - before) > 30).any(axis=2).mean() > 0.02 else []
        return wait_for(look)[0]
    if browser_path() is None:  # checks of every change fail, elsewhere the test is skipped
        (pytest.fail if os.environ.get("CI") else pytest.skip)("needs a browser: apt-get install chromium")
    with Browser(tmp_path / "profile", 800, 600) as browser:
        browser.open(served.url)
        wait_for(lambda: browser.value("document.images.length && document.images[0].naturalWidth == 800"
                                       " && document.images[0].naturalHeight == 600"))
        first = browser.picture()
        assert first.shape == (600, 800, 3) and 0.2 < (first < 250).any(axis=2).mean() < 0.8
        browser.drag((400, 300), (560, 330))
        changed(browser, first)
        browser.press("c")
        wait_for(lambda: colorfulness(browser.picture()) > 40)  # normals as colours, where the surface was grey
        browser.press("s")
        shot = wait_for(lambda: list(served.folder.glob("clsurf-*.png")))[0]
        pixels = read_image(shot)
        assert pixels.shape[:2] == (600, 800)
        both = np.abs(pixels[:560, :, :3].astype(int) - browser.picture()[:560]).max(axis=2) < 60
        assert both.mean() > 0.97  # what the page shows, but for its words
        assert browser.value("document.getElementById('status').innerText").startswith("+ Connected")


# Who is let in --------------------------------------------------------------------------------------------------------


def status(url, path=None, method="GET", **headers):
    """The status of a plain request."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=20)
    connection.request(method, parts.path if path is None else path, headers=headers)
    answer = connection.getresponse()
    answer.read()
    return answer.status, answer.headers


def socket_status(url, path=None, origin=None, **headers):
    """101 where a websocket is accepted, else the refusal's status."""
    parts = urlsplit(url)
    try:
        with connect(f"ws://{parts.netloc}{parts.path if path is None else path}", origin=origin,
                     additional_headers=headers, open_timeout=20):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def test_the_page_needs_the_token(served):
    good, headers = status(served.url)
    assert good == 200 and headers["X-Frame-Options"] == "DENY" and headers["Referrer-Policy"] == "no-referrer"
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert status(served.url, urlsplit(served.url).path + "renderview.js")[0] == 200
    token = urlsplit(served.url).path.strip("/")
    assert len(token) >= 32
    for path in ("/", "/index.html", f"/{token}", f"/{token[:-1]}x/", f"/{token}/../", f"//{token}/", f"/x/{token}/"):
        assert status(served.url, path)[0] == 404, path
    for method in ("POST", "PUT", "OPTIONS"):
        assert status(served.url, method=method)[0] == 405


def test_the_connection_needs_a_page_of_this_server(served):
    parts = urlsplit(served.url)
    own = f"http://{parts.netloc}"
    assert socket_status(served.url, origin=own) == 101
    assert socket_status(served.url, origin=f"https://{parts.netloc}") == 101  # a proxy that adds TLS
    for origin in (None, "null", "http://evil.example", f"http://127.0.0.1:{parts.port + 1}", "http://127.0.0.1",
                   f"{own}.evil.example", f"file://{parts.netloc}"):
        assert socket_status(served.url, origin=origin) == 403, origin
    assert socket_status(served.url, "/", origin=own) == 403
    assert socket_status(served.url, "/nonsense/", origin=own) == 403


def test_another_name_for_this_machine_is_not_listened_to(served):
    """A page whose owner points its name at 127.0.0.1 has the right Origin, but not the right Host."""
    port = urlsplit(served.url).port
    assert status(served.url, Host=f"evil.example:{port}")[0] == 421
    assert status(served.url, Host=f"localhost:{port}")[0] == 200
    assert status(served.url, Host="localhost:9999")[0] == 200  # a tunnel's other end


def test_it_listens_to_this_machine_alone(served):
    assert urlsplit(served.url).hostname == "127.0.0.1"
    for host, loopback in (("127.0.0.1", True), ("localhost", True), ("::1", True), ("127.1.2.3", True),
                           ("0.0.0.0", False), ("::", False), ("192.168.0.7", False), ("example.org", False)):
        assert server.is_loopback(host) is loopback, host


def test_opened_wider_the_token_and_the_origin_stay(tmp_path):
    """The guard itself: any Host, but still the token and an Origin that is that Host."""
    async def asked(kind, path, **headers):
        sent = []
        async def app(scope, receive, send):
            sent.append("in")
        async def send(message):
            sent.append(message.get("status") or message["type"])
        async def receive():
            return {"type": "websocket.connect"}
        scope = {"type": kind, "path": path, "method": "GET",
                 "headers": [(k.encode(), v.encode()) for k, v in headers.items()]}
        await server.guarded(app, "secret", loopback=False)(scope, receive, send)
        return sent[0]

    def ask(*arguments, **headers):
        return asyncio.run(asked(*arguments, **headers))
    assert ask("http", "/secret/", host="scan.example:80") == "in"
    assert ask("http", "/", host="scan.example") == 404 and ask("http", "/secre/", host="scan.example") == 404
    assert ask("websocket", "/secret/", host="scan.example:80", origin="http://scan.example:80") == "in"
    for origin in ("http://evil.example", "", "http://scan.example"):
        assert ask("websocket", "/secret/", host="scan.example:80", origin=origin) == "websocket.close"
    assert ask("websocket", "/secre/", host="scan.example", origin="http://scan.example") == "websocket.close"
    assert ask("websocket", "/secret/", origin="http://") == "websocket.close"


def test_an_open_server_says_that_it_is_open(bunny, tmp_path, device):
    process, url = started(bunny, tmp_path, device, "--host", "0.0.0.0")
    try:
        assert "whoever has this URL" in process.stdout.readline()
        local = url.replace(urlsplit(url).hostname, "127.0.0.1")
        assert status(local)[0] == 200 and status(local, "/")[0] == 404
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0
    finally:
        process.kill()
        process.communicate()


# How it ends ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["Ctrl-C", "closed terminal", "q"])
def test_it_ends_cleanly(bunny, tmp_path, device, how):
    """Also with a browser connected: nothing is left listening, exit code 0, not a word of a traceback."""
    process, url = started(bunny, tmp_path, device, "--quiet")
    parts = urlsplit(url)
    try:
        with connect(f"ws://{parts.netloc}{parts.path}", origin=f"http://{parts.netloc}") as page:
            if how == "q":
                page.send('{"type": "resize", "width": 40, "height": 30, "pwidth": 40, "pheight": 30, "ratio": 1,'
                          ' "timestamp": 0}')
                page.recv(timeout=30)
                page.send('{"type": "key_down", "key": "q", "modifiers": [], "timestamp": 0}')
            else:
                process.send_signal(signal.SIGINT if how == "Ctrl-C" else signal.SIGHUP)
            assert process.wait(timeout=30) == 0
        said, errors = process.communicate()
        assert said == "" and errors == ""
        with pytest.raises(OSError):
            status(url)
    finally:
        process.kill()
        process.communicate()
