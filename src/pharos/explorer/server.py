"""A small local server of the page: one address, one token, GET alone, no files.

It listens on the loopback interface. A request is answered where its Host header names this server (a page from
elsewhere whose name was led here by DNS does not) and its path begins with the token, compared in constant time.
Answers come from a table of questions; no part of a request ever names a file.
"""

import hmac
import json
import secrets
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pharos.errors import ParameterError, PharosError
from pharos.explorer.exploration import Exploration
from pharos.explorer.maps import heat_map
from pharos.explorer.pages import POLICY_OF_SERVER, page

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")  # that a Host header may have
LONGEST_QUERY = 8192  # characters
SECONDS = 30  # of waiting for a request
MOST_CONNECTIONS = 64  # at once; a thread each


class Server:
    """Answers questions about an MDP on the loopback interface.

    Args:
        world: what is asked.
        port: 0 for any that is free.
    Attributes:
        url: the address of the page, with its token.
    Raises:
        ParameterError: the port is taken, or may not be used.
    """

    def __init__(self, world: Exploration, port: int = 0):
        self.world, self.token = world, secrets.token_urlsafe(24)
        self.lock = threading.Lock()  # compiled loops may not run in two threads at once
        try:
            self._http = _Http((HOST, port), _Handler)
        except OSError as error:
            raise ParameterError(
                f"port {port} of {HOST}: {error.strerror or error}; choose another, or leave it out for a free one"
            ) from error
        except OverflowError as error:
            raise ParameterError(f"port {port}; expected 0 to 65535") from error
        self._http.owner = self
        self.port = int(self._http.server_address[1])
        self.url = f"http://{HOST}:{self.port}/{self.token}/"
        self.hosts = frozenset(f"{name}:{self.port}" for name in NAMES)
        self._page = page(world).encode()

    def serve(self) -> None:
        """Answer until `close` is called, or the process is interrupted."""
        self._http.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Stop, and give the port back."""
        self._http.shutdown()
        self._http.server_close()

    def leave(self) -> None:
        """Give the port back where `serve` has ended."""
        self._http.server_close()

    def answer(self, path: str, query: str) -> tuple[HTTPStatus, str, bytes]:
        """Status, type and content for what stands behind the token."""
        if path == "":
            return HTTPStatus.OK, "text/html; charset=utf-8", self._page
        if path not in QUESTIONS or len(query) > LONGEST_QUERY:
            return _said(HTTPStatus.NOT_FOUND, "there is nothing there")
        words = {name: values[-1] for name, values in parse_qs(query, keep_blank_values=True).items()}
        try:
            with self.lock:
                answer = QUESTIONS[path](self.world, words)
        except PharosError as error:
            return _said(HTTPStatus.BAD_REQUEST, str(error))
        except MemoryError:
            return _said(HTTPStatus.INSUFFICIENT_STORAGE, "out of memory")
        return HTTPStatus.OK, "application/json", json.dumps(answer, allow_nan=False).encode()


def _said(status: HTTPStatus, text: str) -> tuple[HTTPStatus, str, bytes]:
    return status, "application/json", json.dumps({"error": text}).encode()


# Questions ------------------------------------------------------------------------------------------------------------


def _whole(words: Mapping[str, str], name: str, otherwise: int | None = None) -> Any:
    """A whole number of a query; `otherwise` where it is not there."""
    text = words.get(name, "")
    if text == "":
        if otherwise is None:
            raise ParameterError(f"{name} is missing")
        return otherwise
    if not (text.isascii() and text.removeprefix("-").isdigit() and len(text) < 20):
        raise ParameterError(f"{name} is {text[:40]!r}; expected a whole number")
    return int(text)


def _previous(words: Mapping[str, str]) -> int | None:
    return _whole(words, "previous") if words.get("previous") else None


def _heat_map(world: Exploration, words: Mapping[str, str]) -> dict[str, Any]:
    fixed = {name.removeprefix("fix."): _whole(words, name) for name in words if name.startswith("fix.")}
    names = {name: words.get(name, "") for name in ("x", "y", "what", "how")}
    return heat_map(world, **names, fixed=fixed)


QUESTIONS: dict[str, Callable[[Exploration, Mapping[str, str]], dict[str, Any]]] = {
    "about": lambda world, _: world.about(),
    "position": lambda world, words: world.position(_whole(words, "state"), _previous(words)),
    "find": lambda world, words: world.find(words.get("text", "")),
    "path": lambda world, words: world.path(words.get("policy", ""), _whole(words, "state"), _previous(words)),
    "layer": lambda world, words: world.layer(_whole(words, "layer"), _whole(words, "first", 0)),
    "wrong": lambda world, words: world.wrong(words.get("policy", "")),
    "map": _heat_map,
}


# HTTP -----------------------------------------------------------------------------------------------------------------


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    owner: Server

    def __init__(self, *address: Any):
        self.places = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__(*address)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give the connection a thread; one too many is closed at once."""
        if self.places.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.places.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that went away in the middle of an answer is no error."""


class _Handler(BaseHTTPRequestHandler):
    timeout = SECONDS
    server: _Http
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "pharos", ""

    def do_GET(self) -> None:
        self._reply(with_content=True)

    def do_HEAD(self) -> None:
        self._reply(with_content=False)

    def refuse(self) -> None:
        """Any other method."""
        self._send(*_said(HTTPStatus.METHOD_NOT_ALLOWED, "this server answers GET alone"), with_content=True)

    do_POST = do_PUT = do_PATCH = do_DELETE = do_OPTIONS = do_TRACE = do_CONNECT = refuse

    def _reply(self, with_content: bool) -> None:
        self._send(*self._answer(self.server.owner), with_content=with_content)

    def _send(self, status: HTTPStatus, kind: str, content: bytes, *, with_content: bool) -> None:
        self.close_connection = True  # so that nobody is answered after `close`
        self.send_response(status)
        self.send_header("Connection", "close")
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY_OF_SERVER)
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        if with_content:
            self.wfile.write(content)

    def _answer(self, owner: Server) -> tuple[HTTPStatus, str, bytes]:
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or hosts[0].lower() not in owner.hosts:
            return _said(HTTPStatus.MISDIRECTED_REQUEST, "this server answers to its own address alone")
        origin = self.headers.get("Origin")
        if origin is not None and origin.lower().removeprefix("http://") not in owner.hosts:
            return _said(HTTPStatus.FORBIDDEN, "this server answers to its own page alone")
        try:
            parts = urlsplit(self.path)
        except ValueError:
            return _said(HTTPStatus.BAD_REQUEST, "what was asked for is no address")
        token, _, rest = parts.path.removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), owner.token.encode()):
            return _said(HTTPStatus.FORBIDDEN, "the address lacks the token that `pharos explore` printed")
        return owner.answer(rest, parts.query)

    def log_message(self, format: str, *args: object) -> None:
        """Nothing is logged."""
