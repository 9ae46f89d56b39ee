"""Questions that are answered in parts, as these become known: one query, several replies."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import zenoh

from palpate.bus.query import error_reply, nobody_answers, remote_error
from palpate.bus.settings import MAX_MESSAGE_BYTES
from palpate.bus.topics import ENCODING_PREFIX, check_schema
from palpate.closing import Closing
from palpate.codec import ERROR, Codec
from palpate.errors import ErrorCode, PalpateError, RemoteError, WireError

Q = TypeVar("Q")
R = TypeVar("R")

_log = logging.getLogger(__name__)
_STOP = None
_FRAMING_BYTES = 4096
"""What key, encoding and Zenoh's own headers may add to a payload; in truth some 200 bytes."""

MAX_REPLY_BYTES = MAX_MESSAGE_BYTES - _FRAMING_BYTES
"""Largest payload of one reply: receivers drop larger messages without a word [bytes]."""


class Answer(Generic[R]):
    """The answer to one query: any number of replies, then an end or an error.

    May be used from several threads. After the end nothing more is sent.
    """

    def __init__(self, query: zenoh.Query, key: str, codec: Codec[R]) -> None:
        self._query: zenoh.Query | None = query
        self._key = key
        self._codec = codec
        self._encoding = zenoh.Encoding(ENCODING_PREFIX + codec.schema)
        self._lock = threading.Lock()

    def send(self, reply: R) -> None:
        """Send a reply; nothing happens if the caller is gone or the answer has ended.

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
        with self._lock:
            if self._query is None:
                return
            try:
                self._query.reply(self._key, payload, encoding=self._encoding)
            except zenoh.ZError:
                _log.warning("the caller of %s is gone", self._key)

    def fail(self, error: BaseException) -> None:
        """End with a typed error."""
        with self._lock:
            if self._query is None:
                return
            try:
                self._query.reply_err(
                    ERROR.encode(error_reply(error)),
                    encoding=zenoh.Encoding(ENCODING_PREFIX + ERROR.schema),
                )
            except zenoh.ZError:
                _log.warning("the caller of %s is gone", self._key)
            self._close()

    def end(self) -> None:
        """No more replies."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._query is not None:
            self._query.drop()
            self._query = None


class StreamQueryable(Closing):
    """Hands each question and its ``Answer`` to ``handler``, in a thread of its own.

    The handler may return before the answer has ended. Whatever it raises ends the answer with a
    typed error, as do a request that does not decode and a full queue. Made by
    ``Session.stream_queryable``.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        request: Codec[Q],
        reply: Codec[R],
        handler: Callable[[Q, Answer[R]], None],
        capacity: int,
    ) -> None:
        self.key = key
        self._request = request
        self._reply = reply
        self._handler = handler
        self._queries: queue.Queue[zenoh.Query | None] = queue.Queue(capacity)
        self._worker = threading.Thread(target=self._run, name=f"query {key}", daemon=True)
        self._worker.start()
        self._queryable = session.declare_queryable(key, self._on_query, complete=True)

    def _on_query(self, query: zenoh.Query) -> None:
        try:
            self._queries.put_nowait(query)
        except queue.Full:
            Answer(query, self.key, self._reply).fail(
                RemoteError(
                    f"{self.key} has {self._queries.maxsize} queries waiting",
                    remedy="ask again later",
                    code=ErrorCode.RESOURCE_EXHAUSTED,
                    retry_after_s=0.5,
                )
            )

    def _run(self) -> None:
        while (query := self._queries.get()) is not _STOP:
            answer = Answer(query, self.key, self._reply)
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                if query.encoding is not None and payload:
                    check_schema(str(query.encoding), self._request.schema)
                self._handler(self._request.decode(payload), answer)
            except PalpateError as error:
                answer.fail(error)
            except Exception as error:
                # The last line of defence: the caller must hear of it, and so must the log.
                _log.exception("query on %s failed", self.key)
                answer.fail(error)

    def close(self) -> None:
        """Undeclare; questions already accepted are handled, their answers are the handler's."""
        self._queryable.undeclare()
        self._queries.put(_STOP)
        self._worker.join(timeout=5)


def ask_stream(
    session: zenoh.Session,
    key: str,
    request: Codec[Q],
    reply: Codec[R],
    value: Q,
    *,
    timeout_s: float,
) -> Iterator[R]:
    """The replies to a query, each as it comes.

    Raises:
        LinkError: Nobody serves this key.
        StreamTimeout: The answer did not end in time.
        RemoteError: It ended with a typed error.
        WireError: A reply breaks the contract.
    """
    replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
    stopped = zenoh.CancellationToken()
    session.get(
        key,
        zenoh.handlers.Callback(replies.put, lambda: replies.put(None)),
        payload=request.encode(value),
        encoding=zenoh.Encoding(ENCODING_PREFIX + request.schema),
        timeout=timeout_s,
        # One server does the work, even where several could.
        target=zenoh.QueryTarget.BEST_MATCHING,
        consolidation=zenoh.ConsolidationMode.NONE,
        cancellation_token=stopped,
    )
    silent = True
    try:
        while (item := replies.get()) is not None:
            silent = False
            if item.err is not None:
                raise remote_error(item.err, key, timeout_s)
            if item.ok is not None:
                check_schema(str(item.ok.encoding), reply.schema)
                yield reply.decode(item.ok.payload.to_bytes())
    finally:
        stopped.cancel()
    if silent:
        raise nobody_answers(key)
