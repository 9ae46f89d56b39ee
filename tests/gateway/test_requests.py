"""Requests that need a sensor's readings: no one can keep the sensor from others."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from palpate.bus import Session, endpoints
from palpate.bus.topics import ELECTRODES
from palpate.client.estimates import ask_tare
from palpate.errors import ErrorCode, RemoteError
from palpate.messages import ServiceState, TareRequest
from palpate_gateway.service.requests import MOST, SensorRequests
from palpate_gateway.virtual.faults import FaultPlan

PATIENCE_S = 20.0
RATE_HZ = 200

ASKER = """
import sys
from palpate.bus import Session
from palpate.client.estimates import ask_tare
from palpate.config import LinkConfig
with Session.open(LinkConfig(connect=(sys.argv[1],), wait_for_router_s=60)) as session:
    print("asks", flush=True)
    ask_tare(session, "finger", frames=int(sys.argv[2]), timeout_s=20)
"""


@pytest.fixture
def finger() -> dict[str, Any]:
    options = {"model": "formula", "rate_hz": RATE_HZ, "untouched_s": 600}
    return {"sensors": [{"driver": "virtual", "options": options}], "tare_frames": 20}


def code_of(bus: Any, **request: Any) -> tuple[ErrorCode, str]:
    with pytest.raises(RemoteError) as caught:
        bus.ask_tare("finger", **request)
    return caught.value.code, str(caught.value)


@pytest.mark.parametrize("frames", [1, 10 * RATE_HZ + 1, 2**31, 2**32 - 1])
def test_more_than_ten_seconds_are_refused(bus: Any, finger: dict[str, Any], frames: int) -> None:
    """One frame ended the gateway; 2**31 were waited for, and kept, for months."""
    with bus.gateway(finger) as running:
        bus.state(ServiceState.READY)
        code, text = code_of(bus, frames=frames)
        assert code is ErrorCode.INVALID_REQUEST
        assert "'finger'" in text
        assert f"2 to {10 * RATE_HZ} frames" in text
        assert bus.ask_tare("finger", frames=2).frames_averaged == 2
        assert running.error is None


def test_a_look_up_and_a_short_tare_wait_for_no_long_one(bus: Any, finger: dict[str, Any]) -> None:
    """Two long ones disabled the sensor: no look-up and no other tare was answered."""
    with bus.gateway(finger), ThreadPoolExecutor(8) as pool:
        bus.state(ServiceState.READY)
        first = bus.ask_tare("finger", frames=5)
        long = [pool.submit(bus.ask_tare, "finger", 0, 10 * RATE_HZ) for _ in range(4)]
        bus.until(lambda: threads_named("tare of finger") == 4)
        for _ in range(20):
            assert bus.ask_tare("finger", tare_id=first.tare_id).tare_id == first.tare_id
        assert bus.ask_tare("finger", frames=5).frames_averaged == 5
        assert not any(one.done() for one in long)
        assert {one.result(PATIENCE_S).frames_averaged for one in long} == {10 * RATE_HZ}


def threads_named(name: str) -> int:
    return sum(thread.name == name for thread in threading.enumerate())


def test_beyond_a_number_they_are_refused_with_a_time_to_come_back(
    bus: Any, finger: dict[str, Any]
) -> None:
    with bus.gateway(finger), ThreadPoolExecutor(MOST) as pool:
        bus.state(ServiceState.READY)
        long = [pool.submit(bus.ask_tare, "finger", 0, 1000) for _ in range(MOST)]
        bus.until(lambda: threads_named("tare of finger") == MOST)
        (error,) = bus.session.query_all(
            endpoints.TARE, TareRequest(frames=5), sensor="finger", timeout_s=PATIENCE_S
        )
        assert isinstance(error, RemoteError)
        assert error.code is ErrorCode.RESOURCE_EXHAUSTED
        assert 0.0 < error.retry_after_s <= 5.0
        # Who asks once more when it is told to is answered.
        assert bus.ask_tare("finger", frames=5).frames_averaged == 5
        assert all(one.result(PATIENCE_S).frames_averaged == 1000 for one in long)


def test_who_leaves_is_not_worked_for(bus: Any, finger: dict[str, Any]) -> None:
    """Its tare does not come into force either: nobody knows of it."""
    frames = 5 * RATE_HZ
    with bus.gateway({**finger, "tare": "query"}):
        bus.state(ServiceState.READY)
        asker = subprocess.Popen(
            [sys.executable, "-c", ASKER, bus.link.connect[0], str(frames)],
            stdout=subprocess.PIPE,
        )
        try:
            bus.until(lambda: threads_named("tare of finger") == 1)
        finally:
            asker.kill()
            asker.wait()
        bus.until(lambda: threads_named("tare of finger") == 0)
        seen = bus.status().counters["frames_published"]
        bus.until(lambda: bus.status().counters["frames_published"] > seen + frames)
        assert bus.status().counters["tares"] == 0


def test_a_caller_without_a_token_is_worked_for_until_its_deadline(
    bus: Any, finger: dict[str, Any]
) -> None:
    with bus.gateway(finger):
        bus.state(ServiceState.READY)
        bus.session.query_all(
            endpoints.TARE, TareRequest(frames=2000), sensor="finger", timeout_s=0.3
        )
        bus.until(lambda: threads_named("tare of finger") == 0)
        seen = bus.status().counters["frames_published"]
        assert seen < 2000


@pytest.mark.parametrize("told_first", [False, True])
@pytest.mark.parametrize(("arrived_s", "dropped"), [(1, True), (3, False)])
def test_who_leaves_while_its_question_waits_to_be_taken_is_not_worked_for(
    told_first: bool, arrived_s: int, dropped: bool
) -> None:
    """What arrived after it left belongs to its next call."""
    requests: SensorRequests[Any] = SensorRequests(
        "finger", what="tare", readings="frames", rate_hz=RATE_HZ
    )
    wanted: Future[Any] = Future()
    answer: Any = Mock(arrived_ns=arrived_s * 10**9, deadline_s=math.inf)
    for told in (told_first, not told_first):
        if told:
            requests.caller_gone("a caller", 2.0)
        else:
            requests.serve(
                answer, lambda: wanted, caller="a caller", readings=1, in_turn=False, slack_s=20.0
            )
    assert wanted.cancelled() is dropped
    wanted.cancel()


def test_callers_of_others_end_nothing(bus: Any, finger: dict[str, Any]) -> None:
    with bus.gateway(finger), Session.open(bus.link) as other:
        bus.state(ServiceState.READY)
        with ThreadPoolExecutor(1) as pool:
            tare = pool.submit(ask_tare, other, "finger", frames=RATE_HZ, timeout_s=PATIENCE_S)
            bus.until(lambda: threads_named("tare of finger") == 1)
            for name in ("a", "b"):
                bus.session.caller_token(name).close()
            assert tare.result(PATIENCE_S).frames_averaged == RATE_HZ


def test_requests_end_with_the_sensor(
    bus: Any, tape_path: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not with an average over frames of before and after."""
    due = [False]

    def restart(_: FaultPlan, tick: int) -> int | None:
        now, due[0] = due[0], False
        return 0 if now else None

    monkeypatch.setattr(FaultPlan, "restart", restart)
    options = {"tape": str(tape_path()), "rate_hz": RATE_HZ, "untouched_s": 600}
    values = {"sensors": [{"driver": "virtual", "options": options}], "tare_frames": 20}
    with bus.gateway(values), ThreadPoolExecutor(1) as pool:
        bus.state(ServiceState.READY)
        asked = pool.submit(bus.ask_tare, "finger", 0, 10 * RATE_HZ)
        bus.until(lambda: threads_named("tare of finger") == 1)
        due[0] = True
        with pytest.raises(RemoteError, match="not tared: ") as caught:
            asked.result(PATIENCE_S)
        assert caught.value.code is ErrorCode.DEVICE
        bus.session.subscriber(ELECTRODES).next(PATIENCE_S)
        bus.state(ServiceState.READY)
        assert bus.ask_tare("finger", frames=10).frames_averaged == 10
