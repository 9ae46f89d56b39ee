"""Asking a gateway for a tare or a zero: while the caller waits, a token on the bus shows it."""

from __future__ import annotations

import uuid

from palpate.bus import Session, endpoints
from palpate.messages import Tare, TareRequest, WrenchZero, WrenchZeroRequest


def ask_tare(session: Session, sensor: str, *, frames: int, timeout_s: float) -> Tare:
    """The tare that a BioTac's gateway takes now, over so many ``frames``; 0 = its own number.

    If this process ends or is interrupted, the token vanishes and the gateway drops the request.

    Raises:
        LinkError: No gateway serves a BioTac of this name.
        RemoteError: The gateway refuses, e.g. because the finger is touched.
        StreamTimeout: No answer in time.
    """
    request_id = uuid.uuid4().hex
    with session.caller_token(request_id):
        return session.query(
            endpoints.TARE,
            TareRequest(frames=frames, request_id=request_id),
            sensor=sensor,
            timeout_s=timeout_s,
        )


def ask_zero(session: Session, sensor: str, *, readings: int, timeout_s: float) -> WrenchZero:
    """The zero that a force/torque sensor's gateway takes now; as ``ask_tare`` otherwise."""
    request_id = uuid.uuid4().hex
    with session.caller_token(request_id):
        return session.query(
            endpoints.ZERO,
            WrenchZeroRequest(readings=readings, request_id=request_id),
            sensor=sensor,
            timeout_s=timeout_s,
        )
