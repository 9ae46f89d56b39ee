"""Questions and answers: a handler always answers, if need be with a typed error."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from typing import TypeVar

import zenoh

from palpate.bus.topics import ENCODING_PREFIX, check_schema
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

Q = TypeVar("Q")
R = TypeVar("R")

_log = logging.getLogger(__name__)
_STOP = None


def error_reply(error: BaseException) -> ErrorReply:
    """The typed error that tells a caller what an exception meant."""
    if isinstance(error, RemoteError):
        return ErrorReply(error.code, error.problem, error.remedy, error.retry_after_s)
    if isinstance(error, WireError):
        return ErrorReply(ErrorCode.INVALID_REQUEST, error.problem, error.remedy)
    if isinstance(error, PalpateError):
        return ErrorReply(error.code, error.problem, error.remedy)
    return ErrorReply(
        ErrorCode.INTERNAL,
        f"{type(error).__name__}: {error}",
        "this is a defect of the service: look at its log",
    )


class Queryable:
    """Answers queries with ``handler`` in its own threads. Made by ``Session.queryable``.

    One worker answers one query after another; more let a quick question overtake a slow one.

    A handler that raises, a request that does not decode, a full queue: each is answered with a
    typed error. Zenoh itself would give the caller silence.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        request: Codec[Q],
        reply: Codec[R],
        handler: Callable[[Q], R],
        *,
        capacity: int = 16,
        workers: int = 1,
    ) -> None:
        self.key = key
        self._request = request
        self._reply = reply
        self._handler = handler
        self._queries: queue.Queue[zenoh.Query | None] = queue.Queue(capacity)
        self._reply_encoding = zenoh.Encoding(ENCODING_PREFIX + reply.schema)
        self._error_encoding = zenoh.Encoding(ENCODING_PREFIX + ERROR.schema)
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
            with query:
                self._answer_error(
                    query,
                    ErrorReply(
                        ErrorCode.RESOURCE_EXHAUSTED,
                        f"{self.key} has {self._queries.maxsize} queries waiting",
                        "ask again later",
                        0.5,
                    ),
                )

    def _run(self) -> None:
        while (query := self._queries.get()) is not _STOP:
            with query:
                self._answer(query)

    def _answer(self, query: zenoh.Query) -> None:
        try:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            if query.encoding is not None and payload:
                check_schema(str(query.encoding), self._request.schema)
            reply = self._reply.encode(self._handler(self._request.decode(payload)))
        except PalpateError as error:
            self._answer_error(query, error_reply(error))
            return
        except Exception as error:
            # The last line of defence: the caller must hear of it, and so must the log.
            _log.exception("query on %s failed", self.key)
            self._answer_error(query, error_reply(error))
            return
        try:
            # A query may use wildcards; the answer names the key that answered.
            query.reply(self.key, reply, encoding=self._reply_encoding)
        except zenoh.ZError:
            _log.warning("the caller of %s is gone", self.key)

    def _answer_error(self, query: zenoh.Query, error: ErrorReply) -> None:
        try:
            query.reply_err(ERROR.encode(error), encoding=self._error_encoding)
        except zenoh.ZError:
            _log.warning("the caller of %s is gone", self.key)

    def close(self) -> None:
        """Undeclare; queries already accepted are answered."""
        self._queryable.undeclare()
        for _ in self._workers:
            self._queries.put(_STOP)
        for worker in self._workers:
            worker.join(timeout=5)


def ask_all(
    session: zenoh.Session,
    key: str,
    request: Codec[Q],
    reply: Codec[R],
    value: Q,
    *,
    timeout_s: float,
) -> list[R | PalpateError]:
    """Every answer to a query: values, and typed errors as exceptions (not raised)."""
    answers: list[R | PalpateError] = []
    for item in session.get(
        key,
        payload=request.encode(value),
        encoding=zenoh.Encoding(ENCODING_PREFIX + request.schema),
        timeout=timeout_s,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    ):
        if item.ok is not None:
            try:
                check_schema(str(item.ok.encoding), reply.schema)
                answers.append(reply.decode(item.ok.payload.to_bytes()))
            except WireError as error:
                answers.append(error)
        elif item.err is not None:
            answers.append(remote_error(item.err, key, timeout_s))
    return answers


def remote_error(error: zenoh.ReplyError, key: str, timeout_s: float) -> PalpateError:
    """The exception that an error reply stands for."""
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


def ask_one(
    session: zenoh.Session,
    key: str,
    request: Codec[Q],
    reply: Codec[R],
    value: Q,
    *,
    timeout_s: float,
) -> R:
    """The answer to a query.

    Raises:
        LinkError: Nobody serves this key.
        StreamTimeout: It did not answer in time.
        RemoteError: It answered with a typed error.
        WireError: Its answer breaks the contract.
    """
    answers = ask_all(session, key, request, reply, value, timeout_s=timeout_s)
    if not answers:
        raise nobody_answers(key)
    for answer in answers:
        if not isinstance(answer, PalpateError):
            return answer
    error = answers[0]
    assert isinstance(error, PalpateError)
    raise error


def nobody_answers(key: str) -> LinkError:
    """The error that says that a question had no reply at all."""
    return LinkError(
        f"nobody answers on {key}",
        remedy="start the service: palpate up; see what runs: palpate status",
    )
