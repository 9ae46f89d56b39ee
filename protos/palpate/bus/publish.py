"""Publishing: checked, encoded, with the manners of its topic."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import zenoh

from palpate.bus.topics import Topic
from palpate.errors import LinkError

M = TypeVar("M")


class Publisher(Generic[M]):
    """Publishes one topic of one sensor or service. Made by ``Session.publisher``."""

    def __init__(
        self, session: zenoh.Session, topic: Topic[M], key: str, *, lossless: bool
    ) -> None:
        self.topic = topic
        self.key = key
        self._publisher = session.declare_publisher(
            key,
            encoding=zenoh.Encoding(topic.encoding),
            # A frozen subscriber must not stall acquisition: drop. Replay must lose nothing: block.
            congestion_control=(
                zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
            ),
            priority=(
                zenoh.Priority.DATA if lossless else getattr(zenoh.Priority, topic.priority.name)
            ),
            # Not express: an express message takes a whole transmit batch, so twenty sensors that
            # publish in the same millisecond fill the queue and lose frames. A frame that finds
            # an idle link leaves at once either way.
            express=False,
            reliability=zenoh.Reliability.RELIABLE,
        )
        self._encode = topic.codec.encode

    def put(self, message: M) -> None:
        """Check, encode and publish.

        Raises:
            WireError: The message breaks the contract.
            LinkError: The session is closed.
        """
        self.put_payload(self._encode(message))

    def put_payload(self, payload: bytes) -> None:
        """Publish a payload that is already encoded.

        Raises:
            LinkError: The session is closed.
        """
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            raise LinkError(
                f"cannot publish on {self.key}: {error}", remedy="open the session again"
            ) from error

    def matched(self) -> bool:
        """Whether anyone subscribes at present."""
        status: Any = self._publisher.matching_status  # stub says bool, 1.10 gives a status object
        return bool(getattr(status, "matching", status))

    def close(self) -> None:
        """Undeclare."""
        self._publisher.undeclare()
