"""Requests that need the next readings of a sensor: a tare, a zero.

They are bounded in number, in readings and in time, and end when their caller has left, so that no
request can keep a sensor from others. A question that needs no readings never waits behind them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from palpate.bus import QueryAnswer
from palpate.bus.presence import GoneCallers
from palpate.bus.topics import caller_key
from palpate.errors import ErrorCode, PalpateError, RemoteError

LONGEST_S = 10.0
"""No request may be about the readings of more time than this [s]."""

MOST = 8
"""So many requests may wait for the readings of one sensor."""

_RETRY_LEAST_S = 0.1

R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class _Waiting(Generic[R]):
    """One request: who asks, when it arrived, what it will get, and when that is expected."""

    caller: str
    since_s: float
    expected_s: float
    future: Future[R]


class SensorRequests(Generic[R]):
    """The requests to one sensor that wait for its readings. Safe to use from several threads.

    Args:
        sensor: Its name.
        what: What the readings are for, and their name, e.g. ``tare`` and ``frames``.
        readings: Their name, e.g. ``frames``.
        rate_hz: Readings a second [Hz].
    """

    def __init__(self, sensor: str, *, what: str, readings: str, rate_hz: float) -> None:
        self._sensor, self._what, self._readings = sensor, what, readings
        self._rate_hz = rate_hz
        self._lock = threading.Lock()
        self._waiting: list[_Waiting[R]] = []
        self._gone = GoneCallers()

    def check_count(self, count: int, *, least: int, usual: int) -> int:
        """The number of readings that a request wants; 0 means ``usual``, which is always allowed.

        Raises:
            RemoteError: It is not from ``least`` to those of ``LONGEST_S``.
        """
        most = max(int(LONGEST_S * self._rate_hz), least, usual)
        wanted = count or usual
        if least <= wanted <= most:
            return wanted
        raise RemoteError(
            f"a {self._what} of sensor {self._sensor!r} averages {least} to {most} "
            f"{self._readings} ({LONGEST_S:g} s of them), not {count}",
            remedy=f"ask for fewer {self._readings}; 0 = the usual {usual}"
            if count > most
            else f"ask for more {self._readings}; 0 = the usual {usual}",
            code=ErrorCode.INVALID_REQUEST,
        )

    def serve(
        self,
        answer: QueryAnswer[R],
        begin: Callable[[], Future[R]],
        *,
        caller: str,
        readings: int,
        in_turn: bool,
        slack_s: float,
    ) -> None:
        """Answer with the result of ``begin``, in a thread of its own.

        Args:
            answer: The caller's.
            begin: Registers the request with the sensor.
            caller: The ``caller_key`` that vanishes with the caller; empty = it has none.
            readings: How many readings it needs.
            in_turn: Whether the sensor serves requests one after the other.
            slack_s: How much later than expected it may be [s].

        Raises:
            RemoteError: So many wait that there is no room (``RESOURCE_EXHAUSTED``); it says when
                there will be.
        """
        now_s = time.monotonic()
        with self._lock:
            if len(self._waiting) >= MOST:
                soonest_s = min(one.expected_s for one in self._waiting) - now_s
                raise RemoteError(
                    f"{MOST} requests wait for a {self._what} of sensor {self._sensor!r}",
                    remedy="ask again later",
                    code=ErrorCode.RESOURCE_EXHAUSTED,
                    retry_after_s=max(soonest_s, _RETRY_LEAST_S),
                )
            before = [one.expected_s for one in self._waiting] if in_turn else []
            expected_s = max([now_s, *before]) + readings / self._rate_hz
            one = _Waiting(caller, answer.arrived_ns * 1e-9, expected_s, begin())
            self._waiting.append(one)
        if (gone_s := self._gone.since(caller)) is not None:  # while the question waited
            self.caller_gone(caller, gone_s)
        # A thread for each: a caller whose link is stuck holds up no other, least of all the
        # thread that reads the sensor.
        threading.Thread(
            target=self._answer,
            args=(answer, one, expected_s + slack_s),
            name=f"{self._what} of {self._sensor}",
            daemon=True,
        ).start()

    def caller_gone(self, caller: str, when_s: float) -> None:
        """Drop the requests of a caller whose token vanished at ``when_s`` [s, monotonic]."""
        self._gone.add(caller, when_s)
        with self._lock:
            gone = [one for one in self._waiting if one.caller == caller and one.since_s <= when_s]
        for one in gone:
            one.future.cancel()

    def _answer(self, answer: QueryAnswer[R], one: _Waiting[R], end_s: float) -> None:
        end_s = min(end_s, answer.deadline_s)
        try:
            result = one.future.result(timeout=max(0.0, end_s - time.monotonic()))
            answer.send(result)
            answer.end()
        except CancelledError:
            answer.fail(self._unanswered("its caller has left"))
        except TimeoutError as error:
            # The result itself may be an error of this kind.
            if not one.future.cancel() and isinstance(error, PalpateError):
                answer.fail(error)
            else:
                waited_s = time.monotonic() - one.since_s
                answer.fail(self._unanswered(f"not enough came within {waited_s:.1f} s"))
        except PalpateError as error:
            answer.fail(error)
        finally:
            with self._lock:
                self._waiting.remove(one)

    def _unanswered(self, why: str) -> RemoteError:
        return RemoteError(
            f"no {self._what} of sensor {self._sensor!r}: {why}",
            remedy=f"check that it delivers {self._readings}: palpate status; then ask again",
            code=ErrorCode.DEADLINE_EXCEEDED,
            retry_after_s=1.0,
        )


class _Request(Protocol):
    """A request that may name its caller."""

    @property
    def request_id(self) -> str: ...


Q = TypeVar("Q", bound=_Request)


def with_caller(
    station: str, handler: Callable[[Q, QueryAnswer[R], str], None]
) -> Callable[[Q, QueryAnswer[R]], None]:
    """A handler for a queryable of one that also takes the key of the caller's token."""

    def handle(request: Q, answer: QueryAnswer[R]) -> None:
        name = request.request_id
        handler(request, answer, caller_key(station, name) if name else "")

    return handle
