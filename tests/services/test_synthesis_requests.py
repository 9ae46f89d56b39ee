"""Electrodes of a contact and of a simulation, with a finite-element service that tests play."""

from __future__ import annotations

import contextlib
import importlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from palpate.bus import Cancellation, QueryAnswer, Session, endpoints
from palpate.bus.topics import caller_key
from palpate.client import Client
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, PalpateError, RemoteError
from palpate.files.bundle import read_bundle
from palpate.health import Health
from palpate.messages import (
    ContactDescription,
    ElectrodeFrame,
    FloatArray,
    Pose,
    SimulationOutcome,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
    SynthesisEstimate,
    SynthesisReply,
    SynthesisRequest,
)
from palpate.rigid import rotation_matrices
from palpate_services.config import SynthesisServiceConfig
from palpate_services.inference.estimates import synthesise
from palpate_services.inference.model import load
from palpate_services.inference.services import run_estimating
from palpate_services.inference.synthesis_requests import (
    CLEARANCE_M,
    DEEPEST_M,
    STEP_M,
    SynthesisRequests,
    path_of,
)

bundles: Any = importlib.import_module("field_bundles")

Until = Callable[[Callable[[], bool]], None]
STIFFNESS_N_PER_M = 1000.0
UNDER = (-0.004, 0.0, -0.0072)  # near the lowest line of the test skin, a tube of 7 mm


def _contact(**changes: Any) -> ContactDescription:
    return ContactDescription(**{"indenter": "sphere_medium", "location": UNDER, **changes})


class Fem:
    """A finite-element service whose fingers are springs: 1 N a millimetre of the tip's travel."""

    def __init__(self, session: Session) -> None:
        self.requests: list[SimulationRequest] = []
        self.gone: list[str] = []
        self.mesh = bundles.skin().sha256
        self.steps_most = 1000
        self.error: RemoteError | None = None
        self.hold = threading.Event()
        self.hold.set()
        self.sent = 0
        session.watch_callers(lambda key, _: self.gone.append(key))
        session.stream_queryable(endpoints.SIMULATE, self.simulate, sensor="twin")

    def depth_m(self, pose: Pose) -> float:
        """How far a tip is beyond the point of the skin that described contacts meet, along z."""
        return pose.position[2] - path_of(_contact(depth_m=1e-3), bundles.skin())[1].position[2]

    def field(self, depth_m: float) -> FloatArray:
        field: FloatArray = bundles.pressed(max(depth_m, 0.0))
        return field

    def simulate(self, request: SimulationRequest, answer: QueryAnswer[SimulationReply]) -> None:
        self.requests.append(request)
        if self.error is not None:
            raise self.error
        for number, pose in enumerate(request.path[1:]):
            if number >= self.steps_most:
                answer.send(
                    SimulationReply(
                        request.request_id, self.mesh, (), "it diverged", first_step=number,
                        outcome=SimulationOutcome.DIVERGED,
                    )
                )  # fmt: skip
                answer.end()
                return
            depth_m = self.depth_m(pose)
            force = np.array([0.0, 0.0, max(depth_m, 0.0) * STIFFNESS_N_PER_M])
            step = SimulationStep(pose, force, np.zeros(3), 1000.0, self.field(depth_m), None, 1e-6)
            assert self.hold.wait(20)
            answer.send(
                SimulationReply(
                    request.request_id, self.mesh, (step,), more=True, first_step=number
                )
            )
            self.sent += 1
        answer.send(
            SimulationReply(
                request.request_id, self.mesh, (), first_step=len(request.path) - 1,
                outcome=SimulationOutcome.COMPLETE,
            )
        )  # fmt: skip
        answer.end()


@pytest.fixture
def robot(link: LinkConfig, tmp_path: Path, until: Until) -> Iterator[Client]:
    stop = threading.Event()
    config = SynthesisServiceConfig(bundle=str(bundles.write(tmp_path / "s", "synthesis")))
    node = threading.Thread(target=run_estimating, args=(config, link, "lab", stop))
    node.start()
    try:
        with Client(link.connect[0], timeout_s=10.0) as client:
            until(lambda: any(a.ready for a in client.alive()))
            yield client
    finally:
        stop.set()
        node.join(timeout=30)


@pytest.fixture
def fem(link: LinkConfig) -> Iterator[Fem]:
    with Session.open(link) as session:
        played = Fem(session)
        yield played
        played.hold.set()


def _wanted(tmp_path: Path, field: FloatArray, make_frame: Callable[..., ElectrodeFrame]) -> Any:
    runtime = load(read_bundle(tmp_path / "s"), "synthesis")
    truth = bundles.truth(make_frame(1).stamp)
    found = synthesise(type(truth)(truth.stamp, "x", truth.mesh_sha256, field), runtime)
    assert isinstance(found, SynthesisEstimate)
    return found.tared_counts


def test_a_contact_to_a_depth(
    robot: Client, fem: Fem, tmp_path: Path, make_frame: Callable[..., ElectrodeFrame]
) -> None:
    reply = robot.synthesise_from(_contact(depth_m=0.5e-3), timeout_s=20.0)
    (request,) = fem.requests
    assert request.indenter == "sphere_medium"
    assert request.want_displacement
    assert not request.want_contact_force
    assert request.parameters.fluid_volume_m3 == pytest.approx(0.6e-6)
    assert 0 < request.deadline_s <= 20.0
    assert (reply.outcome, reply.stopped_because) == (SimulationOutcome.COMPLETE, "")
    assert reply.step is not None
    assert reply.estimate is not None
    assert reply.step_number == len(request.path) - 2
    wanted = _wanted(tmp_path, fem.field(fem.depth_m(request.path[-1])), make_frame)
    np.testing.assert_allclose(reply.estimate.tared_counts, wanted, rtol=1e-5)
    assert reply.step.displacement is None
    assert reply.estimate.mesh_sha256 == fem.mesh
    assert reply.estimate.bundle_name == "synthesis-test"


def test_a_contact_to_a_force_ends_there_and_so_does_its_simulation(
    robot: Client, fem: Fem, until: Until
) -> None:
    reply = robot.synthesise_from(_contact(force_n=0.73), timeout_s=20.0)
    assert reply.step is not None
    assert np.linalg.norm(reply.step.force) == pytest.approx(0.73, rel=1e-6)
    assert fem.depth_m(reply.step.pose_sensor_indenter) == pytest.approx(0.73e-3, abs=2e-5)
    assert reply.outcome is SimulationOutcome.COMPLETE
    # The simulation is told that nobody waits.
    until(lambda: caller_key("lab", fem.requests[0].request_id) in fem.gone)


def test_a_simulation_is_stopped_when_its_caller_has_left(
    robot: Client, fem: Fem, until: Until
) -> None:
    left = Cancellation()

    def ask() -> None:
        with left, pytest.raises(PalpateError):
            robot.synthesise_from(_contact(depth_m=0.5e-3), timeout_s=20.0)

    fem.hold.clear()
    asking = threading.Thread(target=ask)
    asking.start()
    until(lambda: len(fem.requests) == 1)
    left.cancel()
    asking.join()
    # The token of the service vanishes, by which the finite-element service knows.
    until(lambda: caller_key("lab", fem.requests[0].request_id) in fem.gone)


def test_of_a_caller_that_left_before_its_turn_nothing_is_simulated() -> None:
    cancelled: list[bool] = []

    def query_stream(*_: Any, **__: Any) -> Iterator[SimulationReply]:
        current = Cancellation.current()
        cancelled.append(current is not None and current.cancelled.is_set())
        return iter(())

    session: Any = SimpleNamespace(
        station="lab", caller_token=lambda _: contextlib.nullcontext(), query_stream=query_stream
    )
    models: Any = SimpleNamespace(of=lambda _: object())
    requests = SynthesisRequests(
        session, SynthesisServiceConfig(), models, Health("synthesis", "one")
    )
    now_s = time.monotonic()
    requests.caller_gone(caller_key("lab", "left"), now_s)
    simulation = SimulationRequest("mine", "cube", path_of(_contact(depth_m=1e-3), bundles.skin()))
    for request_id, asked_s in (("left", now_s - 1.0), ("left", now_s + 1.0), ("waits", now_s)):
        answer: Any = SimpleNamespace(
            arrived_ns=round(1e9 * asked_s),
            deadline_s=now_s + 60.0,
            send=lambda _: None,
            end=lambda: None,
        )
        requests.handle(SynthesisRequest(simulation, request_id=request_id), answer)
    assert cancelled == [True, False, False], "who asks again by the same id has not left"


def test_a_force_that_is_not_reached_is_said(robot: Client, fem: Fem) -> None:
    reply = robot.synthesise_from(_contact(force_n=50.0), timeout_s=20.0)
    assert reply.step is not None
    assert "50 N was wanted" in reply.stopped_because


def test_every_step_of_a_simulation(robot: Client, fem: Fem) -> None:
    path = tuple(Pose((-0.004, 0.0, -0.007 + 0.0005 * k), (1.0, 0.0, 0.0, 0.0)) for k in range(5))
    steps: list[SynthesisReply] = []
    last = robot.synthesise_from(
        SimulationRequest("mine", "cube", path, want_contact_force=True),
        timeout_s=20.0,
        on_step=steps.append,
    )
    assert [one.step_number for one in (*steps, last)] == [0, 1, 2, 3]
    assert all(one.estimate is not None and one.outcome == 0 for one in steps)
    assert fem.requests[0].request_id == "mine"
    assert not fem.requests[0].want_contact_force
    counts = [one.estimate.tared_counts for one in (*steps, last) if one.estimate is not None]
    assert not np.allclose(counts[2], counts[3])


def test_a_field_needs_no_simulation(
    robot: Client, make_frame: Callable[..., ElectrodeFrame]
) -> None:
    field = bundles.truth(make_frame(3).stamp)
    reply = robot.synthesise_from(field)
    assert reply.estimate is not None
    counts = robot.synthesise(field).tared_counts
    np.testing.assert_array_equal(reply.estimate.tared_counts, counts)
    assert reply.step is None


def test_a_simulation_that_ends_early_gives_its_last_step(robot: Client, fem: Fem) -> None:
    fem.steps_most = 3
    reply = robot.synthesise_from(_contact(depth_m=1e-3), timeout_s=20.0)
    assert (reply.step_number, reply.outcome) == (2, SimulationOutcome.DIVERGED)
    assert reply.stopped_because == "it diverged"
    fem.steps_most = 0
    reply = robot.synthesise_from(_contact(depth_m=1e-3), timeout_s=20.0)
    assert (reply.estimate, reply.step) == (None, None)
    assert reply.outcome is SimulationOutcome.DIVERGED


def test_another_mesh_is_refused_by_name(robot: Client, fem: Fem) -> None:
    fem.mesh = bytes(range(32))
    with pytest.raises(RemoteError, match="has the mesh 000102030405") as caught:
        robot.synthesise_from(_contact(depth_m=0.5e-3), timeout_s=20.0)
    assert caught.value.code is ErrorCode.WRONG_CONTRACT
    assert "edge_m" in caught.value.remedy


def test_what_the_simulator_refuses_the_caller_hears(robot: Client, fem: Fem) -> None:
    fem.error = RemoteError(
        "8 requests wait", remedy="later", code=ErrorCode.RESOURCE_EXHAUSTED, retry_after_s=3.5
    )
    with pytest.raises(RemoteError, match="8 requests wait") as caught:
        robot.synthesise_from(_contact(depth_m=0.5e-3), timeout_s=20.0)
    assert caught.value.code is ErrorCode.RESOURCE_EXHAUSTED
    assert caught.value.retry_after_s == pytest.approx(3.5)


def test_without_a_simulator_it_is_said_at_once(robot: Client) -> None:
    with pytest.raises(RemoteError, match="no finite-element service answers as 'mine'") as caught:
        robot.synthesise_from(_contact(depth_m=0.5e-3), simulator="mine", timeout_s=20.0)
    assert caught.value.code is ErrorCode.UNAVAILABLE


def test_a_path_begins_clear_of_the_skin_and_goes_straight_in() -> None:
    mesh = bundles.skin()
    path = path_of(_contact(depth_m=1e-3), mesh)
    tips = np.array([pose.position for pose in path])
    into = rotation_matrices(np.array([path[0].orientation]))[0][:, 2]
    assert into[2] > 0.99  # from the pad towards the nail
    along = (tips - tips[1]) @ into
    assert along[0] == pytest.approx(-CLEARANCE_M)
    assert along[1] == 0.0
    assert along[-1] == pytest.approx(1e-3)
    assert np.diff(along[1:]).max() <= STEP_M * 1.001
    np.testing.assert_allclose(tips, tips[1] + along[:, None] * into, atol=1e-12)
    assert np.linalg.norm(tips[1][1:]) == pytest.approx(0.007, abs=1e-3)  # a coarse tube
    assert path[0].orientation == path[-1].orientation


def test_a_given_direction_is_followed() -> None:
    path = path_of(_contact(depth_m=1e-3, direction=(0.0, 2.0, 2.0)), bundles.skin())
    into = rotation_matrices(np.array([path[0].orientation]))[0][:, 2]
    np.testing.assert_allclose(into, [0.0, 0.5**0.5, 0.5**0.5], atol=1e-9)
    travel = np.subtract(path[-1].position, path[1].position)
    np.testing.assert_allclose(travel, 1e-3 * into, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"location": (0.0, 0.0, -0.03)}, "mm from the skin"),
        ({"direction": (0.0, 0.0, -1.0)}, "does not lead into the skin"),
        ({"direction": (1.0, 0.0, 0.0)}, "does not lead into the skin"),
        ({"depth_m": DEEPEST_M * 1.1}, "the skin is pinched"),
    ],
)
def test_contacts_that_cannot_be(changes: dict[str, Any], problem: str) -> None:
    contact = _contact(**{"depth_m": 1e-3, **changes})
    with pytest.raises(RemoteError, match=problem) as caught:
        path_of(contact, bundles.skin())
    assert caught.value.code is ErrorCode.INVALID_REQUEST
