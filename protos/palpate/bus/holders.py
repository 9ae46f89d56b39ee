"""Which sensors a gateway has announced, and which run of a gateway holds each: for consumers."""

from __future__ import annotations

import contextlib
import logging
import threading

import zenoh

from palpate.bus.topics import claims_key, parse_claim_key
from palpate.errors import WireError
from palpate.process import Closing

MOST_CLAIMS = 1024
"""So many claims are remembered at most: anybody may declare tokens."""

_log = logging.getLogger(__name__)


class ClaimWatch(Closing):
    """Follows the claims that are held at a station (``"*"`` = any). Safe in several threads."""

    def __init__(self, session: zenoh.Session, station: str) -> None:
        self._claims: dict[str, tuple[str, int]] = {}
        self._holders: dict[str, frozenset[int]] = {}
        self._lock = threading.Lock()
        self._subscriber = session.liveliness().declare_subscriber(
            claims_key(station, held_only=True), self._on_sample, history=True
        )

    def holders(self, sensor: str) -> frozenset[int]:
        """Session ids of the gateways that hold a sensor; empty = no gateway has announced it."""
        return self._holders.get(sensor, frozenset())

    def _on_sample(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                claim = self._claims.pop(key, None)
                if claim is None:
                    return
                sensor = claim[0]
            elif len(self._claims) >= MOST_CLAIMS:
                _log.warning("more than %d claims on sensors: %s is ignored", MOST_CLAIMS, key)
                return
            else:
                try:
                    announced = parse_claim_key(key)
                except WireError as error:
                    _log.warning("%s", error)
                    return
                sensor = announced.sensor
                self._claims[key] = sensor, announced.session_id
            # A token is replaced by a newer one of the same run when the serial becomes known.
            left = frozenset(run for name, run in self._claims.values() if name == sensor)
            if left:
                self._holders[sensor] = left
            else:
                self._holders.pop(sensor, None)

    def close(self) -> None:
        """Stop watching."""
        with contextlib.suppress(zenoh.ZError):  # the session is gone
            self._subscriber.undeclare()
