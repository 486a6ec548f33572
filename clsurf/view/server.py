"""The viewer in a browser: rendercanvas's web application behind checks of its own, served by uvicorn.

Who may look and steer: requests that name this machine (`Host`), carry the token in their path, and, for the
connection that takes events and gives pictures, come from a page of this very server (`Origin`). Without these checks
any page that the user visits could connect to a server on the loopback interface.
"""

import asyncio
import contextlib
import ipaddress
import secrets
import signal
import socket
from urllib.parse import urlsplit

from ..errors import InputError

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
HEADERS = [(b"x-frame-options", b"DENY"), (b"referrer-policy", b"no-referrer"), (b"cache-control", b"no-store"),
           (b"x-content-type-options", b"nosniff"),
           (b"content-security-policy", b"default-src 'self'; img-src 'self' blob: data:; style-src 'self' "
                                        b"'unsafe-inline'; connect-src 'self' ws: wss:; frame-ancestors 'none'")]

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>clsurf</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<script type="module" src="renderview.js"></script>
<script type="module" src="renderview-client.js"></script>
<link rel="stylesheet" href="renderview.css">
<style>
html, body { margin: 0; height: 100%; overflow: hidden; background: #fff }
#canvas { border: 0; max-width: none !important; max-height: none !important }
#canvas img { image-rendering: auto !important }
#status { position: fixed; right: 8px; bottom: 6px; font: 12px sans-serif; color: #888; pointer-events: auto }
</style></head>
<body><div id="canvas" class="renderview-wrapper" style="width: 100vw; height: 100vh"></div>
<div id="status"></div></body></html>
"""


def is_loopback(host: str) -> bool:
    """Whether only this machine can connect to `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def guarded(app, token: str, loopback: bool):
    """Return an ASGI application that lets only those requests through to `app` that it may see.

    Parameters
    ----------
    app : ASGI application
    token : str
        First part of every path.
    loopback : bool
        Whether the server listens to this machine only: then `Host` must name it, so that no other name that a page's
        owner points at 127.0.0.1 reaches it.
    """
    async def guard(scope, receive, send):
        if scope["type"] == "lifespan":
            await app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        wrong = _wrong(scope, headers, token, loopback)
        if scope["type"] == "websocket":
            if wrong:
                if (await receive())["type"] == "websocket.connect":
                    await send({"type": "websocket.close", "code": 4403, "reason": wrong})
                return
            await app(scope, receive, send)
            return
        if not wrong and scope["method"] not in ("GET", "HEAD"):
            wrong = "method"
        if wrong:
            await _refuse(send, wrong)
            return

        async def with_headers(message):
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", ()), *HEADERS]}
            await send(message)
        await app(scope, receive, with_headers)
    return guard


def _wrong(scope, headers: dict, token: str, loopback: bool) -> str:
    """Return what is wrong with a request, or an empty text."""
    host = headers.get("host", "")
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        name = ""
    if loopback and name not in LOOPBACK_NAMES:
        return "host"
    parts = scope["path"].split("/")
    if len(parts) != 3 or not secrets.compare_digest(parts[1].encode(), token.encode()):
        return "token"
    if scope["type"] == "websocket":
        origin = urlsplit(headers.get("origin", ""))
        # Same host and port as the page came from; another scheme only where a proxy adds TLS.
        if origin.scheme not in ("http", "https") or not host or origin.netloc.lower() != host.lower():
            return "origin"
    return ""


async def _refuse(send, wrong: str) -> None:
    status = {"host": 421, "token": 404, "method": 405}[wrong]
    headers = [(b"content-type", b"text/plain"), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": b"Not here.\n"})


def web_application():
    """Return rendercanvas's application with a page of ours, which fills the window."""
    from rendercanvas import http
    kind, script = http.resources["renderview-client.js"]
    # Behind a proxy with TLS a page may open secure connections only.
    script = script.replace("'ws://' +", "(location.protocol === 'https:' ? 'wss://' : 'ws://') +")
    http.asgi.close = lambda: None  # the server closes the connections; rendercanvas 2.7 only seems to
    http.asgi._resources = {**http.resources, "index.html": ("text/html; charset=utf-8", PAGE),
                            "renderview-client.js": (kind, script), "favicon.ico": ("image/x-icon", b"")}
    return http.asgi


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens at `host` and `port` (0: a free one), or raise InputError."""
    if not isinstance(port, int) or not 0 <= port < 65536:
        raise InputError(f"port: expected a number from 0 (a free one) to 65535, got {port!r}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM,
                                                                flags=socket.AI_PASSIVE)[0]
        listener = socket.socket(family, kind, protocol)
        with contextlib.suppress(OSError):
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(address)
            listener.listen(128)  # who comes before the server runs waits
        except OSError:
            listener.close()
            raise
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"host {host}, port {port}: cannot be listened to: {reason}: choose another --host or "
                         "--port") from None
    return listener


def address(listener: socket.socket, host: str, token: str) -> str:
    """Return the URL of the viewer."""
    name = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(host, host)
    return f"http://{f'[{name}]' if ':' in name else name}:{listener.getsockname()[1]}/{token}/"


def serve(listener: socket.socket, token: str, loopback: bool, ready=None) -> None:
    """Serve the viewer until Ctrl-C, a closed terminal, or `stop`.

    `ready` is called with a function that stops the server, once it listens.
    """
    import uvicorn
    config = uvicorn.Config(guarded(web_application(), token, loopback), log_level="critical", access_log=False,
                            lifespan="on", timeout_graceful_shutdown=1, ws_max_size=1 << 20)
    server = uvicorn.Server(config)

    def stop(*_):
        server.should_exit = True

    async def run():
        loop = asyncio.get_running_loop()
        with contextlib.suppress(ValueError, RuntimeError, NotImplementedError):  # not the main thread, Windows
            loop.add_signal_handler(getattr(signal, "SIGHUP", signal.SIGTERM), stop)  # a closed terminal
        if ready is not None:
            ready(stop)
        await server.serve(sockets=[listener])
    with contextlib.closing(listener):
        asyncio.run(run())
