"""The finite-element service: answers to the last bit, refusals, deadlines, cancelling."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh

from palpate.bus import MAX_PAYLOAD_BYTES, Delivery
from palpate.bus.topics import ENCODING_PREFIX, SIMULATION_PROGRESS, caller_key, sensor_key
from palpate.client import Client
from palpate.client.simulations import straight_path
from palpate.codec import ERROR, SIMULATION_REQUEST
from palpate.config import LinkConfig, parse_config
from palpate.errors import ConfigError, ErrorCode, RemoteError, StreamTimeout
from palpate.health import Health
from palpate.messages import (
    SimulationOutcome,
    SimulationParameters,
    SimulationPhase,
    SimulationProgress,
    SimulationReply,
    SimulationRequest,
)
from palpate.rigid import path_lengths
from palpate.v1 import simulation_pb2
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.indenter.path import parse_segments
from palpate_fem.service import node
from palpate_fem.service.biotac import biotac
from palpate_fem.service.config import DEFAULT_FACTORY, FemConfig
from palpate_fem.service.fingertips import skin_of
from palpate_fem.service.requests import OUTCOMES, as_pose, as_step, path_of
from palpate_fem.trajectory import pad_point, segment_path

fakes: Any = importlib.import_module("fem_fakes")

PATIENCE_S = 20.0


def same(a: SimulationReply, b: SimulationReply) -> bool:
    """Equal to the last bit, but for the time it took."""
    first, second = (dataclasses.replace(reply, elapsed_s=0.0, steps=()) for reply in (a, b))
    return first == second and all(
        np.array_equal(getattr(x, field.name), getattr(y, field.name))
        if isinstance(getattr(x, field.name), np.ndarray)
        else getattr(x, field.name) == getattr(y, field.name)
        for x, y in zip(a.steps, b.steps, strict=True)
        for field in dataclasses.fields(x)
    )


def test_the_wire_changes_no_bit(service: Any) -> None:
    asked = fakes.request("bits", want_displacement=True, want_contact_force=True)
    told: list[SimulationProgress] = []
    seen: list[int] = []
    over_the_wire = service.robot.simulate(
        asked, on_progress=told.append, on_step=lambda index, _: seen.append(index)
    )
    tip = fakes.FakeTip(FingertipParameters(), 40)
    done = tip.indent(
        "sphere_medium", path_of(asked, max_steps=9), friction_coefficient=fakes.QUICK
    )
    here = SimulationReply(
        asked.request_id,
        tip.mesh.sha256,
        tuple(as_step(step, asked) for step in done.steps),
        done.reason,
        outcome=OUTCOMES[done.outcome],
        travel_m=done.travel_m,
    )
    assert over_the_wire.outcome is SimulationOutcome.COMPLETE
    assert over_the_wire.steps[-1].displacement is not None
    assert same(over_the_wire, here)
    assert seen == [0, 1, 2, 3, 4]
    assert told[-1].phase is SimulationPhase.INDENTING
    assert (told[-1].steps_done, told[-1].steps_total) == (5, 5)


def test_a_path_that_slides_twists_and_leaves_is_solved_over_the_wire(
    serving: Callable[..., Any],
) -> None:
    """By the solver itself: what comes back is what it gives in process."""
    parameters = FingertipParameters(fluid_volume_m3=0.6e-6)
    tip = biotac(edge_m=1.4e-3)(parameters, lambda _: None)
    skin = skin_of(tip.describe())
    target, normal = pad_point(skin, -6e-3, 0.0)
    words = "press 1 mm, slide 0.8 mm towards +y, twist 15 deg, unload"
    ball, segments = make_indenter("sphere_medium"), parse_segments(words)
    # Contact on so coarse a mesh closes 0.13 mm early.
    path = segment_path(ball, target, normal, segments, skin, step_m=0.2e-3, clearance_m=0.2e-3)
    asked = SimulationRequest(
        "slide",
        "sphere_medium",
        tuple(as_pose(pose) for pose in path),
        SimulationParameters(fluid_volume_m3=0.6e-6),
        want_contact_force=True,
    )
    real = {
        "factory": DEFAULT_FACTORY,
        "options": {"edge_m": 1.4e-3},
        "workers": 1,
        "grace_s": 10.0,
    }
    with serving(**real, fingertip={"fluid_volume_m3": 0.6e-6}) as service:
        reply = service.robot.simulate(asked, timeout_s=120)
        dry = dataclasses.replace(
            asked, request_id="dry", parameters=SimulationParameters(fluid_volume_m3=0.3e-6)
        )
        with pytest.raises(RemoteError, match=r"0.300 ml of fluid suck the skin inwards"):
            service.robot.simulate(dry, timeout_s=120)
    here = tip.indent("sphere_medium", path, friction_coefficient=parameters.friction_coefficient)
    assert reply.outcome is SimulationOutcome.COMPLETE
    forces = np.array([step.force for step in reply.steps])
    np.testing.assert_allclose(forces, here.forces, atol=1e-6)
    press, slide = slice(0, 5), slice(5, 9)
    assert np.abs(forces[press, 1]).max() < 0.05 * forces[4, 2]
    assert forces[slide, 1].max() > 0.1 * forces[4, 2]  # friction draws the skin along
    assert not forces[-1].any()
    assert reply.travel_m == pytest.approx(path_lengths(path)[-1])


def test_others_can_follow(service: Any) -> None:
    progress = service.robot.session.subscriber(
        SIMULATION_PROGRESS, sensor="twin", delivery=Delivery.QUEUE
    )
    time.sleep(0.3)
    service.robot.simulate(fakes.request("followed"))
    seen = progress.next(timeout_s=PATIENCE_S).message
    while seen.steps_done < 5:
        seen = progress.next(timeout_s=PATIENCE_S).message
    assert seen.request_id == "followed"


BAD: list[tuple[str, dict[str, Any], str]] = [
    ("unknown indenter", {"indenter": "sphere_medum"}, "'sphere_medium'"),
    ("no step", {"path": straight_path((0, 0, -0.009), (0, 0, -0.005), 1)[:1]}, "no step"),
    ("many steps", {"path": straight_path((0, 0, -0.009), (0, 0, -0.005), 201)}, "at most 200"),
    ("millimetres", {"path": straight_path((0, 0, -9), (0, 0, -5), 4)}, "metres"),
    ("inside", {"path": straight_path((0.007, 0.007, -0.006), (0, 0, 0), 4)}, "inside the skin"),
    ("within", {"path": straight_path((0, 0, 0.003), (0, 0, 0.004), 4)}, "inside"),
    (
        "absurd material",
        {"parameters": SimulationParameters(shear_modulus_pa=0.28)},
        "shear_modulus_pa",
    ),
    (
        "negative friction",
        {"parameters": SimulationParameters(friction_coefficient=-1)},
        "friction",
    ),
]


@pytest.mark.parametrize(("name", "changes", "said"), BAD, ids=[bad[0] for bad in BAD])
def test_a_request_out_of_range_is_refused(
    service: Any, name: str, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(RemoteError, match=said) as caught:
        service.robot.simulate(dataclasses.replace(fakes.request("bad"), **changes), timeout_s=5)
    assert caught.value.code is ErrorCode.INVALID_REQUEST


def _nan(message: simulation_pb2.SimulationRequest) -> None:
    message.path[1].px = float("nan")


def _long_quaternion(message: simulation_pb2.SimulationRequest) -> None:
    message.path[2].qw = 2.0


def _nowhere(message: simulation_pb2.SimulationRequest) -> None:
    del message.path[:]


def _endless(message: simulation_pb2.SimulationRequest) -> None:
    del message.path[3:]
    for _ in range(30_000):
        message.path.add(pz=-0.009, qw=1.0)


def _past(message: simulation_pb2.SimulationRequest) -> None:
    message.deadline_s = -1.0


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_nan, "path[1]"),
        (_long_quaternion, "path[2]"),
        (_nowhere, "path is empty"),
        (_endless, "30003 poses"),
        (_past, "deadline_s"),
    ],
)
def test_a_request_that_means_nothing_is_refused(
    service: Any, damage: Callable[[simulation_pb2.SimulationRequest], None], said: str
) -> None:
    """Another client's: ours would not send it."""
    message = simulation_pb2.SimulationRequest.FromString(
        SIMULATION_REQUEST.encode(fakes.request("x"))
    )
    damage(message)
    (reply,) = service.robot.session._raw.get(
        sensor_key("lab", "twin", "simulate"),
        payload=message.SerializeToString(),
        encoding=zenoh.Encoding(ENCODING_PREFIX + SIMULATION_REQUEST.schema),
        timeout=PATIENCE_S,
    )
    assert reply.err is not None
    error = ERROR.decode(reply.err.payload.to_bytes())
    assert error.code is ErrorCode.INVALID_REQUEST
    assert said in error.message


@pytest.mark.parametrize(
    ("kind", "outcome"),
    [
        (fakes.DIVERGES, SimulationOutcome.DIVERGED),
        (fakes.PINCHES, SimulationOutcome.FORCE_LIMIT),
    ],
)
def test_an_early_end_keeps_what_converged(
    service: Any, kind: float, outcome: SimulationOutcome
) -> None:
    reply = service.robot.simulate(fakes.request("early", kind))
    assert (reply.outcome, len(reply.steps)) == (outcome, 2)
    assert "2.5 mm" in reply.stopped_because
    assert reply.travel_m > 0


def test_a_deadline_keeps_what_converged(service: Any) -> None:
    for timeout_s in (1.0, 5.0, PATIENCE_S):  # a busy host may make no step in a second
        with contextlib.suppress(RemoteError, StreamTimeout):
            reply = service.robot.simulate(fakes.request("late", fakes.HELD), timeout_s=timeout_s)
            break
    assert reply.outcome is SimulationOutcome.DEADLINE
    assert 1 <= len(reply.steps) <= 2


def test_a_deadline_before_any_step_is_an_error(service: Any) -> None:
    with pytest.raises(RemoteError, match="no step converged") as caught:
        service.robot.simulate(fakes.request("too late", fakes.SLOW, deadline_s=0.01))
    assert caught.value.code is ErrorCode.DEADLINE_EXCEEDED


def test_no_time_at_all_is_a_timeout(service: Any) -> None:
    with pytest.raises(StreamTimeout, match="before a service was asked"):
        service.robot.simulate(fakes.request("no time"), timeout_s=1e-6)


def test_a_cancelled_simulation_keeps_what_converged(service: Any) -> None:
    first = threading.Event()
    thread, out = service.in_thread(
        fakes.request("cancelled", fakes.HELD), on_step=lambda *_: first.set()
    )
    assert first.wait(PATIENCE_S)
    assert service.robot.cancel_simulation("cancelled")
    thread.join(PATIENCE_S)
    assert out[0].outcome is SimulationOutcome.CANCELLED
    assert 1 <= len(out[0].steps) <= 2
    assert not service.robot.cancel_simulation("cancelled")


def occupied(service: Any, count: int) -> list[tuple[threading.Thread, list[Any]]]:
    """So many simulations that run or wait, named ``many <k>``."""
    # The service is ready with its first worker; until the second is, one fewer is accepted.
    service.until(lambda: service.robot.status()[0].gauges["ready_workers"] == 2)
    asked = [service.in_thread(fakes.request(f"many {k}", fakes.HELD)) for k in range(count)]

    def all_there() -> bool:
        gauges = service.robot.status()[0].gauges
        return bool(gauges["busy_workers"] + gauges["waiting_requests"] == count)

    service.until(all_there)
    return asked


def test_too_many_are_refused_and_told_when_to_come_back(service: Any) -> None:
    asked = occupied(service, 4)
    with pytest.raises(RemoteError, match="2 wait") as caught:
        service.robot.simulate(fakes.request("one more"))
    assert caught.value.code is ErrorCode.RESOURCE_EXHAUSTED
    assert caught.value.retry_after_s > 0
    with pytest.raises(RemoteError, match="in use"):
        service.robot.simulate(fakes.request("many 0"))
    for k, (thread, out) in reversed(list(enumerate(asked))):
        assert service.robot.cancel_simulation(f"many {k}")
        thread.join(PATIENCE_S)
        assert out[0].outcome is SimulationOutcome.CANCELLED


def test_time_in_the_queue_counts(service: Any) -> None:
    asked = occupied(service, 2)
    told: list[SimulationProgress] = []
    with pytest.raises(RemoteError, match="while it waited") as caught:
        service.robot.simulate(fakes.request("waits"), timeout_s=1.0, on_progress=told.append)
    assert caught.value.code is ErrorCode.DEADLINE_EXCEEDED
    assert told[0].phase is SimulationPhase.WAITING
    for k, (thread, _) in enumerate(asked):
        assert service.robot.cancel_simulation(f"many {k}")
        thread.join(PATIENCE_S)


def test_nobody_waits_for_it_any_more(service: Any) -> None:
    """A client that goes away, for whatever reason, takes its simulation with it."""
    before = service.counters().get("callers_gone", 0)
    leaving = Client(service.link.connect[0], timeout_s=5)
    first = threading.Event()

    def ask() -> None:
        def interrupt(index: int, step: object) -> None:
            first.set()
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            leaving.simulate(fakes.request("left alone", fakes.HELD), on_step=interrupt)

    thread = threading.Thread(target=ask)
    thread.start()
    assert first.wait(PATIENCE_S)
    thread.join(PATIENCE_S)
    service.until(lambda: service.counters().get("callers_gone", 0) == before + 1)
    leaving.close()
    service.until(lambda: service.robot.status()[0].gauges["busy_workers"] == 0)


@pytest.mark.parametrize("told_first", [False, True])
@pytest.mark.parametrize(("arrived_s", "stopped"), [(1, ["left early"]), (3, [])])
def test_a_caller_may_leave_while_its_question_waits_to_be_taken(
    monkeypatch: pytest.MonkeyPatch, told_first: bool, arrived_s: int, stopped: list[str]
) -> None:
    """What arrived after it left belongs to its next call."""
    cancelled: list[str] = []
    pool = SimpleNamespace(submit=lambda *_: None, cancel=cancelled.append)
    monkeypatch.setattr(node, "_pool_of", lambda *_: pool)
    session: Any = SimpleNamespace(station="lab", publisher=lambda *_, **__: None)
    health = Health("fem", "fem")
    taking = node.SimulationService(session, FemConfig(), FingertipParameters(), health, None)
    answer: Any = SimpleNamespace(arrived_ns=arrived_s * 10**9)
    for told in (told_first, not told_first):
        if told:
            taking.caller_gone(caller_key("lab", "left early"), 2.0)
        else:
            taking.simulate(fakes.request("left early"), answer)
    assert cancelled == stopped


def test_a_caller_may_ask_again_at_once_with_the_same_id(
    serving: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end of its first call is noticed while the second one runs."""
    on_gone = node.SimulationService.caller_gone

    def late(self: node.SimulationService, key: str, when_s: float) -> None:
        time.sleep(0.1)  # the look at the tokens was made before the second call
        on_gone(self, key, when_s)

    monkeypatch.setattr(node.SimulationService, "caller_gone", late)
    with serving() as served:
        for friction in (fakes.QUICK, fakes.SLOW) * 5:
            reply = served.robot.simulate(fakes.request("same", friction))
            assert reply.outcome is SimulationOutcome.COMPLETE


def test_large_fields(serving: Any) -> None:
    """All fields of one step fit a message; those of all steps need not."""
    with serving(workers=1, options={"nodes": 60_000}) as served:
        asked = fakes.request("large", steps=6, want_displacement=True, want_contact_force=True)
        reply = served.robot.simulate(asked)
        sizes = [step.displacement.nbytes for step in reply.steps if step.displacement is not None]
        assert 2 * sum(sizes) > MAX_PAYLOAD_BYTES > 2 * sizes[0]
        assert len(sizes) == 6
    with serving(workers=1, options={"nodes": 180_000}) as served:
        with pytest.raises(RemoteError, match="MiB") as caught:
            served.robot.simulate(asked)
        assert caught.value.code is ErrorCode.INVALID_REQUEST


def test_an_absurd_profile_is_told_before_the_bus_is_joined() -> None:
    config = parse_config(FemConfig, {"fingertip": {"skin_thickness_m": 1.57}}, where="test")
    with pytest.raises(ConfigError, match="skin_thickness_m"):
        node.run(config, LinkConfig(), "lab", threading.Event())
