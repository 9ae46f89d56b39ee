"""Keys that are not palpate's: raw samples of other programs on Zenoh, e.g. nodes of ROS 2.

Nothing here is decoded, and no contract is checked: bytes in, bytes out.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import NamedTuple

import zenoh

from palpate.bus.delivery import FifoQueue
from palpate.bus.ring import is_wake, subscription_closed, undeclare
from palpate.bus.zenoh_session import Declared, said
from palpate.errors import LinkError, StreamTimeout


class ForeignSample(NamedTuple):
    """A sample as it came.

    Attributes:
        key: Its key.
        payload: Its bytes.
        attachment: The bytes attached to it; empty = none.
        received_monotonic_ns: Host monotonic clock when it came [ns].
    """

    key: str
    payload: bytes
    attachment: bytes
    received_monotonic_ns: int


_WAITING_MOST = 4096
"""Samples that may wait."""


class ForeignSubscriber(Declared):
    """Samples of a key expression, first in, first out. Made by ``Session.foreign_subscriber``."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._key = key
        self._counters: Counter[str] = Counter()
        self._waiting: FifoQueue[ForeignSample] = FifoQueue(
            self._counters, _WAITING_MOST, sender_waits=False
        )
        in_order = zenoh.handlers.Callback(self._on_sample, indirect=False)
        self._subscriber = session.declare_subscriber(key, in_order)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if is_wake(sample) or sample.kind != zenoh.SampleKind.PUT:
            return
        now_ns = time.monotonic_ns()
        key = str(sample.key_expr)
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self._counters["received"] += 1
        self._waiting.put(key, ForeignSample(key, sample.payload.to_bytes(), attachment, now_ns))

    @property
    def counters(self) -> dict[str, int]:
        """``received``, and ``overflow``: samples that found no place to wait."""
        return dict(self._counters)

    @property
    def waiting(self) -> int:
        """How many samples wait."""
        return len(self._waiting)

    def next(self, timeout_s: float) -> ForeignSample:
        """The next sample.

        Raises:
            StreamTimeout: None came within ``timeout_s``.
            LinkError: None is left, and this or the session is closed.
        """
        item = self._waiting.get(max(timeout_s, 0.0))
        if item is None and self.closed:
            raise subscription_closed(self._key)
        if item is None:
            raise StreamTimeout(
                f"no sample within {timeout_s:g} s", remedy="check that its program runs"
            )
        return item[0]

    def close(self) -> None:
        """Undeclare."""
        self.closed = True
        self._waiting.close()
        undeclare(self._subscriber)


class ForeignPublisher(Declared):
    """Publishes bytes on one key; drops rather than block. Made by ``Session``."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.key = key
        self._publisher = session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP
        )

    def put(self, payload: bytes, attachment: bytes) -> None:
        """Publish a sample.

        Raises:
            LinkError: The session is closed.
        """
        try:
            self._publisher.put(payload, attachment=attachment)
        except (zenoh.ZError, RuntimeError) as error:  # RuntimeError: it is being undeclared
            raise LinkError(
                f"cannot publish on {self.key}: {said(error)}", remedy="open the session again"
            ) from error

    def close(self) -> None:
        """Undeclare."""
        self.closed = True
        undeclare(self._publisher)


class ForeignToken(Declared):
    """A liveliness token with a key of another system."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._token = session.liveliness().declare_token(key)

    def close(self) -> None:
        """Withdraw it."""
        self.closed = True
        undeclare(self._token)
