"""Asking questions: replies as they come, typed errors, and never more than the time that is given.

A question may be cancelled from another thread, and one that a service refuses for lack of room is
asked again while there is time. One that had no reply is never sent again, as the service may have
acted on it; so where a service may not be known yet, it is waited for before.
"""

from __future__ import annotations

import queue
import random
import threading
import time
from collections.abc import Callable, Generator, Iterator
from types import TracebackType
from typing import Any, Self, TypeVar

import zenoh

from palpate.bus.attachments import OnTimings, attachment_of, timings_of
from palpate.bus.endpoints import Endpoint
from palpate.bus.presence import AliveService, alive, other_stations
from palpate.bus.topics import (
    ENCODING_PREFIX,
    MAX_MESSAGE_BYTES,
    check_schema,
    check_size,
    service_key,
)
from palpate.bus.zenoh_session import said, while_open
from palpate.codec import ERROR
from palpate.config import check_duration
from palpate.errors import (
    ConfigError,
    ErrorCode,
    LinkError,
    PalpateError,
    RemoteError,
    StreamTimeout,
    WireError,
)

Q = TypeVar("Q")
R = TypeVar("R")

LONGEST_S = 86_400.0
"""Longest time that a question may take [s]: a day."""

LOOK_S = 0.05
"""Within this time a session hears from its router who serves a key [s]."""

_RETRIED = (ErrorCode.RESOURCE_EXHAUSTED, ErrorCode.UNAVAILABLE)
_POLL_S = 0.002
_LEAST_S = 0.001
_DROPPED = f"larger than a message may be ({MAX_MESSAGE_BYTES >> 20} MiB), so that it was dropped"


class Cancellation:
    """Ends the questions that are asked inside its ``with`` block, from any thread.

    A question that is cancelled ends without further replies; its caller is expected to have left.
    """

    _current = threading.local()

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tokens: list[zenoh.CancellationToken] = []
        self.cancelled = threading.Event()

    def __enter__(self) -> Self:
        self._current.value = self
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._current.value = None

    @classmethod
    def current(cls) -> Cancellation | None:
        """The one in whose block this thread is."""
        found: Cancellation | None = getattr(cls._current, "value", None)
        return found

    def cancel(self) -> None:
        """End the present question, and do not begin another."""
        with self._lock:
            self.cancelled.set()
            tokens, self._tokens = self._tokens, []
        for token in tokens:
            token.cancel()

    def watch(self, token: zenoh.CancellationToken) -> None:
        """Cancel this token, too."""
        with self._lock:
            if not self.cancelled.is_set():
                self._tokens.append(token)
                return
        token.cancel()


def ask(
    session: zenoh.Session,
    key: str,
    endpoint: Endpoint[Q, R],
    request: Q,
    *,
    timeout_s: float,
    everyone: bool,
    settle_s: float = 0.0,
    silence: Callable[[bool], PalpateError] | None = None,
    on_timings: OnTimings | None = None,
) -> Generator[R | PalpateError]:
    """Replies to a query as they come; typed errors are yielded as exceptions, not raised.

    Closing the iterator cancels the query. All of it may take ``timeout_s``, and the service is
    told how much of it is left. The key may have wildcards: ``everyone`` asks every queryable that
    matches, else the best matching one answers.

    The query is sent once. Before, somebody who serves the key is waited for, if none is known:
    ``settle_s`` at most, and half of the time, so that the other half is left for the answer.
    Without any reply the error of ``silence`` is yielded, if given; it is told whether somebody was
    known.

    Raises:
        ConfigError: The request or the time cannot be sent.
        WireError: The request breaks the contract, or is larger than a message may be (reason
            ``"size"``).
    """
    end_s = time.monotonic() + check_duration(timeout_s, "timeout_s", most=LONGEST_S)
    payload = _encoded(endpoint, request)
    replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
    stopped = zenoh.CancellationToken()
    cancellation = Cancellation.current()
    if cancellation is not None:
        cancellation.watch(stopped)
    target = zenoh.QueryTarget.ALL if everyone else zenoh.QueryTarget.BEST_MATCHING
    known = False
    try:
        known = is_served(session, key, min(settle_s, timeout_s / 2))
        left_s = max(end_s - time.monotonic(), _LEAST_S)
        session.get(
            key,
            zenoh.handlers.Callback(replies.put, lambda: replies.put(None)),
            payload=payload,
            encoding=zenoh.Encoding(ENCODING_PREFIX + endpoint.request.schema),
            attachment=attachment_of(left_s),
            timeout=left_s,
            target=target,
            consolidation=zenoh.ConsolidationMode.NONE,
            cancellation_token=stopped,
        )
    except zenoh.ZError as error:
        if cancellation is None or not cancellation.cancelled.is_set():
            problem = f"cannot ask {key}: {said(error)}"
            raise LinkError(problem, remedy="open the session again") from error
        replies.put(None)  # cancelled before it was sent: there is no reply
    silent = True
    try:
        while (item := replies.get()) is not None:
            silent = False
            if item.err is not None:
                yield _remote_error(item.err, key, timeout_s)
            elif item.ok is not None:
                try:
                    check_schema(str(item.ok.encoding), endpoint.reply.schema)
                    reply = endpoint.reply.decode(item.ok.payload.to_bytes())
                except WireError as error:
                    yield error
                else:
                    attachment = item.ok.attachment
                    if on_timings is not None and attachment is not None:
                        timings = timings_of(attachment.to_bytes())
                        if timings is not None:
                            on_timings(timings)
                    yield reply
        if silent and silence is not None:
            yield silence(known)
    finally:
        stopped.cancel()


def _encoded(endpoint: Endpoint[Q, R], request: Q) -> bytes:
    schema = endpoint.request.schema
    try:
        payload = endpoint.request.encode(request)
    except PalpateError:
        raise
    except (ValueError, TypeError, AttributeError) as error:
        # Protobuf's words for a number that its field cannot hold, e.g. a negative count.
        raise ConfigError(
            f"{str(request)[:200]} cannot be sent as {schema}: {error}",
            remedy=f"correct the value; docs/messages.md says what {schema} may hold",
        ) from error
    check_size(payload, schema, remedy="ask about less at once")
    return payload


def ask_again(once: Callable[[float], R], timeout_s: float) -> R:
    """The answer of ``once``, which is told how much time is left [s].

    While there is time, a refusal that says when to ask again is waited out: with
    ``RESOURCE_EXHAUSTED`` or ``UNAVAILABLE`` the service has not begun to work. Up to a quarter is
    added by chance, so that callers that were refused together do not come back together.

    Raises:
        PalpateError: Of the last attempt.
    """
    end_s = time.monotonic() + check_duration(timeout_s, "timeout_s", most=LONGEST_S)
    left_s = timeout_s
    while True:
        try:
            return once(left_s)
        except RemoteError as error:
            pause_s = error.retry_after_s * random.uniform(1.0, 1.25)
            left_s = end_s - time.monotonic() - pause_s
            if error.code not in _RETRIED or not pause_s > 0.0 or left_s <= 0.0:
                raise
            _pause(pause_s)
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                raise


def _pause(seconds: float) -> None:
    cancellation = Cancellation.current()
    if cancellation is None:
        time.sleep(seconds)
    else:
        cancellation.cancelled.wait(seconds)


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
            f"{key} did not answer within {timeout_s:g} s: it is busy or hangs, or its answer is "
            f"{_DROPPED}",
            remedy="look at its state with palpate status; allow more time, or ask for less",
        )
    return RemoteError(
        f"{key} answered with an untyped error: {payload[:200]!r}",
        remedy="the service does not speak palpate.v1",
        code=ErrorCode.WRONG_CONTRACT,
    )


def first_reply(replies: Iterator[R | PalpateError]) -> R:
    """The first reply that is no error; further ones are not waited for.

    Raises:
        PalpateError: All replies are errors; the first of them.
    """
    errors: list[PalpateError] = []
    for reply in replies:
        if not isinstance(reply, PalpateError):
            return reply
        errors.append(reply)
    raise errors[0]


def raise_errors(replies: Iterator[R | PalpateError]) -> Iterator[R]:
    """The same replies; an error is raised.

    Raises:
        PalpateError: A reply is an error.
    """
    for reply in replies:
        if isinstance(reply, PalpateError):
            raise reply
        yield reply


def no_reply(
    session: zenoh.Session,
    key: str,
    known: bool,
    *,
    roles: bool = False,
    device: str = "",
    station: str,
) -> LinkError:
    """The error for a question that had no reply at all: nobody serves it, or the reply was lost.

    Zenoh tells neither. If nobody was ``known`` to serve the key when it was asked, that is looked
    up once more here; of a key of any instance of a service, by whether one is ready. With
    ``roles`` the question may also have been refused on its way, of which Zenoh does not tell
    either. ``device`` is what the question is put to, if only gateways answer. ``station`` is the
    one of the key.
    """
    served = known or is_served(session, key, LOOK_S)
    lacks = "" if served else ", or it knows no such question"
    found: list[AliveService] = []
    if not served:
        with while_open():
            found = alive([session], "*", timeout_s=LOOK_S)
        served = any(one.ready and _is_asked(one, key) for one in found)
    if roles and served:
        return LinkError(
            f"{key} is served, but no answer arrived: the role of this certificate may not ask it, "
            f"it ended while it worked on the question, or its answer is {_DROPPED}{lacks}",
            remedy="docs/security.md lists what each role may ask; palpate certs show tells yours",
        )
    if served:
        return LinkError(
            f"{key} is served, but no answer arrived: it ended while it worked on the question, "
            f"or its answer is {_DROPPED}{lacks}",
            remedy="ask again; if that fails, ask for less and look at the log of the service",
        )
    if others := other_stations(found, station):
        return LinkError(
            f"no process of station {station!r} runs: nobody answers on {key}",
            remedy="start it with `palpate up`, or name another one that this router sees, "
            f"--station or station=: {', '.join(others)}",
        )
    if device:
        return LinkError(
            f"no gateway has a {device} of this name: nobody answers on {key}",
            remedy="see which sensors there are: palpate status; start the gateway: palpate up",
        )
    return LinkError(
        f"no service answers on {key}",
        remedy="start the service: palpate up; see what runs: palpate status",
    )


def _is_asked(one: AliveService, key: str) -> bool:
    """Whether a question under this key goes to any instance of the service that this is."""
    return key == service_key(one.station, one.service, "*", key.rpartition("/")[2])


def is_served(session: zenoh.Session, key: str, wait_s: float) -> bool:
    """Whether somebody is known to serve the key; if not, that is waited for.

    Raises:
        LinkError: The session is closed.
    """
    if "*" in key:  # Zenoh does not tell
        return False
    end_s = time.monotonic() + wait_s
    cancellation = Cancellation.current()
    with while_open():
        querier = session.declare_querier(key, target=zenoh.QueryTarget.ALL)
        try:
            while True:
                status: Any = querier.matching_status  # stub says bool, 1.10 gives a status object
                if getattr(status, "matching", status):
                    return True
                cancelled = cancellation is not None and cancellation.cancelled.is_set()
                if cancelled or time.monotonic() >= end_s:
                    return False
                _pause(_POLL_S)
        finally:
            querier.undeclare()
