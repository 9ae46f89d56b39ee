"""A topic of ROS 2, received as a node with rmw_zenoh would, without ROS on this side."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Generic, NamedTuple, TypeVar

from pydantic import Field, field_validator

from palpate.bus import ForeignSubscriber, Session
from palpate.config import LinkConfig, RouterOptions
from palpate.errors import (
    DeviceError,
    DeviceLost,
    DeviceTimeout,
    LinkError,
    StreamTimeout,
    WireError,
)
from palpate.ros.layouts import type_hash
from palpate.ros.rmw_zenoh import RosNode, RosTopic, SampleInfo, check_topic_name
from palpate_gateway.device import BusDevice

T = TypeVar("T")

NODE = "palpate_gateway"
"""Name under which ``ros2 node list`` shows this end."""

_BATCH = 64
"""Largest number of waiting messages that are taken at once."""

_OTHER_S = 0.5
"""A publisher that has been silent for so long is replaced when another one publishes [s]."""


class RosTopicOptions(RouterOptions):
    """Options of every driver that receives a topic of ROS 2 over rmw_zenoh.

    The router, ``connect`` and ``tls``, is the one that ROS uses (``rmw_zenohd``).

    Attributes:
        topic: Full name, as ``ros2 topic list`` shows it.
        domain: ROS domain id.
        timeout_s: Longest time to join [s].
        wait_s: Longest time to the first message [s].
    """

    topic: str
    domain: int = Field(default=0, ge=0, le=232)
    timeout_s: float = Field(default=2.0, gt=0.0, le=60.0)
    wait_s: float = Field(default=3.0, gt=0.0, le=60.0)

    @field_validator("topic")
    @classmethod
    def _is_topic(cls, value: str) -> str:
        return check_topic_name(value)


class RosMessage(NamedTuple, Generic[T]):
    """A decoded message.

    Attributes:
        message: What the bytes say.
        lost: Messages of its publisher that were lost, or did not decode, directly before it; None
            = unknown, because it does not number them.
        sent_ns: When it was published, publisher's wall clock [ns since the epoch]; 0 = unknown.
        arrival_ns: Host's monotonic clock when it came [ns].
    """

    message: T
    lost: int | None
    sent_ns: int
    arrival_ns: int


class RosSubscription(Generic[T]):
    """One topic of one publisher; its own session through the router, so that nothing overtakes.

    ``counters``: ``lost_messages`` (gaps in the publisher's numbers), ``old_numbers``
    (messages repeated or late), ``other_publishers`` (messages of a second publisher, dropped),
    ``bad_attachments``, ``queue_overflow``, and ``rejected_...`` by reason.
    """

    def __init__(
        self, options: RosTopicOptions, layout: str, decoder: Callable[[bytes], T]
    ) -> None:
        self._options, self._layout, self._decode = options, layout, decoder
        self._session: Session | None = None
        self._subscriber: ForeignSubscriber | None = None
        self._link = LinkConfig()
        self._begin()

    def _begin(self) -> None:
        self._counts: Counter[str] = Counter(
            dict.fromkeys(
                ("lost_messages", "old_numbers", "other_publishers", "bad_attachments"), 0
            )
        )
        self._overflow = 0
        self._gid: bytes | None = None
        self._sequence = self._undecoded = 0
        self._heard_s = 0.0
        self._end: DeviceLost | None = None

    def join(self, link: LinkConfig) -> None:
        """The gateway's own way to the bus; the options take precedence."""
        options = self._options
        # Through the router only: a client needs no listener, and every message takes one path.
        self._link = options.changed(
            link, roles=False, direct=False, wait_for_router_s=options.timeout_s
        )

    @property
    def counters(self) -> Mapping[str, int]:
        """Events since it was opened last."""
        subscriber = self._subscriber  # another thread may close it meanwhile
        overflow = self._overflow if subscriber is None else subscriber.counters.get("overflow", 0)
        return {**self._counts, "queue_overflow": overflow}

    @property
    def publisher(self) -> bytes | None:
        """Id of the publisher that is followed; None = its messages give none."""
        return self._gid

    def open(self) -> RosMessage[T]:
        """Subscribe, and wait for the first message that can be decoded.

        Raises:
            DeviceLost: The router is not there.
            DeviceError: Nothing came, or nothing that could be decoded.
        """
        self._begin()
        options = self._options
        try:
            self._session = Session.open(self._link)
        except LinkError as error:
            raise DeviceLost(error.problem, remedy=error.remedy) from error
        try:
            topic = RosTopic(options.topic, self._layout, domain=options.domain)
            self._subscriber = self._session.foreign_subscriber(topic.key)
            self._announce(self._session, topic)
            return self.next(options.wait_s)
        except DeviceTimeout as error:
            seen = self._seen(self._session)
            self.close()
            raise DeviceError(
                f"no {self._layout} came on {options.topic} within {options.wait_s:g} s{seen}",
                remedy="check topic, domain and router: ros2 topic info, with RMW_IMPLEMENTATION="
                "rmw_zenoh_cpp",
            ) from error
        except BaseException:
            self.close()
            raise

    def _announce(self, session: Session, topic: RosTopic) -> None:
        """Show this end in the graph of ROS: some publishers wait for a subscription."""
        known = RosTopic(topic.name, topic.layout, type_hash(topic.layout), topic.domain)
        node = RosNode(session.zid, NODE, topic.domain)
        session.foreign_token(node.token)
        session.foreign_token(node.subscription_token(known))

    def _seen(self, session: Session) -> str:
        """What ROS publishes under this name, for the error."""
        options = self._options
        mangled = options.topic.replace("/", "%")
        tokens = session.foreign_tokens(f"@ros2_lv/{options.domain}/*/*/*/MP/*/*/*/{mangled}/*/*/*")
        types = sorted({token.split("/")[10].replace("::dds_", "").rstrip("_") for token in tokens})
        rejected = sorted(name for name in self._counts if name.startswith("rejected_"))
        if rejected:
            return f"; messages came, and could not be decoded ({', '.join(rejected)})"
        return f"; it is published as {', '.join(types)}" if types else "; nobody publishes it"

    def close(self) -> None:
        """Leave the bus."""
        if self._subscriber is not None:
            self._overflow = self._subscriber.counters.get("overflow", 0)
        session, self._session, self._subscriber = self._session, None, None
        if session is not None:
            session.close()

    def take(self, timeout_s: float) -> list[RosMessage[T]]:
        """The next message, and those that have come already; the errors are those of ``next``."""
        messages = [self.next(timeout_s)]
        assert self._subscriber is not None
        try:
            for _ in range(min(self._subscriber.waiting, _BATCH)):
                messages.append(self.next(0.0))
        except DeviceTimeout:
            pass  # what waited was nothing to deliver
        except DeviceLost as error:
            self._end = error  # raised when these are taken
        return messages

    def next(self, timeout_s: float) -> RosMessage[T]:
        """The next message of the publisher that is followed.

        Raises:
            DeviceTimeout: None came in time.
            DeviceLost: The publisher was started again, another has taken its place, or the session
                was closed.
        """
        assert self._subscriber is not None
        if self._end is not None:
            raise self._end
        until = time.monotonic() + timeout_s
        while True:
            try:
                sample = self._subscriber.next(until - time.monotonic())
            except StreamTimeout as error:
                raise DeviceTimeout(
                    f"no new message on {self._options.topic} within {timeout_s:g} s",
                    remedy="check that its driver runs: ros2 topic hz",
                ) from error
            except LinkError as error:
                raise DeviceLost(error.problem, remedy=error.remedy) from error
            info = self._info(sample.attachment)
            lost = self._lost(info)
            if lost is not None and lost < 0:
                continue
            try:
                message = self._decode(sample.payload)
            except WireError as error:
                self._counts[f"rejected_{error.reason}"] += 1
                if lost is not None:  # what it held is missing before the next one
                    self._undecoded += lost + 1
                continue
            if lost is not None:
                lost, self._undecoded = lost + self._undecoded, 0
            sent_ns = 0 if info is None else info.time_ns
            return RosMessage(message, lost, sent_ns, sample.received_monotonic_ns)

    def _info(self, attachment: bytes) -> SampleInfo | None:
        try:
            return SampleInfo.decode(attachment)
        except WireError:
            self._counts["bad_attachments"] += 1
            return None

    def _lost(self, info: SampleInfo | None) -> int | None:
        """Messages lost before this one; -1 = drop this one; None = not known."""
        now_s = time.monotonic()
        if info is None:
            return None
        if self._gid is None:
            self._gid, self._sequence, self._heard_s = info.gid, info.sequence, now_s
            return 0
        if info.gid != self._gid:
            if now_s - self._heard_s < _OTHER_S:
                self._counts["other_publishers"] += 1
                return -1
            raise DeviceLost(
                f"{self._options.topic} has another publisher than before",
                remedy="nothing, if its driver was restarted; if not, two drivers use this topic",
            )
        self._heard_s = now_s
        lost = info.sequence - self._sequence - 1
        if lost < 0:
            self._counts["old_numbers"] += 1
            return -1
        self._sequence = info.sequence
        self._counts["lost_messages"] += lost
        return lost


class RosDevice(BusDevice):
    """A device behind a topic; subclasses set ``_topic``."""

    _topic: RosSubscription[Any]

    def join(self, link: LinkConfig, station: str) -> None:
        """See ``BusDevice``; a topic of ROS belongs to no station."""
        self._topic.join(link)
