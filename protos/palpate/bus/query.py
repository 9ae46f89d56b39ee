"""Questions and answers: every query is answered, if need be with a typed error.

A query has one reply or, for a simulation, many that are sent as they become known. Both use the
same queryable and the same way of asking.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import zenoh

from palpate.bus.endpoints import Endpoint
from palpate.bus.topics import ENCODING_PREFIX, MAX_MESSAGE_BYTES, check_schema
from palpate.codec import ERROR, Codec
from palpate.errors import (
    ErrorCode,
    LinkError,
    PalpateError,
    RemoteError,
    StreamTimeout,
    WireError,
)
from palpate.messages import ErrorReply
from palpate.process import Closing

Q = TypeVar("Q")
R = TypeVar("R")

_log = logging.getLogger(__name__)

_FRAMING_BYTES = 4096
"""Upper bound of what key, encoding and Zenoh's headers add to a payload; about 200 in practice."""

MAX_REPLY_BYTES = MAX_MESSAGE_BYTES - _FRAMING_BYTES
"""Largest payload of one reply [bytes]; receivers drop larger messages without an error."""


def error_reply(error: BaseException) -> ErrorReply:
    """The message that describes an exception to a caller."""
    if isinstance(error, PalpateError):
        # What breaks the contract here came with the request.
        code = ErrorCode.INVALID_REQUEST if isinstance(error, WireError) else error.code
        return ErrorReply(code, error.problem, error.remedy, error.retry_after_s)
    return ErrorReply(
        ErrorCode.INTERNAL,
        f"{type(error).__name__}: {error}",
        "this is a defect of the service: look at its log",
    )


class QueryAnswer(Generic[R]):
    """The answer to one query: any number of replies, then an end or an error.

    Safe to use from several threads. After the end nothing more is sent.
    """

    def __init__(self, query: zenoh.Query, key: str, codec: Codec[R]) -> None:
        self._query: zenoh.Query | None = query
        # A query may use wildcards; the reply names the key of the queryable that answers.
        self._key = key
        self._codec = codec
        self._lock = threading.Lock()

    def send(self, reply: R) -> None:
        """Send a reply; does nothing if the caller is gone or the answer has ended.

        Raises:
            WireError: The reply breaks the contract, or is larger than a message may be (reason
                ``"size"``).
        """
        payload = self._codec.encode(reply)
        if len(payload) > MAX_REPLY_BYTES:
            raise WireError(
                f"a {self._codec.schema} of {len(payload):,} bytes is larger than a message may be"
                f" ({MAX_REPLY_BYTES:,} bytes)",
                remedy="ask for less in one answer",
                reason="size",
            )
        encoding = zenoh.Encoding(ENCODING_PREFIX + self._codec.schema)
        with self._lock:
            if self._query is None:
                return
            try:
                self._query.reply(self._key, payload, encoding=encoding)
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


class Queryable(Closing):
    """Gives each question and its ``QueryAnswer`` to ``handler``, in threads of its own.

    The handler may return before the answer has ended, and may end it from another thread. An
    exception of the handler, a request that does not decode and a full queue end the answer with a
    typed error; Zenoh itself would leave the caller without a reply. Made by ``Session.queryable``
    and ``Session.stream_queryable``.

    ``capacity`` questions may wait, and ``workers`` are handled at the same time. With more than
    one worker, a quick question overtakes a slow one.
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
        self._queries: queue.Queue[zenoh.Query | None] = queue.Queue(capacity)
        self._workers = [
            threading.Thread(target=self._run, name=f"query {key} {i}", daemon=True)
            for i in range(workers)
        ]
        for worker in self._workers:
            worker.start()
        self._queryable = session.declare_queryable(key, self._on_query, complete=True)

    def _on_query(self, query: zenoh.Query) -> None:
        try:
            self._queries.put_nowait(query)
        except queue.Full:
            QueryAnswer(query, self.key, self._endpoint.reply).fail(
                RemoteError(
                    f"{self.key} has {self._queries.maxsize} queries waiting",
                    remedy="ask again later",
                    code=ErrorCode.RESOURCE_EXHAUSTED,
                    retry_after_s=0.5,
                )
            )

    def _run(self) -> None:
        while (query := self._queries.get()) is not None:
            answer = QueryAnswer(query, self.key, self._endpoint.reply)
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                if query.encoding is not None and payload:
                    check_schema(str(query.encoding), self._endpoint.request.schema)
                self._handler(self._endpoint.request.decode(payload), answer)
            except PalpateError as error:
                answer.fail(error)
            except Exception as error:
                # The last line of defence: both the caller and the log must get this error.
                _log.exception("query on %s failed", self.key)
                answer.fail(error)

    def close(self) -> None:
        """Undeclare; questions that were already accepted are still handled."""
        self._queryable.undeclare()
        for _ in self._workers:
            self._queries.put(None)
        for worker in self._workers:
            worker.join(timeout=5)


def single_reply(handler: Callable[[Q], R]) -> Callable[[Q, QueryAnswer[R]], None]:
    """A handler for ``Queryable`` of a function that returns the only reply."""

    def handle(request: Q, answer: QueryAnswer[R]) -> None:
        answer.send(handler(request))
        answer.end()

    return handle


def ask(
    session: zenoh.Session,
    key: str,
    endpoint: Endpoint[Q, R],
    request: Q,
    *,
    timeout_s: float,
    everyone: bool,
) -> Iterator[R | PalpateError]:
    """Replies to a query as they come; typed errors are yielded as exceptions, not raised.

    Closing the iterator cancels the query. All of it may take ``timeout_s``. The key may have
    wildcards: ``everyone`` asks every queryable that matches, else the best matching one answers.
    """
    replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
    stopped = zenoh.CancellationToken()
    target = zenoh.QueryTarget.ALL if everyone else zenoh.QueryTarget.BEST_MATCHING
    session.get(
        key,
        zenoh.handlers.Callback(replies.put, lambda: replies.put(None)),
        payload=endpoint.request.encode(request),
        encoding=zenoh.Encoding(ENCODING_PREFIX + endpoint.request.schema),
        timeout=timeout_s,
        target=target,
        consolidation=zenoh.ConsolidationMode.NONE,
        cancellation_token=stopped,
    )
    try:
        while (item := replies.get()) is not None:
            if item.err is not None:
                yield _remote_error(item.err, key, timeout_s)
            elif item.ok is not None:
                try:
                    check_schema(str(item.ok.encoding), endpoint.reply.schema)
                    reply = endpoint.reply.decode(item.ok.payload.to_bytes())
                except WireError as error:
                    yield error
                else:
                    yield reply
    finally:
        stopped.cancel()


def _remote_error(error: zenoh.ReplyError, key: str, timeout_s: float) -> PalpateError:
    payload = error.payload.to_bytes()
    if str(error.encoding) == ENCODING_PREFIX + ERROR.schema:
        try:
            reply = ERROR.decode(payload)
        except WireError as wire_error:
            return wire_error
        return RemoteError(
            reply.message,
            remedy=reply.remedy,
            code=reply.code,
            retry_after_s=reply.retry_after_s,
        )
    if payload == b"Timeout":
        return StreamTimeout(
            f"{key} did not answer within {timeout_s:g} s",
            remedy="check its load with palpate status, or allow more time",
        )
    return RemoteError(
        f"{key} answered with an untyped error: {payload[:200]!r}",
        remedy="the service does not speak palpate.v1",
        code=ErrorCode.WRONG_CONTRACT,
    )


def first_reply(replies: list[R | PalpateError], key: str) -> R:
    """The first reply that is no error.

    Raises:
        LinkError: There is no reply at all.
        PalpateError: All replies are errors; the first of them.
    """
    errors: list[PalpateError] = []
    for reply in replies:
        if not isinstance(reply, PalpateError):
            return reply
        errors.append(reply)
    raise errors[0] if errors else no_reply(key)


def raise_errors(replies: Iterator[R | PalpateError], key: str) -> Iterator[R]:
    """The same replies; an error is raised, and so is their absence.

    Raises:
        LinkError: There is no reply at all.
        PalpateError: A reply is an error.
    """
    silent = True
    for reply in replies:
        silent = False
        if isinstance(reply, PalpateError):
            raise reply
        yield reply
    if silent:
        raise no_reply(key)


def no_reply(key: str) -> LinkError:
    """The error for a question that had no reply at all."""
    return LinkError(
        f"no service answers on {key}",
        remedy="start the service: palpate up; see what runs: palpate status",
    )
