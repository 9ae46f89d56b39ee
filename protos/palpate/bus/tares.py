"""Tares by id: frames name the baseline they belong to, consumers look it up once."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from palpate.bus import Delivery, Session, endpoints
from palpate.bus.topics import TARE
from palpate.errors import PalpateError, StreamTimeout, WireError
from palpate.messages import NO_TARE, Tare, TareRequest

ASK_S = 1.0
"""How long the gateway may take to answer one question [s]; nobody waits for it meanwhile."""

_KEPT = 1024
_WANTED_MOST = 256
_PAUSES_S = (0.1, 2.0)
"""Pause after the first question that brings nothing; it doubles up to the second [s]."""

_FORGET_S = 10.0
"""A tare that no frame has named for this long is not asked for any more [s]."""

_LOOK_S = 0.02


@dataclass(slots=True)
class _Wanted:
    """A tare that is not known: when to ask next, the pause after that, and who still wants it."""

    due_s: float
    pause_s: float
    named_s: float
    error: PalpateError | None = None


class TareBook:
    """Every tare of a station, from the tare stream; the gateway is asked for one that is missing.

    The question is asked by a thread of its own, again and again while frames name the tare: a
    gateway that hangs, or is started again, holds up no frame of any sensor. May be used from
    several threads.

    Args:
        session: The session.
        query_timeout_s: How long ``baseline`` waits for the answer [s].
    """

    def __init__(self, session: Session, *, query_timeout_s: float = ASK_S) -> None:
        self._session = session
        self._timeout_s = query_timeout_s
        self._known: dict[tuple[str, int], Tare] = {}
        self._wanted: dict[tuple[str, int], _Wanted] = {}
        self._asking = False
        self._changed = threading.Condition()
        self._draining = threading.Lock()
        self._stream = session.subscriber(TARE, delivery=Delivery.QUEUE, capacity=_KEPT)

    def find(self, sensor: str, tare_id: int) -> Tare | None:
        """The tare that a frame names by its id, which is not ``NO_TARE``; never waits.

        None: it is not known yet, and is being asked for.

        Raises:
            LinkError: It is not known, and the session is closed.
        """
        tare = self._known.get((sensor, tare_id))
        if tare is None:
            self._drain()
            tare = self._known.get((sensor, tare_id))
        if tare is None:
            self._want(sensor, tare_id)
        return tare

    def baseline(
        self, sensor: str, tare_id: int, *, timeout_s: float | None = None, patient: bool = False
    ) -> Tare:
        """As ``find``, and waits for the answer.

        Args:
            sensor: Its name.
            tare_id: The tare that a frame names.
            timeout_s: How long [s]; None = ``query_timeout_s``.
            patient: Whether to wait on when the gateway does not know the tare, or does not
                answer: in a replay a frame can arrive before its tare.

        Raises:
            LinkError: It is not known here and no gateway answers, or the session is closed.
            StreamTimeout: The gateway does not answer in time.
            RemoteError: The gateway does not know it either.
        """
        wait_s = self._timeout_s if timeout_s is None else timeout_s
        end_s = time.monotonic() + wait_s
        with self._changed:
            if (wanted := self._wanted.get((sensor, tare_id))) is not None:
                wanted.due_s, wanted.error = 0.0, None  # what was answered before is past
                self._changed.notify_all()
        while (tare := self.find(sensor, tare_id)) is None:
            with self._changed:
                wanted = self._wanted.get((sensor, tare_id))
                error = None if wanted is None else wanted.error
                late = time.monotonic() >= end_s
                if error is not None and (late or not patient):
                    raise error
                if late:
                    raise StreamTimeout(
                        f"no gateway told tare {tare_id} of {sensor!r} in {wait_s:g} s",
                        remedy="check the gateway with palpate status, or tare again",
                    )
                self._changed.wait(_LOOK_S)
        return tare

    def remember(self, sensor: str, tare: Tare) -> None:
        """Keep a tare; the oldest is forgotten beyond a thousand."""
        if tare.tare_id == NO_TARE:
            return
        with self._changed:
            self._wanted.pop((sensor, tare.tare_id), None)
            self._known[sensor, tare.tare_id] = tare
            while len(self._known) > _KEPT:
                self._known.pop(next(iter(self._known)))
            self._changed.notify_all()

    def _want(self, sensor: str, tare_id: int) -> None:
        now_s = time.monotonic()
        with self._changed:
            wanted = self._wanted.setdefault((sensor, tare_id), _Wanted(now_s, _PAUSES_S[0], now_s))
            wanted.named_s = now_s
            while len(self._wanted) > _WANTED_MOST:
                self._wanted.pop(next(iter(self._wanted)))
            if not self._asking:
                self._asking = True
                threading.Thread(target=self._ask, name="tares", daemon=True).start()

    def _ask(self) -> None:
        """Ask for each wanted tare when it is due; ends when none is wanted any more."""
        while True:
            with self._changed:
                now_s = time.monotonic()
                for key in [k for k, w in self._wanted.items() if now_s - w.named_s > _FORGET_S]:
                    del self._wanted[key]
                if not self._wanted:
                    self._asking = False
                    return
                key, wanted = min(self._wanted.items(), key=lambda item: item[1].due_s)
                if wanted.due_s > now_s:
                    self._changed.wait(min(wanted.due_s - now_s, _PAUSES_S[0]))
                    continue
            sensor, tare_id = key
            try:
                request = TareRequest(tare_id=tare_id)
                tare = self._session.query(endpoints.TARE, request, sensor=sensor, timeout_s=ASK_S)
                if tare.tare_id != tare_id:
                    raise WireError(
                        f"the gateway of {sensor!r} gave tare {tare.tare_id} for {tare_id}",
                        remedy="upgrade that gateway: it breaks the contract",
                        reason="tare",
                    )
            except PalpateError as error:
                with self._changed:
                    wanted.error = error
                    wanted.due_s = time.monotonic() + wanted.pause_s
                    wanted.pause_s = min(2.0 * wanted.pause_s, _PAUSES_S[1])
                    self._changed.notify_all()
            else:
                self.remember(sensor, tare)

    def _drain(self) -> None:
        with self._draining:
            while True:
                try:
                    received = self._stream.next(timeout_s=0)
                except StreamTimeout:
                    return
                self.remember(received.sensor, received.message)
