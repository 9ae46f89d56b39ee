"""The page of a station: what it says, what it refuses, and what hostile clients can do."""

from __future__ import annotations

import dataclasses
import http.client
import json
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import Any

import pytest

from palpate.bus import Session
from palpate.census import ROUTER, ProcessReport
from palpate.config import LinkConfig
from palpate.errors import ConfigError, LinkError
from palpate.health import Health, HealthReporter
from palpate.messages import SensorState, SensorStatus, ServiceState, Status
from palpate_deploy.station.observation import ObservedProcess
from palpate_deploy.station.profile import Profile, WebConfig, parse_profile
from palpate_deploy.station.web import process as web
from palpate_deploy.station.web.application import WebApplication
from palpate_deploy.station.web.process import run_web
from palpate_deploy.station.web.snapshot import PROCESSES_MOST, as_json, snapshot
from palpate_services.viewer import viewer_files

pytest.importorskip("waitress", reason="waitress not installed (extra web)")

PATIENCE_S = 60.0
OWN = ("web", "web")
WaitUntil = Callable[[Callable[[], bool], float, str], float]

GATEWAY = Status(
    "gateway",
    "gateway",
    ServiceState.READY,
    5_000_000_000,
    1,
    60.0,
    "1",
    {"thumb.frames_published": 7},
    {"thumb.tare_age_s": 61.0, "thumb.publish_p50_s": 1e-3, "ring.tare_drift_counts": math.nan},
    sensor_states=(
        SensorStatus("thumb", SensorState.LIVE, 2_000_000_000),
        SensorStatus("ring", SensorState.LOST, 1_000_000_000, message="no bytes for 3 s"),
    ),
)
RECORDER = Status(
    "recorder",
    "recorder",
    ServiceState.READY,
    1,
    1,
    60.0,
    "1",
    {"recorded_bytes": 10},
    {"record_bytes": 5e6, "disk_free_bytes": 7e9},
    message="recording to runs/lab.mcap",
)


def observed(*statuses: Status, up: bool = True) -> list[ObservedProcess]:
    return [
        ObservedProcess(
            ProcessReport(one.service, one.instance, up, up, one if up else None),
            0.4,
            {"recorded_bytes": 1234.0, "thumb.frames_published": 99.5},
        )
        for one in statuses
    ]


def seen(*statuses: Status, up: bool = True, router: bool = True) -> dict[str, Any]:
    """A snapshot as a browser reads it."""
    plain = snapshot("lab", observed(*statuses, up=up), router=router, own=OWN)

    def no_constant(text: str) -> None:
        raise AssertionError(f"{text} is not JSON")

    found: dict[str, Any] = json.loads(as_json(plain), parse_constant=no_constant)
    return found


def test_sensors_with_state_rate_tare_and_latency() -> None:
    found = seen(GATEWAY)
    thumb, ring = found["sensors"]
    assert (thumb["name"], thumb["state"], thumb["rate_hz"]) == ("thumb", "live", 99.5)
    assert (thumb["tare_age_s"], thumb["age_s"]) == (61.0, 0.4)
    assert thumb["publish"] == {"p50_s": 1e-3, "p99_s": None}
    assert (ring["state"], ring["message"]) == ("lost", "no bytes for 3 s")
    assert ring["tare_age_s"] is None
    assert ring["tare_drift_counts"] is None  # NaN is not known, and no JSON


def test_recordings_with_size_and_room() -> None:
    (one,) = seen(RECORDER)["recordings"]
    assert one == {
        "instance": "recorder", "state": "ready", "message": "recording to runs/lab.mcap",
        "size_bytes": 5e6, "kept_bytes": None, "disk_free_bytes": 7e9, "bytes_per_s": 1234.0,
    }  # fmt: skip


def test_a_station_answers_only_if_a_process_beside_the_page_does() -> None:
    page = dataclasses.replace(RECORDER, service="web", instance="web")
    assert seen(GATEWAY, page)["answers"]
    assert not seen(page)["answers"]
    unrouted = seen(GATEWAY, page, router=False)
    assert unrouted["answers"], "what comes by direct links is as it is now"
    assert not unrouted["router"]
    assert not seen(page, router=False)["answers"]
    silent = seen(GATEWAY, up=False)
    assert not silent["answers"]
    assert silent["troubles"][0]["problem"] == "does not run"


def test_invented_processes_are_bounded() -> None:
    many = [dataclasses.replace(GATEWAY, instance=f"g{n}") for n in range(3 * PROCESSES_MOST)]
    found = seen(*many)
    assert found["well"] == 3 * PROCESSES_MOST
    assert len(found["processes"]) == len(found["sensors"]) == PROCESSES_MOST
    assert found["left_out"] == 2 * PROCESSES_MOST


@dataclasses.dataclass(frozen=True)
class Part:
    place: str
    data: bytes


class Drawn:
    """Parts of a live view, and a viewer's files."""

    problem = ""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def next_part(self, place: str) -> Part | None:
        self.asked.append(place)
        return Part("run-1-1", b"rrd") if place == "" else None

    def find(self, name: str) -> bytes | None:
        return {"re_viewer.js": b"js", "re_viewer_bg.wasm": None}[name]


class Reply:
    def __init__(self, status: str, headers: list[tuple[str, str]], body: bytes) -> None:
        self.status = int(status.split()[0])
        self.headers = dict(headers)
        self.body = body


def ask(
    address: str,
    *,
    application: WebApplication | None = None,
    method: str = "GET",
    query: str = "",
    **headers: str,
) -> Reply:
    """What the application answers; ``headers`` named as WSGI does."""
    if application is None:
        application = made()
    environ = {
        "REQUEST_METHOD": method, "PATH_INFO": address, "QUERY_STRING": query,
        "HTTP_HOST": "localhost:7480", **headers,
    }  # fmt: skip
    said: list[Any] = []
    body = b"".join(application(environ, lambda *args: said.extend(args)))
    return Reply(said[0], said[1], body)


def made(drawn: Drawn | None = None, **kwargs: Any) -> WebApplication:
    health = Health("web", "web")
    drawn = Drawn() if drawn is None else drawn
    application = WebApplication(["hand-pc"], health, drawn, drawn, "0.41.0", **kwargs)
    application.set_status(b'{"station":"lab"}')
    return application


def test_the_page_and_its_files_are_served_with_headers_that_forbid_the_rest() -> None:
    for address, kind in (("/", "text/html"), ("/page.js", "text/javascript"), ("/live", "html")):
        reply = ask(address)
        assert reply.status == 200
        assert kind in reply.headers["Content-Type"]
        assert int(reply.headers["Content-Length"]) == len(reply.body) > 100
        policy = reply.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "connect-src 'self';" in policy  # the viewer reports to nobody
        assert "unsafe-inline" not in policy
        assert reply.headers["X-Content-Type-Options"] == "nosniff"
        assert "Access-Control-Allow-Origin" not in reply.headers


def test_nothing_is_loaded_from_elsewhere() -> None:
    for address in ("/", "/page.js", "/page.css", "/live", "/live.js"):
        body = ask(address).body
        assert b"http://" not in body
        assert b"https://" not in body
        assert b"innerHTML" not in body  # names come from other processes


@pytest.mark.parametrize(
    "method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "get", "X"]
)
@pytest.mark.parametrize("address", ["/", "/api/status", "/api/view", "/nowhere"])
def test_nothing_can_be_changed(method: str, address: str) -> None:
    drawn = Drawn()
    reply = ask(address, application=made(drawn), method=method)
    assert reply.status == 405
    assert reply.headers["Allow"] == "GET, HEAD"
    assert not drawn.asked


def test_head_has_the_headers_of_get_and_no_body() -> None:
    whole, head = ask("/"), ask("/", method="HEAD")
    assert head.headers == whole.headers
    assert head.body == b""


@pytest.mark.parametrize(
    "host",
    ["localhost", "LOCALHOST:7480", "127.0.0.1:7480", "[::1]:7480", "[::1]", "10.1.2.3", "hand-pc"],
)
def test_hosts_that_are_known(host: str) -> None:
    assert ask("/api/status", HTTP_HOST=host).status == 200


@pytest.mark.parametrize(
    "host",
    ["", "evil.example", "evil.example:7480", "localhost.evil.example", "127.0.0.1.evil.example",
     "localhost@evil.example", "[::1", "::1", "[127.0.0.1]", "localhost:7480:1", "2130706433",
     "hand-pc.", ":7480", "127.0.0.1:٣"],
)  # fmt: skip
def test_a_page_elsewhere_that_points_its_name_here_gets_nothing(host: str) -> None:
    drawn = Drawn()
    for address in ("/", "/api/status", "/api/view"):
        assert ask(address, application=made(drawn), HTTP_HOST=host).status == 421
    assert not drawn.asked


def test_pages_elsewhere_cannot_make_the_station_draw() -> None:
    drawn = Drawn()

    def foreign(address: str, mode: str) -> int:
        application = made(drawn)
        return ask(
            address,
            application=application,
            HTTP_SEC_FETCH_SITE="cross-site",
            HTTP_SEC_FETCH_MODE=mode,
        ).status

    assert foreign("/api/view", "no-cors") == 403
    assert not drawn.asked
    assert foreign("/", "navigate") == 200  # a link to the page is no attack


@pytest.mark.parametrize(
    "address",
    ["/..", "/../process.py", "/page/../../process.py", "//etc/passwd", "/etc/passwd",
     "/index.html", "/viewer/", "/viewer/../page.js", "/viewer/index.html", "/viewer//etc/passwd",
     "/api", "", "/api/status/", "/page.js\0", "/\xff", "/api/tare", "page.js"],
)  # fmt: skip
def test_there_is_nothing_else(address: str) -> None:
    assert ask(address).status == 404


def test_parts_of_the_view_name_the_next_question() -> None:
    drawn = Drawn()
    application = made(drawn)
    reply = ask("/api/view", application=application)
    assert (reply.status, reply.body) == (200, b"rrd")
    reply = ask(
        "/api/view", application=application, query="after=" + reply.headers["Palpate-Place"]
    )
    assert (reply.status, reply.body) == (204, b"")
    assert drawn.asked == ["", "run-1-1"]


def test_files_of_the_viewer_are_kept_by_browsers_and_checked() -> None:
    reply = ask("/viewer/re_viewer.js")
    assert (reply.status, reply.body) == (200, b"js")
    assert reply.headers["Content-Encoding"] == "gzip"
    assert ask("/viewer/re_viewer.js", HTTP_IF_NONE_MATCH=reply.headers["ETag"]).status == 304
    prepared = ask("/viewer/re_viewer_bg.wasm")
    assert (prepared.status, prepared.headers["Retry-After"]) == (503, "1")


def test_why_there_is_no_viewer_reaches_the_browser(
    monkeypatch: pytest.MonkeyPatch, wait_until: WaitUntil
) -> None:
    tries = []

    def fetch() -> dict[str, bytes]:
        tries.append(1)
        raise OSError("no room")

    monkeypatch.setattr(viewer_files, "fetch_viewer_files", fetch)
    app = WebApplication([], Health("web", "web"), Drawn(), viewer_files.ViewerFiles(), "1")

    def said() -> bytes:
        return ask("/viewer/re_viewer.js", application=app).body

    wait_until(lambda: b"no room" in said(), PATIENCE_S, "it says why")
    assert all(b"no room" in said() for _ in range(20))
    assert len(tries) == 1, "its program is not started at each question"
    monkeypatch.setattr(viewer_files, "AGAIN_S", 0.0)
    wait_until(lambda: b"no room" in said() and len(tries) > 1, PATIENCE_S, "it tries again")


def test_without_a_live_view_there_are_no_parts_and_the_page_stays() -> None:
    application = WebApplication([], Health("web", "web"))
    assert ask("/", application=application).status == 200
    assert ask("/api/status", application=application).status == 503  # not looked yet
    for address in ("/live", "/api/view", "/viewer/re_viewer.js"):
        assert ask(address, application=application).status == 404


@pytest.mark.parametrize(
    "listen", ["7480", "127.0.0.1:0", "127.0.0.1", ":7480x", "127.0.0.1:70000"]
)
def test_an_address_that_is_none(listen: str) -> None:
    with pytest.raises(ConfigError, match=r"web\.listen"):
        parse_profile({"web": {"listen": listen}}, where="lab.toml")


def test_the_page_is_served_on_loopback_and_only_if_it_is_named() -> None:
    assert "web" not in Profile().processes
    assert WebConfig().listen == "127.0.0.1:7480"
    named = parse_profile({"web": {"listen": "0.0.0.0:80"}}, where="lab.toml")
    assert named.web.listen == "0.0.0.0:80"


Fetch = Callable[..., tuple[int, bytes]]


@contextmanager
def serving(link: LinkConfig, port: int) -> Iterator[Fetch]:
    """The process, and a question to it; status 0 = it does not answer."""
    stop = threading.Event()
    config = WebConfig(listen=f"127.0.0.1:{port}", live=False)
    process = threading.Thread(target=run_web, args=(config, link, "lab", stop))
    process.start()

    def fetch(address: str, method: str = "GET") -> tuple[int, bytes]:
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)) as to:
            try:
                to.request(method, address)
                reply = to.getresponse()
                return reply.status, reply.read()
            except OSError:
                return 0, b""

    try:
        yield fetch
    finally:
        stop.set()
        process.join(PATIENCE_S)
    assert not process.is_alive()


def test_a_station_is_shown_while_it_runs_and_said_to_be_gone_afterwards(
    link: LinkConfig, free_port: int, wait_until: WaitUntil
) -> None:
    with Session.open(link) as session, serving(link, free_port) as fetch:
        health = Health("features", "features")
        health.set_state(ServiceState.READY)
        reporter = HealthReporter(session, health, period_s=0.1)
        presence = session.presence("features", instance="features")
        presence.ready()

        def status() -> dict[str, Any]:
            code, body = fetch("/api/status")
            return json.loads(body) if code == 200 else {}

        wait_until(lambda: status().get("answers", False), PATIENCE_S, "the station answers")
        names = [one["service"] for one in status()["processes"]]
        assert "features" in names
        reporter.close()
        presence.close()
        wait_until(lambda: not status()["answers"], PATIENCE_S, "the page says that it is gone")


def first_shown(
    session: Session, link: LinkConfig, port: int, wait_until: WaitUntil
) -> tuple[str, dict[str, Any]]:
    """The state of ``features`` in the first status that a page shows, and all of that status."""
    session.presence("features", instance="features").ready()
    with serving(link, port) as fetch:
        wait_until(lambda: fetch("/api/status")[0] == 200, PATIENCE_S, "it is shown")
        told = json.loads(fetch("/api/status")[1])
    states = {one["service"]: one["state"] for one in told["processes"]}
    return states["features"], told


def test_nobody_is_shown_as_silent_before_it_could_tell(
    link: LinkConfig, free_port: int, wait_until: WaitUntil, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "SILENT_S", PATIENCE_S)
    health = Health("features", "features")
    health.set_state(ServiceState.READY)
    with Session.open(link) as session, HealthReporter(session, health):
        state, told = first_shown(session, link, free_port, wait_until)
    assert state == "ready"
    assert told["troubles"] == []


def test_who_never_tells_is_shown_as_silent_after_a_while(
    link: LinkConfig, free_port: int, wait_until: WaitUntil, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "SILENT_S", 2.0)
    with Session.open(link) as session:
        state, _ = first_shown(session, link, free_port, wait_until)
    assert state == "silent"


def test_slow_and_broken_clients_do_not_hold_up_others(
    link: LinkConfig, free_port: int, wait_until: WaitUntil
) -> None:
    with serving(link, free_port) as fetch:
        wait_until(lambda: fetch("/api/status")[0] == 200, PATIENCE_S, "it serves")
        held = [
            socket.create_connection(("127.0.0.1", free_port), timeout=PATIENCE_S)
            for _ in range(web.CONNECTIONS_MOST // 2)
        ]
        try:
            for number, one in enumerate(held):
                # Half of a request; nonsense; a request whose answer nobody reads.
                one.sendall(
                    (b"GET / HT", b"\x16\x03\x01\0" * 9, b"GET / HTTP/1.1\r\n\r\n" * 50)[number % 3]
                )
            for _ in range(5):
                assert fetch("/")[0] == 200
            assert fetch("/" + "a" * 100_000)[0] in (0, 400, 431)
            assert fetch("/api/status")[0] == 200
            assert fetch("/", "POST")[0] == 405
            assert fetch("/%2e%2e/process.py")[0] == 404
            assert fetch("/../process.py")[0] == 404
        finally:
            for one in held:
                one.close()


@contextmanager
def serving_a_large_file(port: int) -> Iterator[Callable[[], int]]:
    """The server alone, with a viewer's file of 14 MB; how it answers a question for its status."""
    drawn = Drawn()
    drawn.find = lambda name: b"w" * 14_000_000  # type: ignore[method-assign]
    config = WebConfig(listen=f"127.0.0.1:{port}")

    def status() -> int:
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)) as to:
            to.request("GET", "/api/status")
            return to.getresponse().status

    with web._serving(made(drawn), config):
        yield status


def not_reading(port: int, *, questions: int) -> socket.socket:
    """A connection that asks for the large file and takes next to nothing of it."""
    held = socket.socket()
    held.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    held.settimeout(PATIENCE_S)
    held.connect(("127.0.0.1", port))
    held.sendall(b"GET /viewer/re_viewer_bg.wasm HTTP/1.1\r\nHost: localhost\r\n\r\n" * questions)
    return held


def test_answers_that_nobody_reads_keep_no_thread(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many were asked for in one breath, and however long they may lie there."""
    monkeypatch.setattr(web, "IDLE_S", 3600)
    with ExitStack() as held, serving_a_large_file(free_port) as status:
        for _ in range(2 * web._THREADS):
            held.enter_context(not_reading(free_port, questions=6))
        assert [status() for _ in range(5)] == [200] * 5


def set_wall_clock(monkeypatch: pytest.MonkeyPatch, by_s: float) -> None:
    """Set it, when what has been asked for lies there by the clock as it was."""
    time.sleep(0.5)
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + by_s)


@pytest.mark.parametrize("step_s", [0.0, -3600.0])
def test_connections_whose_answer_nobody_reads_are_closed(
    free_port: int, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    monkeypatch.setattr(web, "CONNECTIONS_MOST", 5)
    monkeypatch.setattr(web, "IDLE_S", 1)
    with ExitStack() as held, serving_a_large_file(free_port) as status:
        for _ in range(20):
            held.enter_context(not_reading(free_port, questions=1))
        set_wall_clock(monkeypatch, step_s)
        assert status() == 200


def test_a_wall_clock_that_is_set_forward_closes_no_connection(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "IDLE_S", 3600)
    with serving_a_large_file(free_port) as status, not_reading(free_port, questions=1) as slow:
        came = len(slow.recv(1000))
        set_wall_clock(monkeypatch, 7200.0)
        assert [status() for _ in range(5)] == [200] * 5
        while some := slow.recv(1 << 20):
            came += len(some)
    assert came > 14_000_000


def test_a_name_of_two_addresses_is_served_and_stopped(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    resolve, addresses = socket.getaddrinfo, ("127.0.0.1", "127.0.0.2")
    with monkeypatch.context() as patch:
        patch.setattr(
            socket,
            "getaddrinfo",
            lambda _, *rest: [one for host in addresses for one in resolve(host, *rest)],
        )
        serving = web._serving(made(), WebConfig(listen=f"localhost:{free_port}"))
        serving.__enter__()
    try:
        for address in addresses:
            with closing(http.client.HTTPConnection(address, free_port, timeout=PATIENCE_S)) as to:
                to.request("GET", "/api/status")
                assert to.getresponse().status == 200
    finally:
        serving.__exit__(None, None, None)


def test_more_connections_than_there_may_be_wait_and_are_served_later(
    link: LinkConfig, free_port: int, wait_until: WaitUntil, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "CONNECTIONS_MOST", 5)
    monkeypatch.setattr(web, "IDLE_S", 1)
    with serving(link, free_port) as fetch:
        wait_until(lambda: fetch("/api/status")[0] == 200, PATIENCE_S, "it serves")
        held = [socket.create_connection(("127.0.0.1", free_port)) for _ in range(20)]
        try:
            # They say nothing, and are closed: then it is this one's turn.
            assert fetch("/api/status")[0] == 200
        finally:
            for one in held:
                one.close()


def test_a_port_in_use_is_said(link: LinkConfig, free_port: int) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", free_port))
        taken.listen()
        config = WebConfig(listen=f"127.0.0.1:{free_port}", live=False)
        with pytest.raises(LinkError, match=f"127.0.0.1:{free_port}") as caught:
            run_web(config, link, "lab", threading.Event())
    assert "[web] listen" in caught.value.remedy


def test_the_router_is_no_process_that_answers() -> None:
    alone = [ObservedProcess(ProcessReport(*ROUTER, True, True, None))]
    found = snapshot("lab", alone, router=True, own=OWN)
    assert not found["answers"]
    assert found["troubles"] == []


def test_stopping_takes_no_longer_than_a_moment_while_clients_hang(
    link: LinkConfig, free_port: int, wait_until: WaitUntil
) -> None:
    with serving(link, free_port) as fetch:
        wait_until(lambda: fetch("/")[0] == 200, PATIENCE_S, "it serves")
        held = socket.create_connection(("127.0.0.1", free_port))
        held.sendall(b"GET /page.js HT")
        time.sleep(0.2)
    held.close()
