"""Two gateways that claim one sensor: one publishes, the other says why it does not."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from palpate.bus import Session, endpoints
from palpate.bus.topics import ELECTRODES
from palpate.codec import ELECTRODE_FRAME
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, StreamTimeout
from palpate.messages import ElectrodeFrame, SensorState, ServiceState, Status, TareRequest

PATIENCE_S = 20.0

GATEWAY = """
import json, sys, threading
from palpate.config import LinkConfig, parse_config
from palpate_gateway.config import GatewayConfig
from palpate_gateway.service import node
config = parse_config(GatewayConfig, json.loads(sys.argv[2]), where="test")
link = LinkConfig(connect=(sys.argv[1],))
node.run(config, link, "lab", threading.Event(), instance="child")
"""


def finger(**options: Any) -> dict[str, Any]:
    options = {"model": "formula", "rate_hz": 100, "untouched_s": 600, **options}
    return {"sensors": [{"driver": "virtual", "options": options}], "tare_frames": 20}


@contextmanager
def process(link: LinkConfig, values: dict[str, Any]) -> Iterator[subprocess.Popen[bytes]]:
    child = subprocess.Popen([sys.executable, "-c", GATEWAY, link.connect[0], json.dumps(values)])
    try:
        yield child
    finally:
        child.kill()  # also ends one that is stopped
        child.wait()


class Published:
    """What is published, from whichever gateway: a subscriber would follow only one of them."""

    def __init__(self, session: Session, sensor: str = "*") -> None:
        self._tap = session.tap([ELECTRODES], sensor=sensor)

    def next(self, timeout_s: float) -> ElectrodeFrame:
        return ELECTRODE_FRAME.decode(self._tap.next(timeout_s).payload)


def take(frames: Published, count: int) -> list[ElectrodeFrame]:
    return [frames.next(PATIENCE_S) for _ in range(count)]


def next_of_another(frames: Published, session_id: int) -> ElectrodeFrame:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        frame = frames.next(PATIENCE_S)
        if frame.stamp.session_id != session_id:
            return frame
    raise AssertionError("no frame of another gateway came")


def refused(bus: Any) -> Status:
    """The status of a gateway whose sensor is another's."""

    def look() -> Status | None:
        found = [one for one in bus.statuses() if one.state is ServiceState.DEGRADED]
        return found[0] if found else None

    status = bus.until(look)
    assert isinstance(status, Status)
    return status


def test_the_second_is_refused_and_takes_over(bus: Any) -> None:
    frames = Published(bus.session)
    with ExitStack() as stack:
        first = stack.enter_context(bus.gateway(finger(unit=1)))
        one = take(frames, 1)[0]
        second = stack.enter_context(bus.gateway(finger(unit=2), instance="spare"))
        status = refused(bus)
        assert status.instance == "spare"
        error = status.last_error
        assert error is not None
        assert error.code is ErrorCode.UNAVAILABLE
        for part in ("'finger'", "'lab'", one.sensor_serial, "'gateway'"):
            assert part in error.message
        assert "stop that gateway" in error.remedy
        assert status.sensor_states[0].state is SensorState.STARTING
        assert one.sensor_serial in status.sensor_states[0].message
        assert status.counters["frames_published"] == 0

        assert {frame.stamp.session_id for frame in take(frames, 100)} == {one.stamp.session_id}
        ready = bus.until(lambda: [a.instance for a in bus.session.alive() if a.ready])
        assert ready == ["gateway"]
        # Of two that answer, either might be asked.
        tares = bus.session.query_all(
            endpoints.TARE, TareRequest(frames=10), sensor="finger", timeout_s=PATIENCE_S
        )
        assert [tare.stamp.session_id for tare in tares] == [one.stamp.session_id]
        first.stop.set()
        first.thread.join(PATIENCE_S)
        assert next_of_another(frames, one.stamp.session_id).stamp.sequence == 1
        assert bus.state(ServiceState.READY).instance == "spare"
        assert second.error is None
        known = bus.ask_tare("finger", frames=10)
        assert known.stamp.session_id != one.stamp.session_id


def test_a_gateway_with_other_sensors_serves_them(bus: Any) -> None:
    values = finger()
    more = {"sensors": [*values["sensors"], {**values["sensors"][0], "name": "thumb"}]}
    with bus.gateway(values):
        take(Published(bus.session, "finger"), 1)
        with bus.gateway(more, instance="spare"):
            take(Published(bus.session, "thumb"), 10)
            status = refused(bus)
            assert status.counters["thumb.frames_published"] > 0
            assert status.counters["finger.frames_published"] == 0


def test_of_gateways_that_start_at_one_instant_one_publishes(bus: Any) -> None:
    frames = Published(bus.session)
    with ExitStack() as stack:
        for number in range(3):
            stack.enter_context(bus.gateway(finger(unit=number), instance=f"g{number}"))
        got = take(frames, 150)
    assert len({(frame.stamp.session_id, frame.sensor_serial) for frame in got}) == 1
    assert [frame.stamp.sequence for frame in got] == list(range(1, 151))


def test_a_recording_waits_for_its_turn(bus: Any, log: Callable[..., Any], tmp_path: Path) -> None:
    path = log(100).write(tmp_path / "a.btd")
    replay = {
        "sensors": [{"driver": "text_log", "options": {"path": path}}],
        "pace": "fast",
        "exit_at_end": True,
        "linger_s": 0.0,
    }
    frames = Published(bus.session)
    with ExitStack() as stack:
        live = stack.enter_context(bus.gateway(finger()))
        name = take(frames, 1)[0].stamp.session_id
        waiting = stack.enter_context(bus.gateway(replay, instance="replay"))
        assert refused(bus).instance == "replay"
        assert {frame.stamp.session_id for frame in take(frames, 50)} == {name}
        live.stop.set()
        waiting.thread.join(PATIENCE_S)
        assert waiting.error is None
    rest: list[ElectrodeFrame] = []
    while not rest or rest[-1].stamp.sequence != 100 or rest[-1].stamp.session_id:
        rest += take(frames, 1)
    assert [frame.stamp.sequence for frame in rest if not frame.stamp.session_id] == list(
        range(1, 101)
    )


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_one_that_dies_or_freezes_is_followed(bus: Any, end: signal.Signals) -> None:
    frames = Published(bus.session)
    with process(bus.link, finger(unit=1)) as child:
        one = take(frames, 1)[0]
        with bus.gateway(finger(unit=2), instance="spare"):
            assert "'child'" in refused(bus).message
            child.send_signal(end)
            other = next_of_another(frames, one.stamp.session_id)
            assert other.sensor_serial != one.sensor_serial
            if end is signal.SIGSTOP:
                bus.until(lambda: all(s.state is ServiceState.READY for s in bus.statuses()))
                child.send_signal(signal.SIGCONT)
                status = refused(bus)
                assert status.instance == "child"
                assert "'spare'" in status.message
                drain(frames)
                late = take(frames, 100)
                assert {frame.stamp.session_id for frame in late} == {other.stamp.session_id}


def drain(frames: Published) -> None:
    while True:
        try:
            frames.next(0.0)
        except StreamTimeout:
            return


def test_one_name_for_each_run(bus: Any) -> None:
    """And every stream of it, and the tare."""
    runs = set()
    for _ in range(2):
        with bus.consumer() as tap, bus.gateway(finger()):
            got = bus.take(tap, 200)
        names = {message.stamp.session_id for _, message in got}
        assert {"electrodes", "wrench", "pose", "tare"} <= {topic for topic, _ in got}
        assert len(names) == 1
        runs |= names
    assert len(runs) == 2
    assert 0 not in runs
