"""Tares by id: frames name the baseline they belong to, consumers look it up once."""

from __future__ import annotations

import threading

from palpate.bus import Delivery, Session, endpoints
from palpate.bus.topics import TARE
from palpate.errors import StreamTimeout
from palpate.messages import NO_TARE, Tare, TareRequest

_KEPT = 1024


class TareBook:
    """Every tare of a station, from the tare stream; the gateway is asked for one that is missing.

    Such a question may take ``query_timeout_s`` [s].
    """

    def __init__(self, session: Session, *, query_timeout_s: float = 0.2) -> None:
        self._session = session
        self._timeout_s = query_timeout_s
        self._known: dict[tuple[str, int], Tare] = {}
        self._lock = threading.Lock()
        self._stream = session.subscriber(TARE, delivery=Delivery.QUEUE, capacity=_KEPT)

    def baseline(self, sensor: str, tare_id: int) -> Tare:
        """The tare of a sensor that a frame names; not ``NO_TARE``.

        Raises:
            LinkError: It is not known here and no gateway answers.
            StreamTimeout: The gateway does not answer in time.
            RemoteError: The gateway does not know it either.
        """
        tare = self._known.get((sensor, tare_id))
        if tare is None:
            self._drain()
            tare = self._known.get((sensor, tare_id))
        if tare is None:
            tare = self._session.query(
                endpoints.TARE,
                TareRequest(tare_id=tare_id),
                sensor=sensor,
                timeout_s=self._timeout_s,
            )
            self.remember(sensor, tare)
        return tare

    def remember(self, sensor: str, tare: Tare) -> None:
        """Keep a tare; the oldest is forgotten beyond a thousand."""
        if tare.tare_id == NO_TARE:
            return
        with self._lock:
            self._known[sensor, tare.tare_id] = tare
            while len(self._known) > _KEPT:
                self._known.pop(next(iter(self._known)))

    def _drain(self) -> None:
        while True:
            try:
                received = self._stream.next(timeout_s=0)
            except StreamTimeout:
                return
            self.remember(received.sensor, received.message)
