"""The web server of a device, as far as a program asks for it: one page at one path."""

from __future__ import annotations

import contextlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class WebPage:
    """Serves a page; closed and opened again it is at the same port.

    Args:
        host: Address to listen at.
        port: 0 = any free one.
        path: Where the page is, e.g. ``/netftapi2.xml``.
    """

    def __init__(self, host: str, port: int, path: str) -> None:
        self.port = port
        self.content: bytes | None = None
        """What is on it; None = there is no such page."""
        self._host, self._path = host, path
        self._server: ThreadingHTTPServer | None = None

    def open(self) -> None:
        """Begin to serve."""
        server = ThreadingHTTPServer((self._host, self.port), self._handler())
        self._server, self.port = server, server.server_address[1]
        threading.Thread(
            target=server.serve_forever, args=(0.02,), name=self._path, daemon=True
        ).start()

    def close(self) -> None:
        """End; twice is harmless."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path != page._path or page.content is None:
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "text/xml")
                self.end_headers()
                with contextlib.suppress(OSError):  # A reader with a size limit hangs up early.
                    self.wfile.write(page.content)

            def log_message(self, format: str, *args: object) -> None:
                """Whoever runs an emulator needs no access log."""

        return Handler
