"""Simulation messages: what changed since the first contract, and an answer in several parts."""

from __future__ import annotations

import contextlib
import dataclasses
import queue
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh

from palpate.bus import MAX_PAYLOAD_BYTES, Cancellation, QueryAnswer, Session, endpoints
from palpate.bus.presence import CallerWatch
from palpate.bus.topics import caller_key
from palpate.client import Client
from palpate.client.simulations import ask_simulation, join, straight_path
from palpate.codec import SIMULATION_REPLY
from palpate.config import LinkConfig
from palpate.errors import (
    ErrorCode,
    LinkError,
    PalpateError,
    RemoteError,
    ReplicaDiffers,
    SimulationError,
    WireError,
)
from palpate.messages import (
    Pose,
    SimulationOutcome,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
)
from palpate.v1 import simulation_pb2

MESH = bytes(range(32))
WaitUntil = Callable[..., None]


def a_step(value: float = 1.0 / 3.0) -> SimulationStep:
    numbers = np.array([value, -value, value * np.pi])
    return SimulationStep(Pose((0.0, 0.0, value), (1.0, 0.0, 0.0, 0.0)), numbers, numbers, value)


def part(first: int, count: int = 1, **more: Any) -> SimulationReply:
    steps = tuple(a_step(first + k + 0.1) for k in range(count))
    return SimulationReply("r", MESH, steps, **{"more": True, "first_step": first, **more})


LAST = SimulationReply(
    "r", b"", (), "pinched", more=False, outcome=SimulationOutcome.FORCE_LIMIT, travel_m=1e-3
)


def test_a_reply_of_the_first_contract_still_means_what_it_meant() -> None:
    """Before `wrench`, forces were float32 only; before `more`, one message was the answer."""
    message = simulation_pb2.SimulationReply.FromString(
        SIMULATION_REPLY.encode(SimulationReply("r", MESH, (a_step(),), "why", 1.0))
    )
    del message.steps[0].wrench[:]
    old = SIMULATION_REPLY.decode(message.SerializeToString())
    np.testing.assert_array_equal(old.steps[0].force, a_step().force.astype(np.float32))
    joined = join([old])
    assert (joined.stopped_because, joined.outcome) == ("why", SimulationOutcome.UNSPECIFIED)


def test_forces_cross_the_wire_to_the_last_bit() -> None:
    (step,) = SIMULATION_REPLY.decode(SIMULATION_REPLY.encode(part(0))).steps
    assert step.force.dtype == np.float64
    np.testing.assert_array_equal(step.force, a_step(0.1).force)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"force": np.array([0.0, np.nan, 0.0])}, "force"),
        ({"force": np.zeros(2)}, "force"),
        ({"contact_area_m2": -1.0}, "contact_area_m2"),
        ({"centre_of_pressure": np.array([np.inf, 0.0, 0.0])}, "centre_of_pressure"),
        ({"fluid_pressure_pa": float("nan")}, "fluid_pressure_pa"),
    ],
)
def test_a_broken_step_is_refused(changes: dict[str, Any], named: str) -> None:
    reply = dataclasses.replace(part(0), steps=(dataclasses.replace(a_step(), **changes),))
    with pytest.raises(WireError, match=named):
        SIMULATION_REPLY.encode(reply)


def test_only_a_message_without_steps_may_have_no_mesh() -> None:
    SIMULATION_REPLY.decode(SIMULATION_REPLY.encode(LAST))
    with pytest.raises(WireError, match="mesh_sha256"):
        SIMULATION_REPLY.encode(dataclasses.replace(part(0), mesh_sha256=b""))


@pytest.mark.parametrize(
    ("field", "value"), [("outcome", 99), ("travel_m", -1.0), ("elapsed_s", float("inf"))]
)
def test_a_reply_without_meaning_is_refused(field: str, value: float) -> None:
    message = simulation_pb2.SimulationReply.FromString(SIMULATION_REPLY.encode(LAST))
    setattr(message, field, value)
    with pytest.raises(WireError, match=field):
        SIMULATION_REPLY.decode(message.SerializeToString())


def test_parts_are_joined() -> None:
    progress = SimulationProgress("r", 1, 3, 0.5)
    told: list[SimulationProgress] = []
    seen: list[int] = []
    whole = join(
        [
            SimulationReply("r", b"", (), more=True, progress=progress),
            part(0),
            part(1, 2),
            LAST,
        ],
        on_progress=told.append,
        on_step=lambda index, _: seen.append(index),
    )
    assert told == [progress]
    assert seen == [0, 1, 2]
    assert len(whole.steps) == 3
    assert whole.forces.shape == (3, 3)
    assert (whole.mesh_sha256, whole.more, whole.first_step) == (MESH, False, 0)
    assert (whole.outcome, whole.stopped_because) == (SimulationOutcome.FORCE_LIMIT, "pinched")


@pytest.mark.parametrize("parts", [[part(0), part(2), LAST], [part(0)], []])
def test_a_lost_part_is_noticed(parts: list[SimulationReply]) -> None:
    with pytest.raises(WireError) as caught:
        join(parts)
    assert caught.value.reason == "incomplete"


def test_straight_path() -> None:
    path = straight_path((0.0, 0.0, -0.010), (0.0, 0.0, -0.006), 4)
    assert [round(pose.position[2], 6) for pose in path] == [-0.010, -0.009, -0.008, -0.007, -0.006]
    assert path[0].orientation == (1.0, 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="0 steps"):
        straight_path((0, 0, 0), (0, 0, 1), 0)


Answers = list[QueryAnswer[SimulationReply]]
REQUEST = SimulationRequest("r", "sphere", straight_path((0, 0, -0.01), (0, 0, -0.008), 2))


@pytest.fixture
def answers() -> Answers:
    """Answers that a server has in hand."""
    return []


@pytest.fixture
def robot(link: LinkConfig, answers: Answers, wait_until: WaitUntil) -> Iterator[Client]:
    """A client of a server that takes questions and leaves the answering to the test."""

    def handler(request: SimulationRequest, answer: QueryAnswer[SimulationReply]) -> None:
        if request.indenter == "unknown":
            raise SimulationError("no such indenter", remedy="choose another")
        answers.append(answer)

    with Session.open(link) as server, Client(link.connect[0]) as client:
        server.stream_queryable(endpoints.SIMULATE, handler, sensor="twin", capacity=2)
        probe = dataclasses.replace(REQUEST, indenter="unknown")

        def serves() -> bool:
            try:
                client.simulate(probe)
            except LinkError:
                return False
            except RemoteError:
                return True
            raise AssertionError("it must refuse")

        wait_until(serves)
        yield client


def in_thread(ask: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    """Result, or exception, of a call in a thread."""
    out: list[Any] = []

    def run() -> None:
        try:
            out.append(ask())
        except Exception as error:
            out.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, out


def test_steps_arrive_before_the_answer_has_ended(
    robot: Client, answers: Answers, wait_until: WaitUntil
) -> None:
    seen: list[int] = []
    thread, out = in_thread(
        lambda: robot.simulate(REQUEST, on_step=lambda index, _: seen.append(index))
    )
    wait_until(lambda: answers)
    answers[0].send(part(0))
    wait_until(lambda: seen == [0])
    assert thread.is_alive()
    answers[0].send(part(1))
    answers[0].send(LAST)
    answers[0].end()
    answers[0].send(part(2))  # too late: nobody hears it, nothing breaks
    answers[0].fail(SimulationError("a", remedy="b"))
    thread.join(5)
    assert len(out[0].steps) == 2


def test_an_error_after_some_steps(robot: Client, answers: Answers, wait_until: WaitUntil) -> None:
    seen: list[int] = []
    thread, out = in_thread(
        lambda: robot.simulate(REQUEST, on_step=lambda index, _: seen.append(index))
    )
    wait_until(lambda: answers)
    answers[0].send(part(0))
    answers[0].fail(SimulationError("the solver died", remedy="ask again"))
    thread.join(5)
    assert isinstance(out[0], RemoteError)
    assert out[0].code is ErrorCode.SIMULATION
    assert seen == [0]


def test_a_reply_larger_than_a_message_is_not_sent(
    robot: Client, answers: Answers, wait_until: WaitUntil
) -> None:
    nodes = MAX_PAYLOAD_BYTES // 12
    fields = np.zeros((nodes, 3), np.float32)
    large = dataclasses.replace(
        part(0), steps=(dataclasses.replace(a_step(), displacement=fields),)
    )
    fits = dataclasses.replace(
        part(0), steps=(dataclasses.replace(a_step(), displacement=fields[: nodes - 100]),)
    )
    thread, out = in_thread(lambda: robot.simulate(REQUEST))
    wait_until(lambda: answers)
    with pytest.raises(WireError) as caught:
        answers[0].send(large)
    assert caught.value.reason == "size"
    answers[0].send(fits)  # the largest that is sent does arrive
    answers[0].send(LAST)
    answers[0].end()
    thread.join(10)
    assert out[0].steps[0].displacement.shape == (nodes - 100, 3)


def test_who_waits_no_longer_is_noticed(
    link: LinkConfig,
    robot: Client,
    answers: Answers,
    wait_until: WaitUntil,
) -> None:
    gone: dict[str, float] = {}
    with Session.open(link) as watcher:
        watcher.watch_callers(gone.__setitem__)
        time.sleep(0.2)
        thread, _ = in_thread(lambda: robot.simulate(REQUEST))
        wait_until(lambda: answers)
        assert caller_key("lab", "r") not in gone
        before_s = time.monotonic()
        answers[0].fail(SimulationError("a", remedy="b"))
        thread.join(5)
        wait_until(lambda: list(gone) == [caller_key("lab", "r")])
        assert before_s < gone[caller_key("lab", "r")] < time.monotonic()
        first = robot.session.caller_token("again")
        with robot.session.caller_token("again"):  # the same question, asked a second time
            first.close()
            time.sleep(0.3)
            assert caller_key("lab", "again") not in gone
        wait_until(lambda: caller_key("lab", "again") in gone)


def test_a_look_that_fails_hides_no_caller_that_is_gone() -> None:
    """Its error was taken for a token, and the simulation went on for nobody."""
    told: queue.SimpleQueue[str] = queue.SimpleQueue()
    heard: list[Callable[[Any], None]] = []

    def declared(_: str, on_sample: Callable[[Any], None], *, history: bool) -> object:
        heard.append(on_sample)
        return SimpleNamespace(undeclare=lambda: None)

    failed = SimpleNamespace(ok=None, err="Timeout")
    looks = SimpleNamespace(get=lambda *_, **__: [failed], declare_subscriber=declared)
    session: Any = SimpleNamespace(liveliness=lambda: looks)
    key = caller_key("lab", "r")
    with CallerWatch(session, caller_key("lab", "*"), lambda gone, _: told.put(gone)):
        heard[0](SimpleNamespace(kind=zenoh.SampleKind.DELETE, key_expr=key))
        assert told.get(timeout=5.0) == key


class TwoServices:
    """A session of which the first service is lost after some steps, and another one takes over."""

    def __init__(self, first: list[SimulationReply], second: list[SimulationReply]) -> None:
        self._answers = [first, second]

    def caller_token(self, request_id: str) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def holders(self, *_: Any) -> list[Any]:
        return [SimpleNamespace(instance=name, sensor="twin") for name in ("one", "two")]

    def query_stream(self, *_: Any, **__: Any) -> Iterator[SimulationReply]:
        parts = self._answers.pop(0)
        yield from parts
        if parts[-1].more:
            raise LinkError("it was lost", remedy="look for it")


def with_force(reply: SimulationReply, factor: float) -> SimulationReply:
    """The same reply with other forces."""
    steps = tuple(dataclasses.replace(one, force=one.force * factor) for one in reply.steps)
    return dataclasses.replace(reply, steps=steps)


def test_steps_of_two_services_that_went_different_ways_are_not_joined() -> None:
    begun = [part(0), part(1)]
    request = SimulationRequest("r", "cube", straight_path((0, 0, -0.02), (0, 0, -0.01), 3))

    def ask(factor: float, on_step: Callable[[int, SimulationStep], None] | None) -> Any:
        parts = [part(0), with_force(part(1), factor), part(2), LAST]
        session: Any = TwoServices(begun, parts)
        return ask_simulation(session, request, sensor="twin", timeout_s=20.0, on_step=on_step)

    told: list[int] = []
    assert len(ask(1.001, lambda number, _: told.append(number)).steps) == 3
    assert told == [0, 1, 2], "rounding is no difference"
    told.clear()
    with pytest.raises(ReplicaDiffers, match=r"step 2 their forces are 0\.\d+ N apart"):
        ask(1.02, lambda number, _: told.append(number))
    assert told == [0, 1]
    assert len(ask(1.02, None).steps) == 3, "the reply is of the second one alone"


@pytest.mark.parametrize(
    "error",
    [
        LinkError("the gripper is not connected", remedy="connect it"),
        RemoteError("the arm is busy", remedy="wait", code=ErrorCode.UNAVAILABLE),
    ],
)
@pytest.mark.parametrize("what", ["on_step", "on_progress"])
def test_an_error_of_the_caller_itself_asks_no_other_service(
    error: PalpateError, what: str
) -> None:
    told: list[object] = []

    def fail(*values: object) -> None:
        told.append(values)
        raise error

    begun = part(0, progress=SimulationProgress("r", 1, 2, 0.5))
    session: Any = TwoServices([begun, LAST], [begun, LAST])
    with pytest.raises(type(error)) as caught:
        ask_simulation(session, REQUEST, sensor="twin", timeout_s=20.0, **{what: fail})
    assert caught.value is error
    assert len(told) == 1


def test_a_cancelled_simulation_is_asked_of_no_other_service() -> None:
    cancellation = Cancellation()
    session: Any = TwoServices([part(0), part(1)], [part(0), part(1), LAST])
    with cancellation, pytest.raises(LinkError, match="it was lost"):
        ask_simulation(
            session,
            REQUEST,
            sensor="twin",
            timeout_s=20.0,
            on_step=lambda number, _: cancellation.cancel() if number == 1 else None,
        )
