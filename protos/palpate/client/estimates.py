"""Questions that need more than one call: tares, bases of coefficients, electrodes to be."""

from __future__ import annotations

import dataclasses
import uuid
from collections.abc import Callable, Iterator

import numpy as np

from palpate.bus import Session, endpoints
from palpate.errors import WireError
from palpate.messages import (
    BasisRequest,
    ModeBasis,
    SynthesisReply,
    SynthesisRequest,
    Tare,
    TareRequest,
    WrenchZero,
    WrenchZeroRequest,
)


def ask_tare(
    session: Session, sensor: str, *, frames: int, timeout_s: float, anyway: bool = False
) -> Tare:
    """The tare that a BioTac's gateway takes now, over so many ``frames``; 0 = its own number.

    ``anyway`` = although it is still, but farther from where it last rested than it drifts.
    If this process ends or is interrupted, the token vanishes and the gateway drops the request.

    Raises:
        LinkError: No gateway serves a BioTac of this name.
        RemoteError: The gateway refuses, e.g. because the finger is touched.
        StreamTimeout: No answer in time.
    """
    request = TareRequest(frames=frames, request_id=uuid.uuid4().hex, anyway=anyway)
    with session.caller_token(request.request_id):
        return session.query(endpoints.TARE, request, sensor=sensor, timeout_s=timeout_s)


def ask_zero(session: Session, sensor: str, *, readings: int, timeout_s: float) -> WrenchZero:
    """The zero that a force/torque sensor's gateway takes now; as ``ask_tare`` otherwise."""
    request = WrenchZeroRequest(readings=readings, request_id=uuid.uuid4().hex)
    with session.caller_token(request.request_id):
        return session.query(endpoints.ZERO, request, sensor=sensor, timeout_s=timeout_s)


OnSynthesis = Callable[[SynthesisReply], None]
"""Called with the electrodes of each step of a simulation, as it converges."""


def ask_basis(session: Session, basis_sha256: bytes, *, timeout_s: float) -> ModeBasis:
    """The whole basis of a field service's coefficients; an empty digest = the served one.

    Raises:
        LinkError: No field service runs.
        RemoteError: It has no such basis.
        WireError: A part is missing, or breaks the contract.
    """
    parts = session.query_stream(
        endpoints.BASIS, BasisRequest(basis_sha256), service="field", timeout_s=timeout_s
    )
    return join_basis(parts)


def join_basis(parts: Iterator[ModeBasis]) -> ModeBasis:
    """One basis of the parts of an answer.

    Raises:
        WireError: A part is missing (reason ``"incomplete"``).
    """
    first: ModeBasis | None = None
    modes: list[object] = []
    count = 0
    for part in parts:
        first = first or part
        if part.first_mode != count or part.basis_sha256 != first.basis_sha256:
            raise _incomplete(f"mode {count} is missing, {part.first_mode} came")
        modes.append(part.modes)
        count += len(part.modes)
        if not part.more:
            return dataclasses.replace(
                first,
                modes=np.concatenate(modes),  # type: ignore[arg-type]
                more=False,
            )
    raise _incomplete(f"it ended after mode {count}")


def ask_synthesis(
    session: Session,
    request: SynthesisRequest,
    *,
    timeout_s: float,
    on_step: OnSynthesis | None = None,
) -> SynthesisReply:
    """The last reply to a request; ``on_step`` gets those before, if it asks for every step.

    If this process ends or is interrupted, the token vanishes and the simulation is stopped.

    Raises:
        LinkError: No synthesis service runs.
        RemoteError: It, or the finite-element service that it asks, refuses or cannot go on.
        StreamTimeout: No answer in time.
        WireError: The request, or an answer, breaks the contract.
    """
    request = dataclasses.replace(request, request_id=uuid.uuid4().hex)
    with session.caller_token(request.request_id):
        parts = session.query_stream(
            endpoints.SYNTHESISE_FROM, request, service="synthesis", timeout_s=timeout_s
        )
        for part in parts:
            if not part.more:
                return part
            if on_step is not None:
                on_step(part)
    raise _incomplete("it ended without a last message")


def _incomplete(problem: str) -> WireError:
    return WireError(
        f"the answer is incomplete: {problem}",
        remedy="ask again; if it happens again, look at the log of the service",
        reason="incomplete",
    )
