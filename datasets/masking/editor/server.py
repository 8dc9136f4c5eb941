"""Answer pages on this machine, and nobody else: a token in the address, the loopback, no other site's pages.

Another site's page cannot know the token; nor can it reach the editor under a name of its own that it lets point to
127.0.0.1 (DNS rebinding), because the Host header then holds that name.
"""

import hmac
import json
import re
import secrets
import sys
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import PurePath
from socketserver import TCPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from rewild4d.datasets.masking.editor.editor import Editor, refused
from rewild4d.datasets.masking.editor.requests import LARGEST, parse
from rewild4d.errors import UserError

HOST = "127.0.0.1"
TYPES = {
    ".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}  # fmt: skip
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
PICTURE = re.compile(r"(frame|thumb|mask|marks)/([0-9]{1,9})")
KEEP, FORGET = "private, max-age=86400, immutable", "no-store"
"""What browsers keep: pictures, whose addresses have a version; nothing else."""
PATIENCE = 30
"""Seconds for a request to arrive."""


class Server(ThreadingHTTPServer):
    """Holds a port from the start, and serves `editor` at ``address`` once it is told to.

    Args:
        port: 0 for any that is free.

    Attributes:
        editor: what is served.

    Raises:
        UserError: the port is in use, or may not be used.
    """

    daemon_threads, allow_reuse_address = True, sys.platform != "win32"

    editor: Editor

    def __init__(self, port: int = 0) -> None:
        self.token = secrets.token_urlsafe(24)
        page = resources.files("rewild4d.datasets.masking.editor") / "page"
        self.page = {item.name: item.read_bytes() for item in page.iterdir() if PurePath(item.name).suffix in TYPES}
        try:
            super().__init__((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(f"--port: expected a port of this machine that is free, got {port}: {reason}.") from error
        self.hosts = {f"{name}:{self.server_port}" for name in (HOST, "localhost")}

    @property
    def address(self) -> str:
        """The page's address, with the token."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    def server_bind(self) -> None:
        """Bind without looking this machine's name up, which can take seconds."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a browser that went away."""
        if not isinstance(sys.exc_info()[1], ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class Unfit(Exception):
    """A request that is not answered as it hoped: a status and a sentence."""

    def __init__(self, status: HTTPStatus, said: str) -> None:
        super().__init__(said)
        self.status = status


class Handler(BaseHTTPRequestHandler):
    """Answers one connection."""

    server: Server
    protocol_version, server_version, sys_version, timeout = "HTTP/1.1", "rewild4d", "", PATIENCE

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def _answer(self, answer: Callable[[str, str], None]) -> None:
        """Answer what may ask, with the address below the token and what follows a question mark."""
        try:
            answer(*self._allowed())
        except Unfit as error:
            self.close_connection = True  # what was not read of the request is no request
            self._send_json({"error": str(error)}, error.status)

    def _get(self, name: str, query: str) -> None:
        editor = self.server.editor
        picture = PICTURE.fullmatch(name)
        if name == "about":
            self._send_json(editor.about())
        elif name == "state":
            seen, version = parse_qs(query).get("seen", [""])[0], editor.work.version
            self._send_json({"version": version} if seen == str(version) else editor.state())
        elif picture and int(picture[2]) < editor.work.count:
            self._send_picture(picture[1], int(picture[2]))
        elif (file := name or "index.html") in self.server.page:
            self._send(HTTPStatus.OK, TYPES[PurePath(file).suffix], self.server.page[file])
        else:
            raise Unfit(HTTPStatus.NOT_FOUND, "There is no such thing.")

    def _post(self, name: str, query: str) -> None:
        body, editor = self._body(), self.server.editor
        if name != "do":
            raise Unfit(HTTPStatus.NOT_FOUND, "There is no such thing.")
        try:
            request = parse(body)
        except ValueError as error:
            raise Unfit(HTTPStatus.BAD_REQUEST, f"Not understood: {error}.") from error
        try:
            look = editor.do(request)
        except Exception as error:
            status, said = refused(error)
            self._send_json({"error": said, "state": editor.state()}, status)
        else:
            self._send_json({"state": editor.state(), "look": look})

    def _allowed(self) -> tuple[str, str]:
        """Return the address below the token and what follows a question mark.

        Raises:
            Unfit: another site's page asks, or the token is missing.
        """
        try:
            path = urlsplit(self.path)
        except ValueError as error:
            raise Unfit(HTTPStatus.BAD_REQUEST, "Not an address.") from error
        _, token, rest = (path.path.split("/", 2) + ["", ""])[:3]
        host, origin = self.headers.get("Host", "").lower(), self.headers.get("Origin")
        is_ours = origin is None or origin.removeprefix("http://") in self.server.hosts
        is_same = self.headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")
        if self.command == "GET" and self.headers.get("Sec-Fetch-Mode") == "navigate":
            is_same = True  # a link to this page was followed
        if host not in self.server.hosts or not (is_ours and is_same):
            raise Unfit(HTTPStatus.FORBIDDEN, "Only pages of this editor may ask.")
        if not hmac.compare_digest(token.encode("utf-8", "surrogateescape"), self.server.token.encode()):
            raise Unfit(HTTPStatus.FORBIDDEN, "The address lacks its token: use the one in the terminal.")
        return rest, path.query

    def _body(self) -> bytes:
        """Return what was posted.

        Raises:
            Unfit: it has no length, is too long, no JSON, or ends early.
        """
        length = self.headers.get("Content-Length", "")
        if self.headers.get("Transfer-Encoding") or not re.fullmatch(r"[0-9]{1,12}", length):
            raise Unfit(HTTPStatus.LENGTH_REQUIRED, "How long is it?")
        if int(length) > LARGEST:
            raise Unfit(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "That is too much at once.")
        if self.headers.get_content_type() != "application/json":
            raise Unfit(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "Expected JSON.")
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            raise Unfit(HTTPStatus.BAD_REQUEST, "It ends early.")
        return body

    def _send_picture(self, kind: str, place: int) -> None:
        editor = self.server.editor
        make = {
            "frame": editor.film.frame, "thumb": editor.film.thumb, "mask": editor.mask_png, "marks": editor.marks_png,
        }[kind]  # fmt: skip
        try:
            data = make(place)
        except OSError as error:
            raise Unfit(HTTPStatus.NOT_FOUND, "The editor has ended.") from error
        self._send(HTTPStatus.OK, "image/jpeg" if kind in ("frame", "thumb") else "image/png", data, KEEP)

    def _send_json(self, value: Any, status: int = HTTPStatus.OK) -> None:
        self._send(status, "application/json", json.dumps(value).encode())

    def _send(self, status: int, kind: str, data: bytes, cache: str = FORGET) -> None:
        self.send_response(status)
        for name, value in (HEADERS | {"Content-Type": kind, "Cache-Control": cache}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet: the terminal is for people."""
