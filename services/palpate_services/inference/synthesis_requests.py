"""Electrodes of a field, a described contact or a simulation: the answers to ``SynthesisRequest``.

Where a simulation is needed, the finite-element service is asked over the bus, with the time that
the caller has left. Its steps are synthesised as they converge. A caller that stops waiting, and a
contact that has reached its force, end the simulation: its token on the bus vanishes.
"""

from __future__ import annotations

import contextlib
import threading
import time
import uuid
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from palpate import clock
from palpate.bus import Cancellation, QueryAnswer, Session, endpoints
from palpate.bus.presence import GoneCallers
from palpate.bus.topics import caller_key
from palpate.client.simulations import GRACE_S
from palpate.errors import ErrorCode, LinkError, RemoteError
from palpate.files.bundle import FieldMesh
from palpate.health import Health
from palpate.messages import (
    ContactDescription,
    FieldFrame,
    Origin,
    Pose,
    SimulationOutcome,
    SimulationParameters,
    SimulationReply,
    SimulationRequest,
    SimulationStep,
    Stamp,
    SynthesisEstimate,
    SynthesisReply,
    SynthesisRequest,
)
from palpate.rigid import facing, unit
from palpate_services.config import SynthesisServiceConfig
from palpate_services.inference.estimates import EstimateRefusal, synthesise
from palpate_services.inference.loop import refuse, reply
from palpate_services.inference.model import Runtime
from palpate_services.inference.served import ServedModels

Floats = npt.NDArray[np.float64]

CLEARANCE_M = 1e-3
"""How far before the skin the path begins [m]: a flat indenter bears on the round skin beside its
tip a little earlier than with it."""

STEP_M = 0.1e-3
"""Longest step within the skin [m]."""

DEEPEST_M = 3.2e-3
"""Deepest that a contact may go [m]: the twin's experiment went to 3.6 mm at most, where skin is
pinched on the core."""

FARTHEST_M = 3e-3
"""Farthest that a location may lie from the skin [m]."""

_NEIGHBOURHOOD_M = 1e-3
_GRID = 12  # points along an edge of a triangle: 0.05 mm apart on the shipped mesh
_REMEDY = "docs/conventions.md has the sensor frame; the bundle's mesh has the skin"


def path_of(contact: ContactDescription, mesh: FieldMesh) -> tuple[Pose, ...]:
    """Poses of the indenter's tip from clear of the skin to the depth; for a force, to the deepest.

    Raises:
        RemoteError: The location is not at the skin, the direction leads away from it, or the depth
            is greater than ``DEEPEST_M``.
    """
    point, normal = _nearest(mesh, np.array(contact.location, np.float64))
    inwards = -normal if contact.direction is None else unit(contact.direction)
    if inwards @ normal > -0.1:
        raise _refused(
            f"the direction {contact.direction} does not lead into the skin, whose normal at "
            f"{_mm(point)} mm is {np.round(normal, 2).tolist()}"
        )
    depth_m = DEEPEST_M if contact.depth_m is None else contact.depth_m
    if depth_m > DEEPEST_M:
        raise _refused(
            f"depth_m is {depth_m:g}, at most {DEEPEST_M:g} is simulated: the skin is pinched there"
        )
    steps = max(1, int(np.ceil(depth_m / STEP_M - 1e-9)))
    travel = [-CLEARANCE_M, *(depth_m * k / steps for k in range(steps + 1))]
    w, x, y, z = facing(inwards).tolist()
    poses = []
    for along in travel:
        px, py, pz = (point + along * inwards).tolist()
        poses.append(Pose((px, py, pz), (w, x, y, z)))
    return tuple(poses)


def _nearest(mesh: FieldMesh, location: Floats) -> tuple[Floats, Floats]:
    """The nearest point of the outer skin, and the skin's outward normal around it."""
    corners = mesh.nodes[mesh.outer_faces].astype(np.float64)  # (F, 3, 3)
    centres = corners.mean(axis=1)
    near = np.argsort(np.linalg.norm(centres - location, axis=1))[:32]
    part = np.linspace(0.0, 1.0, _GRID)
    u, v = (grid.ravel() for grid in np.meshgrid(part, part))
    weights = np.stack([1.0 - u - v, u, v])[:, u + v <= 1.0 + 1e-9]
    points = np.einsum("cs,fci->fsi", weights, corners[near]).reshape(-1, 3)
    distances = np.linalg.norm(points - location, axis=1)
    point = points[np.argmin(distances)]
    if distances.min() > FARTHEST_M:
        raise _refused(
            f"location {_mm(location)} mm is {distances.min() * 1e3:.1f} mm from the skin, at most "
            f"{FARTHEST_M * 1e3:g} mm is allowed"
        )
    around = np.linalg.norm(centres - point, axis=1) < _NEIGHBOURHOOD_M
    around[near[0]] = True
    edges = corners[around, 1:] - corners[around, :1]
    normal = np.cross(edges[:, 0], edges[:, 1]).sum(axis=0)
    # Outwards is away from the core's axis, or from its tip.
    core = np.array([min(point[0], 0.0), 0.0, 0.0])
    return point, unit(normal if normal @ (point - core) > 0 else -normal)


def _mm(point: Floats) -> str:
    return str(np.round(1e3 * point, 2).tolist())


def _refused(problem: str) -> RemoteError:
    return RemoteError(problem, remedy=_REMEDY, code=ErrorCode.INVALID_REQUEST)


SERIAL = "fem"
"""Serial number of the sensor that a simulation imitates."""


@dataclass(frozen=True, slots=True)
class _Synthesised:
    step: SimulationStep
    number: int
    estimate: SynthesisEstimate


class SynthesisRequests:
    """Answers questions, in the threads of a queryable with as many workers as simulations."""

    def __init__(
        self,
        session: Session,
        config: SynthesisServiceConfig,
        models: ServedModels,
        health: Health,
    ) -> None:
        self._session = session
        self._config = config
        self._models = models
        self._health = health
        self._lock = threading.Lock()
        self._gone = GoneCallers()
        # The simulations that run: which token their caller holds, when it asked [s, monotonic].
        self._running: dict[Cancellation, tuple[str, float]] = {}

    def caller_gone(self, key: str, when_s: float) -> None:
        """Stop the simulations of a caller that has left; see ``Session.watch_callers``."""
        self._gone.add(key, when_s)
        with self._lock:
            left = [
                one
                for one, (held, asked_s) in self._running.items()
                if held == key and asked_s <= when_s
            ]
        for one in left:
            self._health.count("callers_gone")
            one.cancel()

    @contextlib.contextmanager
    def _while_waiting(self, request_id: str, asked_s: float) -> Iterator[None]:
        """Within, the questions are cancelled once the caller of this id has left."""
        if not request_id:
            yield
            return
        key, cancellation = caller_key(self._session.station, request_id), Cancellation()
        with self._lock:
            self._running[cancellation] = key, asked_s
        try:
            if (gone_s := self._gone.since(key)) is not None:  # while the question waited
                self.caller_gone(key, gone_s)
            with cancellation:
                yield
        finally:
            with self._lock:
                del self._running[cancellation]

    def handle(self, request: SynthesisRequest, answer: QueryAnswer[SynthesisReply]) -> None:
        """Answer a question, or raise the ``PalpateError`` that says why not."""
        runtime = self._models.of("")
        if runtime is None:
            refuse(EstimateRefusal.NO_MODEL, self._health)
        if isinstance(request.source, FieldFrame):
            estimate = reply(synthesise(request.source, runtime), self._health)
            answer.send(SynthesisReply(estimate))
        else:
            self._health.count("asked")
            with self._while_waiting(request.request_id, 1e-9 * answer.arrived_ns):
                self._simulate(request, runtime, answer)
        answer.end()

    def _simulate(
        self, request: SynthesisRequest, runtime: Runtime, answer: QueryAnswer[SynthesisReply]
    ) -> None:
        source = request.source
        assert not isinstance(source, FieldFrame)
        force_n = source.force_n if isinstance(source, ContactDescription) else None
        asked = self._asked(request, runtime, answer)
        last: _Synthesised | None = None
        end = SimulationReply(asked.request_id, b"", ())
        reached = False
        with self._session.caller_token(asked.request_id):
            parts = self._session.query_stream(
                endpoints.SIMULATE,
                asked,
                sensor=request.simulator,
                timeout_s=asked.deadline_s + GRACE_S,
            )
            # Closed early, the question is cancelled.
            with contextlib.closing(self._parts(parts, request.simulator)) as replies:
                for part in replies:
                    end = part
                    for number, step in enumerate(part.steps, start=part.first_step):
                        if force_n is not None and np.linalg.norm(step.force) >= force_n:
                            before = _untouched(asked, step) if last is None else last.step
                            step = _at_force(before, step, force_n)
                            reached = True
                        if last is not None and request.every_step:
                            answer.send(_reply_of(last, more=True))
                        estimate = self._estimate(step, number, part.mesh_sha256, runtime)
                        last = _Synthesised(step, number, estimate)
                        if reached:
                            break
                    if reached:
                        break
        outcome = SimulationOutcome.COMPLETE if reached else end.outcome
        stopped = "" if reached else end.stopped_because
        if force_n is not None and not reached and not stopped:
            most_n = 0.0 if last is None else float(np.linalg.norm(last.step.force))
            stopped = f"at the deepest the force is {most_n:.2f} N, {force_n:g} N was wanted"
        if last is None:
            answer.send(SynthesisReply(None, outcome=outcome, stopped_because=stopped))
            return
        answer.send(replace(_reply_of(last, more=False), outcome=outcome, stopped_because=stopped))

    def _asked(
        self, request: SynthesisRequest, runtime: Runtime, answer: QueryAnswer[SynthesisReply]
    ) -> SimulationRequest:
        """The simulation that a request needs, with the time that its caller has left."""
        source = request.source
        if isinstance(source, ContactDescription):
            assert runtime.mesh is not None, "a bundle of this task has a mesh"
            volume = SimulationParameters(fluid_volume_m3=self._config.fluid_volume_m3)
            identity = f"synthesis-{uuid.uuid4().hex[:16]}"
            asked = SimulationRequest(
                identity, source.indenter, path_of(source, runtime.mesh), volume
            )
        else:
            assert isinstance(source, SimulationRequest)
            asked = source
        left_s = answer.deadline_s - time.monotonic() - GRACE_S
        limits = (asked.deadline_s, request.deadline_s, self._config.simulation_s)
        deadline_s = min([one for one in limits if one > 0] + [max(left_s, 1.0)])
        return replace(
            asked,
            deadline_s=deadline_s,
            want_displacement=True,
            want_contact_force=False,
        )

    def _parts(
        self, parts: Iterator[SimulationReply], simulator: str
    ) -> Generator[SimulationReply]:
        """The parts of the answer of the finite-element service, whose errors become replies."""
        try:
            for part in parts:
                yield part
                if not part.more:
                    return
        except LinkError as error:
            raise RemoteError(
                f"no finite-element service answers as {simulator!r}: {error.problem}",
                remedy="start one (extra fem, process fem), or name another in simulator",
                code=ErrorCode.UNAVAILABLE,
            ) from error

    def _estimate(
        self, step: SimulationStep, number: int, mesh_sha256: bytes, runtime: Runtime
    ) -> SynthesisEstimate:
        if mesh_sha256 != runtime.mesh_sha256:
            raise RemoteError(
                f"the simulation has the mesh {mesh_sha256.hex()[:12]}, the bundle "
                f"{runtime.label} is made for {runtime.mesh_sha256.hex()[:12]}",
                remedy="let both have the same mesh: the shipped bundle's is [fem] options = "
                "{ edge_m = 0.0006 }",
                code=ErrorCode.WRONG_CONTRACT,
            )
        if step.displacement is None:
            raise RemoteError(
                "the finite-element service sent a step without its displacement",
                remedy="upgrade it: palpate status --json shows versions",
                code=ErrorCode.WRONG_CONTRACT,
            )
        now_ns, wall_ns = clock.now()
        stamp = Stamp(number + 1, number, now_ns, wall_ns, clock.CLOCK_ID, Origin.SIMULATED)
        field = FieldFrame(stamp, SERIAL, mesh_sha256, step.displacement)
        found = synthesise(field, runtime)
        if isinstance(found, EstimateRefusal):
            refuse(found, self._health)
        return found


def _reply_of(one: _Synthesised, *, more: bool) -> SynthesisReply:
    bare = replace(one.step, displacement=None, contact_force=None)
    return SynthesisReply(one.estimate, bare, one.number, more=more)


def _untouched(asked: SimulationRequest, first: SimulationStep) -> SimulationStep:
    """The state before the first step of a simulation."""
    assert first.displacement is not None
    return replace(
        first,
        pose_sensor_indenter=asked.path[0],
        force=np.zeros(3),
        torque=np.zeros(3),
        displacement=np.zeros_like(first.displacement),
    )


def _at_force(before: SimulationStep, after: SimulationStep, force_n: float) -> SimulationStep:
    """The state between two steps at which the force has this magnitude, by straight lines."""
    assert before.displacement is not None
    assert after.displacement is not None
    low, high = (float(np.linalg.norm(step.force)) for step in (before, after))
    share = (force_n - low) / (high - low)
    a, b = before.pose_sensor_indenter, after.pose_sensor_indenter
    x, y, z = (p + share * (q - p) for p, q in zip(a.position, b.position, strict=True))
    moved = after.displacement - before.displacement
    return replace(
        after,
        pose_sensor_indenter=Pose((x, y, z), b.orientation),
        force=before.force + share * (after.force - before.force),
        torque=before.torque + share * (after.torque - before.torque),
        fluid_pressure_pa=before.fluid_pressure_pa
        + share * (after.fluid_pressure_pa - before.fluid_pressure_pa),
        displacement=before.displacement + np.float32(share) * moved,
    )
