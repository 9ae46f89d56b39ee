"""Pages of servers on loopback that behave and that do not."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from palpate.errors import DeviceError
from palpate_gateway.emulators.rdt import WebPage
from palpate_gateway.ports import sockets
from palpate_gateway.ports.sockets import read_page


@contextmanager
def served(content: bytes | None) -> Iterator[str]:
    page = WebPage("127.0.0.1", 0, "/page")
    page.content = content
    page.open()
    try:
        yield f"http://127.0.0.1:{page.port}/page"
    finally:
        page.close()


def test_all_of_a_page() -> None:
    content = bytes(range(256)) * 1000
    with served(content) as url:
        assert read_page(url, timeout_s=10.0, most_bytes=len(content)) == content
        with pytest.raises(DeviceError, match="more than 255999 bytes"):
            read_page(url, timeout_s=10.0, most_bytes=len(content) - 1)


def test_a_proxy_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    with served(b"hello") as url:
        assert read_page(url, timeout_s=10.0, most_bytes=10) == b"hello"


def test_no_page() -> None:
    with (
        served(None) as url,
        pytest.raises(DeviceError, match=r"404.* -> open this address in a browser"),
    ):
        read_page(url, timeout_s=10.0, most_bytes=10)
    with pytest.raises(DeviceError, match="refused"):
        read_page(url, timeout_s=10.0, most_bytes=10)
    with pytest.raises(DeviceError, match="unknown url type"):
        read_page("page", timeout_s=10.0, most_bytes=10)


def test_a_page_is_not_read_beyond_its_time_though_bytes_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seconds = itertools.count()
    with served(bytes(1000)) as url:
        monkeypatch.setattr(
            sockets, "time", SimpleNamespace(monotonic=lambda: float(next(seconds)))
        )
        with pytest.raises(DeviceError, match=r"not read within 0\.5 s|timed out"):
            read_page(url, timeout_s=0.5, most_bytes=1 << 20)


@pytest.mark.parametrize(
    "greeting",
    [b"HTTP/1.0 200 OK\r\n\r\n", b"HTTP/1.0 200 OK\r\nX: ", b"hello\r\n", b""],
)
def test_a_page_that_trickles_or_is_none_is_given_up(greeting: bytes) -> None:
    stop = threading.Event()

    def trickle() -> None:
        link, _ = server.accept()
        with link, contextlib.suppress(OSError):
            link.sendall(greeting)
            while greeting and not stop.wait(0.02):
                link.sendall(b"x")
            stop.wait(10.0)

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=trickle)
        thread.start()
        url = f"http://127.0.0.1:{server.getsockname()[1]}/page"
        try:
            with pytest.raises(DeviceError, match=r"not read within 0\.2 s|timed out|hello"):
                read_page(url, timeout_s=0.2, most_bytes=1 << 20)
        finally:
            stop.set()
            thread.join(10.0)
