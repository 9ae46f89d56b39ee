"""Answering questions: every query gets replies or a typed error, in bounded time and memory.

A query has one reply or, for a simulation, many that are sent as they become known. Both use the
same queryable.
"""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Generic, TypeVar

import zenoh

from palpate.bus.attachments import deadline_of
from palpate.bus.endpoints import Endpoint
from palpate.bus.topics import ENCODING_PREFIX, check_schema, check_size
from palpate.bus.zenoh_session import Declared
from palpate.codec import ERROR, STAGE_TIMINGS, Codec
from palpate.errors import ErrorCode, PalpateError, RemoteError, WireError
from palpate.messages import ErrorReply, StageTimings

Q = TypeVar("Q")
R = TypeVar("R")

_log = logging.getLogger(__name__)

RETRY_UNKNOWN_S = 0.5
"""When to ask again as long as no answer has been timed [s]."""

_RETRY_LEAST_S = 0.02
_RETRY_MOST_S = 60.0
_LATEST_WEIGHT = 0.2
"""Weight of the latest answer in the running mean of service times."""

_TEXT_MOST = 4000
_CLOSE_S = 5.0


def error_reply(error: BaseException) -> ErrorReply:
    """The message that describes an exception to a caller."""
    if isinstance(error, PalpateError):
        # What breaks the contract here came with the request.
        code = ErrorCode.INVALID_REQUEST if isinstance(error, WireError) else error.code
        return ErrorReply(code, _short(error.problem), _short(error.remedy), error.retry_after_s)
    return ErrorReply(
        ErrorCode.INTERNAL,
        _short(f"{type(error).__name__}: {error}"),
        "this is a defect of the service: look at its log",
    )


def _short(text: str) -> str:
    left_out = len(text) - _TEXT_MOST
    return text if left_out <= 0 else f"{text[:_TEXT_MOST]} ... ({left_out} characters more)"


class QueryAnswer(Generic[R]):
    """The answer to one query: any number of replies, then an end or an error.

    Safe to use from several threads. After the end nothing more is sent.

    Attributes:
        deadline_s: When the caller stops waiting [s, monotonic]; inf = it did not say.
        arrived_ns: When the question arrived, host monotonic clock [ns].
        decode_s: How long its decoding took [s].
    """

    def __init__(self, query: zenoh.Query, key: str, codec: Codec[R]) -> None:
        self._query: zenoh.Query | None = query
        # A query may use wildcards; the reply names the key of the queryable that answers.
        self._key = key
        self._codec = codec
        self._lock = threading.Lock()
        self.deadline_s = math.inf
        self.arrived_ns = time.monotonic_ns()
        self.decode_s = 0.0

    def send(self, reply: R, *, timings: StageTimings | None = None) -> None:
        """Send a reply; does nothing if the caller is gone or the answer has ended.

        ``timings`` of an estimate travel beside it; how long it takes to encode is added here.

        Raises:
            WireError: The reply breaks the contract, or is larger than a message may be (reason
                ``"size"``).
        """
        began_ns = time.monotonic_ns()
        payload = self._codec.encode(reply)
        attachment = None
        if timings is not None:
            encode_s = (time.monotonic_ns() - began_ns) * 1e-9
            attachment = STAGE_TIMINGS.encode(replace(timings, encode_s=encode_s))
        check_size(payload, self._codec.schema, remedy="ask for less in one answer")
        encoding = zenoh.Encoding(ENCODING_PREFIX + self._codec.schema)
        with self._lock:
            if self._query is None:
                return
            try:
                self._query.reply(self._key, payload, encoding=encoding, attachment=attachment)
            except zenoh.ZError:
                _log.warning("the caller of %s is gone", self._key)

    def fail(self, error: BaseException) -> None:
        """End with a typed error."""
        payload = ERROR.encode(error_reply(error))
        encoding = zenoh.Encoding(ENCODING_PREFIX + ERROR.schema)
        with self._lock:
            if self._query is None:
                return
            try:
                self._query.reply_err(payload, encoding=encoding)
            except zenoh.ZError:
                _log.warning("the caller of %s is gone", self._key)
            self._drop()

    def end(self) -> None:
        """End without an error."""
        with self._lock:
            self._drop()

    def _drop(self) -> None:
        if self._query is not None:
            self._query.drop()
            self._query = None


class Queryable(Declared):
    """Gives each question and its ``QueryAnswer`` to ``handler``, in threads of its own.

    The handler may return before the answer has ended, and may end it from another thread. An
    exception of the handler, a request that does not decode, a caller that has stopped waiting and
    a full queue end the answer with a typed error; Zenoh itself would leave the caller without a
    reply. Made by ``Session.queryable`` and ``Session.stream_queryable``.

    ``capacity`` questions may wait, and ``workers`` are handled at the same time. With more than
    one worker, a quick question overtakes a slow one. A refused caller is told when there will be
    room: as many service times as questions wait, by the running mean of the handler's time.

    ``counters``: ``received``, ``answered``, ``failed`` (the handler raised), ``refused_full``,
    ``expired`` (the caller had stopped waiting), and ``rejected_<reason>`` of requests that break
    the contract.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        endpoint: Endpoint[Q, R],
        handler: Callable[[Q, QueryAnswer[R]], None],
        *,
        capacity: int,
        workers: int = 1,
    ) -> None:
        self.key = key
        self._endpoint: Endpoint[Any, Any] = endpoint
        self._handler: Callable[[Any, QueryAnswer[Any]], None] = handler
        self._capacity = capacity
        # Unbounded, so that the end can always be queued; `_on_query` keeps the bound.
        self._waiting: queue.SimpleQueue[tuple[zenoh.Query, QueryAnswer[Any]] | None] = (
            queue.SimpleQueue()
        )
        self._lock = threading.Lock()
        self._counters: Counter[str] = Counter()
        self._service_s: float | None = None
        self._began_s: dict[int, float] = {}
        self._workers = [
            threading.Thread(target=self._run, args=(i,), name=f"query {key} {i}", daemon=True)
            for i in range(workers)
        ]
        for worker in self._workers:
            worker.start()
        self._queryable = session.declare_queryable(key, self._on_query, complete=True)

    @property
    def counters(self) -> dict[str, int]:
        """Events since it was declared."""
        with self._lock:
            return dict(self._counters)

    @property
    def waiting(self) -> int:
        """Questions that wait at present."""
        return self._waiting.qsize()

    def _count(self, event: str) -> None:
        with self._lock:
            self._counters[event] += 1

    def _on_query(self, query: zenoh.Query) -> None:
        # Zenoh's thread: it only checks and enqueues.
        self._count("received")
        answer = QueryAnswer(query, self.key, self._endpoint.reply)
        try:
            self._check_key(query)
            attachment = query.attachment
            answer.deadline_s = deadline_of(None if attachment is None else attachment.to_bytes())
        except PalpateError as error:
            self._reject(answer, error)
            return
        with self._lock:
            closed, waiting = self.closed, self._waiting.qsize()
            if not closed and waiting < self._capacity:
                self._waiting.put((query, answer))
                return
        if closed:  # Zenoh still hands over what came before it was undeclared
            answer.fail(_stopping(self.key))
            return
        self._count("refused_full")
        answer.fail(
            RemoteError(
                f"{self.key} has {waiting} queries waiting",
                remedy="ask again later",
                code=ErrorCode.RESOURCE_EXHAUSTED,
                retry_after_s=self._room_in_s(waiting),
            )
        )

    def _check_key(self, query: zenoh.Query) -> None:
        # One question with a wildcard would tare every finger of a station.
        asked = str(query.key_expr)
        if not self._endpoint.per_service and asked != self.key:
            raise WireError(
                f"{asked} names more than one sensor",
                remedy=f"ask one sensor at a time, e.g. {self.key}",
                reason="key",
            )

    def _room_in_s(self, waiting: int) -> float:
        """When a question that is refused now would be accepted and soon handled [s]."""
        now_s = time.monotonic()
        with self._lock:
            # A handler that takes longer than any before must not promise room at once.
            longest_s = max((now_s - began for began in self._began_s.values()), default=0.0)
            service_s = self._service_s
        if service_s is None:
            return max(RETRY_UNKNOWN_S, min(longest_s, _RETRY_MOST_S))
        room_s = max(service_s * waiting / len(self._workers), longest_s)
        return min(max(room_s, _RETRY_LEAST_S), _RETRY_MOST_S)

    def _run(self, number: int) -> None:
        while (item := self._waiting.get()) is not None:
            query, answer = item
            began_s = time.monotonic()
            if began_s > answer.deadline_s:
                self._count("expired")
                answer.fail(_expired(self.key))
                continue
            try:
                request = self._decode(query)
                answer.decode_s = time.monotonic() - began_s
            except PalpateError as error:
                self._reject(answer, error)
                continue
            with self._lock:
                self._began_s[number] = began_s
            event = "answered"
            try:
                self._handler(request, answer)
            except PalpateError as error:
                event = "failed"
                answer.fail(error)
            except Exception as error:
                # The last line of defence: both the caller and the log must get this error.
                event = "failed"
                _log.exception("query on %s failed", self.key)
                answer.fail(error)
            took_s = time.monotonic() - began_s
            with self._lock:
                self._counters[event] += 1
                del self._began_s[number]
                mean_s = self._service_s
                self._service_s = (
                    took_s if mean_s is None else mean_s + _LATEST_WEIGHT * (took_s - mean_s)
                )

    def _decode(self, query: zenoh.Query) -> Any:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        if query.encoding is not None and payload:
            check_schema(str(query.encoding), self._endpoint.request.schema)
        return self._endpoint.request.decode(payload)

    def _reject(self, answer: QueryAnswer[Any], error: PalpateError) -> None:
        reason = error.reason if isinstance(error, WireError) else error.code.name.lower()
        self._count(f"rejected_{reason}")
        answer.fail(error)

    def close(self) -> None:
        """Undeclare; what was accepted is still handled, or refused if that takes too long."""
        with self._lock:
            self.closed = True
        self._queryable.undeclare()
        for _ in self._workers:
            self._waiting.put(None)
        end_s = time.monotonic() + _CLOSE_S
        for worker in self._workers:
            worker.join(timeout=max(0.0, end_s - time.monotonic()))
        while any(worker.is_alive() for worker in self._workers):
            try:
                item = self._waiting.get_nowait()
            except queue.Empty:
                break
            if item is not None:
                item[1].fail(_stopping(self.key))
        for _ in self._workers:  # an end may have been taken above
            self._waiting.put(None)


def _expired(key: str) -> RemoteError:
    return RemoteError(
        f"{key} came to this question after its caller had stopped waiting",
        remedy="allow more time, or ask less often; see what waits: palpate status",
        code=ErrorCode.DEADLINE_EXCEEDED,
    )


def _stopping(key: str) -> RemoteError:
    return RemoteError(
        f"{key} is stopping and did not come to this question",
        remedy="ask again when the service is back: palpate status",
        code=ErrorCode.UNAVAILABLE,
        retry_after_s=1.0,
    )


def single_reply(handler: Callable[[Q], R]) -> Callable[[Q, QueryAnswer[R]], None]:
    """A handler for ``Queryable`` of a function that returns the only reply."""

    def handle(request: Q, answer: QueryAnswer[R]) -> None:
        answer.send(handler(request))
        answer.end()

    return handle
