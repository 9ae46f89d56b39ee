"""The finite-element service in trouble: workers that die, hang or do not start; stopping."""

from __future__ import annotations

import dataclasses
import importlib
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from palpate.errors import ErrorCode, PalpateError, RemoteError
from palpate.messages import (
    ServiceState,
    SimulationOutcome,
    SimulationParameters,
    SimulationPhase,
    SimulationProgress,
)

fakes: Any = importlib.import_module("fem_fakes")

PATIENCE_S = 20.0


@pytest.mark.parametrize(
    ("kind", "code", "said"),
    [
        (fakes.DIES, ErrorCode.INTERNAL, "exit status 7"),
        (fakes.SEGFAULTS, ErrorCode.INTERNAL, "SIGSEGV"),
        (fakes.DEFECTIVE, ErrorCode.INTERNAL, "ZeroDivisionError"),
        (fakes.REFUSES, ErrorCode.SIMULATION, "folded"),
        (fakes.NAN, ErrorCode.SIMULATION, "not finite"),
    ],
)
def test_trouble_is_its_own_clients_only(
    service: Any, kind: float, code: ErrorCode, said: str
) -> None:
    other, out = service.in_thread(fakes.request("good", fakes.SLOW))
    time.sleep(0.1)
    seen: list[int] = []
    with pytest.raises(RemoteError, match=said) as caught:
        service.robot.simulate(
            fakes.request("trouble", kind, want_displacement=True),
            on_step=lambda index, _: seen.append(index),
        )
    assert caught.value.code is code
    assert seen == ([] if kind == fakes.NAN else [0, 1])  # what had converged had been sent
    other.join(PATIENCE_S)
    assert out[0].outcome is SimulationOutcome.COMPLETE
    assert service.robot.simulate(fakes.request("after")).outcome is SimulationOutcome.COMPLETE


def test_a_solver_that_does_not_stop_is_stopped(service: Any) -> None:
    reply = service.robot.simulate(fakes.request("stubborn", fakes.STUBBORN), timeout_s=0.3)
    assert reply.outcome is SimulationOutcome.DEADLINE
    assert len(reply.steps) == 2
    assert "did not stop" in reply.stopped_because
    thread, out = service.in_thread(fakes.request("stubborn too", fakes.STUBBORN))
    service.until(lambda: service.robot.cancel_simulation("stubborn too"))
    thread.join(PATIENCE_S)
    assert out[0].outcome is SimulationOutcome.CANCELLED
    assert service.robot.simulate(fakes.request("after")).outcome is SimulationOutcome.COMPLETE


def test_a_killed_worker_is_replaced(service: Any) -> None:
    before = service.counters()["worker_restarts"]
    first = threading.Event()
    thread, out = service.in_thread(
        fakes.request("killed", fakes.SLOW, steps=100), on_step=lambda *_: first.set()
    )
    assert first.wait(PATIENCE_S)
    killed = 0
    for path in Path(f"/proc/{os.getpid()}/task").glob("*/children"):
        for pid in map(int, path.read_text().split()):
            if b"palpate_fem.service.worker" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)
                killed += 1
    thread.join(PATIENCE_S)
    assert out[0].code is ErrorCode.INTERNAL
    assert "out of memory" in out[0].problem
    service.until(lambda: service.counters()["worker_restarts"] >= before + killed)
    assert service.robot.simulate(fakes.request("after")).outcome is SimulationOutcome.COMPLETE
    service.until(lambda: service.robot.status()[0].state is ServiceState.READY)


def test_stopping_answers_whoever_waits(serving: Any) -> None:
    with serving(workers=1) as served:
        running = [
            served.in_thread(fakes.request(f"s{k}", fakes.SLOW, steps=200)) for k in range(2)
        ]
        served.until(lambda: served.robot.status()[0].gauges["waiting_requests"] == 1)
        served.stop.set()
        for thread, out in running:
            thread.join(PATIENCE_S)
            assert out[0].code is ErrorCode.UNAVAILABLE
        served.thread.join(PATIENCE_S)
        assert not [a for a in served.robot.alive() if a.service == "fem"]


def test_a_request_before_the_first_fingertip_waits(starting: Any) -> None:
    served = starting(options={"fill_s": 1.0})
    served.until(lambda: served.robot.alive())
    told: list[SimulationProgress] = []
    reply = served.until(lambda: _try(served, told))
    assert reply.outcome is SimulationOutcome.COMPLETE
    assert told[0].phase is SimulationPhase.WAITING
    other = dataclasses.replace(
        fakes.request("thicker"),
        parameters=SimulationParameters(skin_thickness_m=1.2e-3, friction_coefficient=fakes.QUICK),
    )
    told.clear()
    served.robot.simulate(other, on_progress=told.append)
    assert SimulationPhase.PRESSURISING in [item.phase for item in told]
    with pytest.raises(RemoteError, match="no step converged"):
        served.robot.simulate(
            dataclasses.replace(other, parameters=SimulationParameters(skin_thickness_m=1.1e-3)),
            timeout_s=0.3,
        )


def _try(served: Any, told: list[SimulationProgress]) -> Any:
    try:
        return served.robot.simulate(fakes.request("early bird"), on_progress=told.append)
    except PalpateError:
        return None


@pytest.mark.parametrize(
    ("broken", "said"), [("no such mesh", "no such mesh"), ("dies", "exit status 9")]
)
def test_a_solver_that_does_not_even_start(starting: Any, broken: str, said: str) -> None:
    served = starting(workers=1, options={"broken": broken})
    served.thread.join(PATIENCE_S)
    assert isinstance(served.error, RemoteError)
    assert said in served.error.problem
