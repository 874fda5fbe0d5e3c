"""`verso serve`: the live page over HTTP, read-only, and who may read it. The one file that opens a port for it."""

import contextlib
import hashlib
import hmac
import ipaddress
import json
import secrets
import signal
import socket
import socketserver
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

from schemas.errors import InputError
from services.look.live import Follower
from services.look.report import live_page, read_web

LEAST_TOKEN = 16
"""Fewest characters of a token that a person chooses."""

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)

HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""Sent with every answer."""


@dataclass(frozen=True)
class Gate:
    """What a request is held to."""

    names: frozenset[str]
    """Names of this server, beside addresses: a web page that points a name of its own here must not read the answer."""
    token: str | None
    cookie: str
    """Name of the cookie that holds the token."""


def judge(gate: Gate, method: str, target: str, headers: Mapping[str, str]) -> tuple[int, str]:
    """(status, path that is asked for) of a request; header names in lower case.

    200 to answer it, 303 to go on without the token in the address, 401 without the token, 403 for a foreign host name, 405
    for what is not reading.
    """
    if method not in ("GET", "HEAD"):
        return 405, "/"
    if not is_host_known(headers.get("host", ""), gate.names):
        return 403, "/"
    parts = urlsplit(target)
    given = parse_qs(parts.query).get("token")
    if gate.token is None:
        return 200, parts.path
    if given is not None:
        return 303 if is_same(given[0], gate.token) else 401, parts.path
    scheme, _, bearer = headers.get("authorization", "").partition(" ")
    offered = [bearer.strip()] if scheme.lower() == "bearer" else []
    cookies: SimpleCookie = SimpleCookie()
    with contextlib.suppress(CookieError):
        cookies.load(headers.get("cookie", ""))
    offered += [cookies[gate.cookie].value] if gate.cookie in cookies else []
    return 200 if any(is_same(token, gate.token) for token in offered) else 401, parts.path


def is_same(offered: str, token: str) -> bool:
    """Whether two tokens are one, in a time that tells nothing about either, its length included."""
    digests = (hashlib.sha256(one.encode("utf-8", "surrogateescape")).digest() for one in (offered, token))
    return hmac.compare_digest(*digests)


def is_host_known(host: str, names: Iterable[str]) -> bool:
    """Whether a Host header is an address or one of the names, in small or capital letters and at any port."""
    try:
        parts = urlsplit(f"//{host}")
        name, _ = (parts.hostname or "").rstrip("."), parts.port
    except ValueError:  # brackets or a port that are none
        return False
    return parts.netloc == host and "@" not in host and (is_address(name) or name in names)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address; a name other than `localhost` is not looked up."""
    return host == "localhost" or (is_address(host) and ipaddress.ip_address(host).is_loopback)


def is_address(name: str) -> bool:
    """Whether it is an IP address and no name."""
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False


MOST_REQUESTS = 64
"""Connections that are answered at once; more are closed."""

STALLED_S, ANSWER_S = 20.0, 120.0
"""A connection whose request has not come whole in so long is closed, however it trickles; and so is one that takes its answer
for so long."""

STATIC = {
    "/page.css": "text/css",
    "/page.js": "text/javascript",
    "/space.js": "text/javascript",
    "/live.js": "text/javascript",
    "/icon.svg": "image/svg+xml",
    "/three.js": "text/javascript",
}
"""Files of the page, by their whole path: nothing is looked up on the disk by what a request names."""

REMEDIES = {
    401: "this page needs its token: open the address that `verso serve` printed",
    403: "this server is not known by that name: open the address that `verso serve` printed",
    404: "there is nothing here: the page is at /",
    405: "this server only answers reading: GET and HEAD",
}


@dataclass(frozen=True)
class Place:
    """Where to listen, and who may read."""

    host: str
    port: int
    token: str | None

    @property
    def address(self) -> str:
        """What a person opens; a server that listens everywhere is told by this machine's name."""
        anywhere = is_address(self.host) and ipaddress.ip_address(self.host).is_unspecified
        host = socket.gethostname() if anywhere else f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/{f'?token={quote(self.token)}' if self.token else ''}"


def choose_place(host: str, port: int, token: str | None) -> Place:
    """Where to listen: a token is made where one is asked for (`auto`), or needed and not given.

    Raises InputError for a token that is easily guessed.
    """
    if token == "auto" or (token is None and not is_loopback(host)):
        token = secrets.token_urlsafe(24)
    if token is not None and (len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable()):
        remedy = f"give at least {LEAST_TOKEN} plain ones, or `auto` for a random one"
        raise InputError(f"--token has {len(token)} characters: {remedy}")
    return Place(host, port, token)


@contextlib.contextmanager
def serving(follower: Follower, place: Place) -> Iterator[Place]:
    """Answers requests while the block runs; yields the place with the port that was opened.

    Raises InputError where it cannot be opened.
    """
    try:
        server = _Server(follower, place)
    except (OSError, OverflowError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        remedy = "choose another --port, or a --host of this machine"
        raise InputError(f"{place.host} port {place.port} cannot be opened: {reason}; {remedy}") from error
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, name="http", daemon=True)
    thread.start()
    try:
        yield Place(place.host, server.server_address[1], place.token)
    finally:
        server.shutdown()
        server.server_close()
        thread.join(10)


@contextlib.contextmanager
def ended_by_signal() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set while the block runs, in place of what they would do. For the main thread."""
    ended = threading.Event()
    before = {number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Server(ThreadingHTTPServer):
    """Answers each connection in a thread, of which there is a largest number."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, follower: Follower, place: Place) -> None:
        self.follower = follower
        self.address_family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
        self._open = set[Any]()
        super().__init__((place.host, place.port), _Handler)
        names = {"localhost", socket.gethostname().lower(), place.host.lower()}
        self.gate = Gate(frozenset(names), place.token, f"verso_{self.server_address[1]}")

    def server_bind(self) -> None:
        """Binds without asking for the name of the address, which may take long without a network."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answers in a thread, or closes the connection where too many are open."""
        if len(self._open) < MOST_REQUESTS:  # only this thread adds to them
            self._open.add(request)
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answers one connection."""
        try:
            self.finish_request(request, client_address)
        except Exception:
            self.handle_error(request, client_address)
        finally:
            self.free(request)
            self.shutdown_request(request)

    def free(self, request: Any) -> None:
        """Counts a connection no longer; before it closes, because who sees it closed may open the next at once."""
        self._open.discard(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing of a connection that the reader closed."""


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: _Server
    timeout = STALLED_S
    server_version, sys_version = "verso", ""

    def handle_one_request(self) -> None:
        """Reads one request and answers it, whatever its method."""
        with self._hangs_up_after(STALLED_S, is_waiting=True):
            self.raw_requestline = self.rfile.readline(65_537)
            if not self.raw_requestline or len(self.raw_requestline) > 65_536:
                self.close_connection = True
                return
            is_request = self.parse_request()
        if is_request:
            with self._hangs_up_after(ANSWER_S, is_waiting=False):
                self._answer()

    @contextlib.contextmanager
    def _hangs_up_after(self, seconds: float, is_waiting: bool) -> Iterator[None]:
        """Closes the connection if the block takes longer: a limit of each read would begin anew with each byte.

        is_waiting: whether the block does nothing but wait for the reader, so that it ends with the connection.
        """
        timer = threading.Timer(seconds, self._hang_up, [is_waiting])
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def _hang_up(self, is_waiting: bool) -> None:
        if is_waiting:
            self.server.free(self.connection)
        with contextlib.suppress(OSError):  # it is closed already
            self.connection.shutdown(socket.SHUT_RDWR)

    def _answer(self) -> None:
        try:
            headers = {name.lower(): value for name, value in self.headers.items()}
            status, path = judge(self.server.gate, self.command, self.path, headers)
        except ValueError:  # an address that is none
            return self._send(404, "text/plain", REMEDIES[404].encode())
        if status == 303:
            cookie = f"{self.server.gate.cookie}={self.server.gate.token}; Path=/; HttpOnly; SameSite=Lax"
            return self._send(303, "text/plain", b"", {"Location": "/", "Set-Cookie": cookie})
        page = self._find(path) if status == 200 else None
        if page is None:
            status = 404 if status == 200 else status
            more = {"Allow": "GET, HEAD"} if status == 405 else {}
            return self._send(status, "text/plain", f"{status}: {REMEDIES[status]}\n".encode(), more)
        kind, data = page
        kept = "private, max-age=86400, immutable" if path.startswith("/picture/") else "no-store"
        return self._send(200, kind, data, {"Cache-Control": kept})

    def _find(self, path: str) -> tuple[str, bytes] | None:
        """(content type, bytes) of a path that is known by name, None of every other."""
        view = self.server.follower.view
        if path == "/":
            return "text/html", live_page(view).encode()
        if path == "/live.json":
            return "application/json", json.dumps(view.state()).encode()
        if path == "/sections.json":
            return "application/json", json.dumps(view.fragments()).encode()
        if path in STATIC:
            return STATIC[path], read_web(path.removeprefix("/")).encode()
        picture = self.server.follower.shelf.get(path.removeprefix("/picture/"))
        return None if picture is None else (f"image/{picture.kind}", picture.data)

    def _send(self, status: int, kind: str, data: bytes, more: Mapping[str, str] | None = None) -> None:
        self.close_connection = True
        self.send_response(status, HTTPStatus(status).phrase)
        text = "" if kind.startswith("image/") else "; charset=utf-8"
        for name, value in {**HEADERS, "Cache-Control": "no-store", **(more or {})}.items():
            self.send_header(name, value)
        self.send_header("Content-Type", f"{kind}{text}")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Logs nothing: addresses would hold the token."""
