"""What the web server answers: a few files and two questions. Nothing can be changed here."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.resources import files
from typing import Any, Protocol
from urllib.parse import parse_qs

from palpate.health import Health

StartResponse = Callable[[str, list[tuple[str, str]]], object]

_TEXT = "text/plain; charset=utf-8"
_POLICY = (
    "default-src 'none'; script-src 'self'{more}; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; "
    "form-action 'none'"
)
_STATIC = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/live": ("live.html", "text/html; charset=utf-8"),
    "/live.js": ("live.js", "text/javascript; charset=utf-8"),
}
"""The only files there are, by address: an address is never made into a path."""

_VIEWER = "/viewer/"
_ASK_MOST = 200


class Parts(Protocol):
    """The parts of a live view: ``WatchedView``."""

    def next_part(self, place: str) -> Any:
        """The part after a place (``place``, ``data``); None = there is none yet."""


class Files(Protocol):
    """The files of the live view's viewer: ``ViewerFiles``."""

    @property
    def problem(self) -> str:
        """Why there are none."""

    def find(self, name: str) -> bytes | None:
        """A file, compressed with gzip; None = not yet; ``KeyError`` = never."""


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer to a request, before the headers that all have."""

    status: HTTPStatus
    body: bytes = b""
    kind: str = _TEXT
    headers: Mapping[str, str] = field(default_factory=dict)


class WebApplication:
    """A WSGI application. Safe to use from several threads.

    ``set_status`` gives it what ``/api/status`` answers. Without ``parts`` there is no live view.
    Counts ``requests`` and ``refused_requests``.

    Args:
        names: Names of this host that a request may ask for, beside ``localhost`` and addresses.
        health: Of the process.
        parts: The live view.
        viewer: The files of its viewer.
        version: Of the viewer; a browser keeps its files while this is the same.
    """

    def __init__(
        self,
        names: Iterable[str],
        health: Health,
        parts: Parts | None = None,
        viewer: Files | None = None,
        version: str = "",
    ) -> None:
        self._names = {"localhost", *(name.lower() for name in names)}
        self._health = health
        self._parts, self._viewer, self._version = parts, viewer, version
        self._status = b""
        folder = files(__package__) / "page"
        self._static = {
            address: Answer(HTTPStatus.OK, (folder / name).read_bytes(), kind)
            for address, (name, kind) in _STATIC.items()
        }

    def set_status(self, status: bytes) -> None:
        """Take over what ``/api/status`` answers: JSON."""
        self._status = status

    def __call__(self, environ: Mapping[str, Any], start_response: StartResponse) -> list[bytes]:
        """Answer a request, see PEP 3333."""
        answer = self._refusal(environ)
        self._health.count("requests" if answer is None else "refused_requests")
        if answer is None:
            answer = self._answer(environ)
        headers = {
            "Content-Type": answer.kind,
            "Content-Length": str(len(answer.body)),
            "Cache-Control": "no-store",
            "Content-Security-Policy": _POLICY.format(more=""),
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cross-Origin-Opener-Policy": "same-origin",
            **answer.headers,
        }
        if answer.status in (HTTPStatus.NO_CONTENT, HTTPStatus.NOT_MODIFIED):
            del headers["Content-Type"], headers["Content-Length"]
        start_response(f"{answer.status.value} {answer.status.phrase}", list(headers.items()))
        return [] if environ["REQUEST_METHOD"] == "HEAD" else [answer.body]

    def _refusal(self, environ: Mapping[str, Any]) -> Answer | None:
        if environ["REQUEST_METHOD"] not in ("GET", "HEAD"):
            text = b"This page only shows; a station is changed by the command palpate.\n"
            return Answer(HTTPStatus.METHOD_NOT_ALLOWED, text, headers={"Allow": "GET, HEAD"})
        # A page elsewhere whose name was made to point here (DNS rebinding) asks for that name.
        if not self._is_known(environ.get("HTTP_HOST", "")):
            text = b"This host is not known by that name: [web] names in the profile.\n"
            return Answer(HTTPStatus.MISDIRECTED_REQUEST, text)
        # Pages elsewhere could not read the answer, but make the station draw.
        foreign = environ.get("HTTP_SEC_FETCH_SITE") in ("cross-site", "same-site")
        if foreign and environ.get("HTTP_SEC_FETCH_MODE") != "navigate":
            return Answer(HTTPStatus.FORBIDDEN, b"Only this page may ask.\n")
        return None

    def _is_known(self, host: str) -> bool:
        """Whether a ``Host`` header is an address or a known name, with or without a port."""
        name, colon, port = host.rpartition(":")
        if not colon or not port.isdigit() or not port.isascii():
            name = host
        if name.lower() in self._names:
            return True
        bare = name[1:-1] if name.startswith("[") and name.endswith("]") else name
        try:
            address = ipaddress.ip_address(bare)
        except ValueError:
            return False
        return (address.version == 6) == (bare != name)

    def _answer(self, environ: Mapping[str, Any]) -> Answer:
        address = environ["PATH_INFO"]
        if (static := self._static.get(address)) is not None:
            if address == "/live":
                return self._live(static)
            return static
        if address == "/api/status":
            if not self._status:
                return _later(b"The station has not been looked at yet.\n")
            return Answer(HTTPStatus.OK, self._status, "application/json")
        if address == "/api/view" and self._parts is not None:
            return self._view(environ.get("QUERY_STRING", ""))
        if address.startswith(_VIEWER) and self._viewer is not None:
            return self._viewer_file(address.removeprefix(_VIEWER), environ)
        return Answer(HTTPStatus.NOT_FOUND, b"There is no such page.\n")

    def _live(self, page: Answer) -> Answer:
        if self._parts is None:
            text = b"There is no live view: [web] live in the profile, and extra services.\n"
            return Answer(HTTPStatus.NOT_FOUND, text)
        # The viewer is WebAssembly, and sets styles of its elements from its script.
        more = {"Content-Security-Policy": _POLICY.format(more=" 'wasm-unsafe-eval'")}
        return Answer(page.status, page.body, page.kind, more)

    def _view(self, query: str) -> Answer:
        assert self._parts is not None
        place = parse_qs(query[:_ASK_MOST]).get("after", [""])[0]
        part = self._parts.next_part(place)
        if part is None:
            return Answer(HTTPStatus.NO_CONTENT)
        headers = {"Palpate-Place": part.place}
        return Answer(HTTPStatus.OK, part.data, "application/octet-stream", headers)

    def _viewer_file(self, name: str, environ: Mapping[str, Any]) -> Answer:
        assert self._viewer is not None
        tag = f'"{self._version}"'
        kept = {"ETag": tag, "Cache-Control": "no-cache"}  # kept, and asked for again
        try:
            content = self._viewer.find(name)
        except KeyError:
            return Answer(HTTPStatus.NOT_FOUND, b"There is no such file.\n")
        if environ.get("HTTP_IF_NONE_MATCH") == tag:
            return Answer(HTTPStatus.NOT_MODIFIED, headers=kept)
        if content is None:
            problem = self._viewer.problem
            return _later(problem.encode() or b"The viewer is being prepared.\n")
        kind = "application/wasm" if name.endswith(".wasm") else "text/javascript; charset=utf-8"
        return Answer(HTTPStatus.OK, content, kind, {**kept, "Content-Encoding": "gzip"})


def _later(text: bytes) -> Answer:
    return Answer(HTTPStatus.SERVICE_UNAVAILABLE, text, headers={"Retry-After": "1"})
