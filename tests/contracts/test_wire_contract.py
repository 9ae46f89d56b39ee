"""Every topic and every question of the contract against what may arrive on a bus.

The tables `TOPICS` and `ENDPOINTS` are the list of tests: a new line in them is tested without a
change here, and fails until its messages have golden payloads. Valid and old messages arrive,
damaged and hostile ones end in a typed error or are counted, and afterwards all goes on.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from palpate.bus import MAX_PAYLOAD_BYTES, Delivery, Session
from palpate.bus.attachments import attachment_of
from palpate.bus.endpoints import ENDPOINTS, Endpoint
from palpate.bus.queryable import Queryable, single_reply
from palpate.bus.topics import (
    ENCODING_PREFIX,
    TOPICS,
    Topic,
    sensor_key,
    service_key,
)
from palpate.codec import CODECS, ERROR, Codec
from palpate.config import LinkConfig
from palpate.errors import ErrorCode, PalpateError, StreamTimeout, WireError
from palpate.messages import ErrorReply

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
BASELINE = descriptor_pb2.FileDescriptorSet.FromString((GOLDEN / "palpate-v1.binpb").read_bytes())

LIVE_S = 20.0
"""Longest wait for what has to happen."""

MUTATIONS = 40
OVERSIZE = bytes(MAX_PAYLOAD_BYTES + 8192)
TOO_LARGE_FOR_ANY_FIELD = bytes([0xFF]) * (MAX_PAYLOAD_BYTES - 8192)


def golden(codec: Codec[Any]) -> bytes:
    """The published payload of a message."""
    name = codec.schema.rpartition(".")[2]
    path = GOLDEN / "v1" / f"{name}.bin"
    assert path.is_file(), f"{name} is on the bus and has no valid sample: see CONTRIBUTING.md"
    return path.read_bytes()


def as_released(codec: Codec[Any]) -> bytes | None:
    """The sample as the released contract would have written it; None = the message is younger."""
    pool = descriptor_pool.DescriptorPool()
    for file in BASELINE.file:
        pool.Add(file)
    try:
        old = message_factory.GetMessageClass(pool.FindMessageTypeByName(codec.schema))
    except KeyError:
        return None
    message = old.FromString(golden(codec))
    message.DiscardUnknownFields()
    payload: bytes = message.SerializeToString()
    return payload


def mutated(payload: bytes, seed: int) -> Iterator[bytes]:
    """The payload with flipped bits, cut short, or with bytes repeated."""
    chance = random.Random(seed)
    for number in range(MUTATIONS):
        broken = bytearray(payload)
        where = chance.randrange(len(broken) or 1)
        if not broken or number % 4 == 3:
            broken[where:where] = chance.randbytes(chance.randrange(1, 9))
        elif number % 4 == 2:
            del broken[where:]
        else:
            broken[where] ^= 1 << chance.randrange(8)
        yield bytes(broken)


def hostile(codec: Codec[Any]) -> dict[str, tuple[bytes, str]]:
    """Payload and encoding of what nobody of ours would send."""
    encoding = ENCODING_PREFIX + codec.schema
    other = next(one for one in CODECS if one.schema != codec.schema)
    name = codec.schema.rpartition(".")[2]
    return {
        "wrong schema": (golden(other), ENCODING_PREFIX + other.schema),
        "no schema": (golden(codec), "zenoh/bytes"),
        "future contract": (golden(codec), f"{ENCODING_PREFIX}palpate.v2.{name}"),
        "garbage": (b"\xff" * 100, encoding),
        "pickle": (b"\x80\x04\x95\x10\x00\x00\x00", encoding),
        "garbage of the largest size": (TOO_LARGE_FOR_ANY_FIELD, encoding),
    }


@pytest.fixture(scope="module")
def link(router: Callable[[], AbstractContextManager[LinkConfig]]) -> Iterator[LinkConfig]:
    with router() as link:
        yield link


@pytest.fixture(scope="module")
def ours(link: LinkConfig) -> Iterator[Session]:
    """The side that is tested."""
    with Session.open(link) as session:
        yield session


@pytest.fixture(scope="module")
def stranger(link: LinkConfig) -> Iterator[zenoh.Session]:
    """Zenoh without palpate: sends whatever it likes."""
    with Session.open(link) as session:
        yield session._raw


def wait_for(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + LIVE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


# --- topics ---------------------------------------------------------------------------------------


class Listening:
    """A subscriber of ours to one topic, and a stranger who publishes on it."""

    def __init__(self, ours: Session, stranger: zenoh.Session, topic: Topic[Any]) -> None:
        self.topic, self._stranger = topic, stranger
        self.subscriber = ours.subscriber(topic, sensor="*", delivery=Delivery.QUEUE)
        self._number = 0
        # The first messages are lost until the stranger's side knows of the subscription.
        wait_for(lambda: self._arrives(golden(topic.codec), 0.1), f"no {topic.name} arrives")

    def key(self) -> str:
        """Of a source that has not been used: each message is the first of its sequence."""
        self._number += 1
        name = f"s{self._number}s"
        if self.topic.per_service:
            return service_key("lab", "features", name, self.topic.name)
        return sensor_key("lab", name, self.topic.name)

    def send(self, payload: bytes, *, encoding: str = "", key: str = "") -> None:
        self._stranger.put(
            key or self.key(),
            payload,
            encoding=zenoh.Encoding(encoding or self.topic.encoding),
            congestion_control=zenoh.CongestionControl.BLOCK,  # a busy host may not lose it
        )

    def _arrives(self, payload: bytes, timeout_s: float) -> bool:
        self.send(payload)
        try:
            self.subscriber.next(timeout_s)
        except StreamTimeout:
            return False
        return True

    def rejected(self) -> dict[str, int]:
        return {
            name: count
            for name, count in self.subscriber.counters.items()
            if name.startswith("rejected_")
        }

    def outcome(self, payload: bytes, *, encoding: str = "", key: str = "") -> str:
        """What becomes of a message: ``delivered``, or the reason why it is not."""
        before = self.rejected()
        control = self.key()
        self.send(payload, encoding=encoding, key=key)
        self.send(golden(self.topic.codec), key=control)
        delivered = False
        while self.subscriber.next(LIVE_S).sensor not in control:
            delivered = True
        if delivered:
            return "delivered"
        changed = [name for name, count in self.rejected().items() if count != before.get(name, 0)]
        assert len(changed) == 1, f"neither delivered nor counted: {self.subscriber.counters}"
        return changed[0]


@pytest.fixture(params=sorted(TOPICS))
def listening(
    request: pytest.FixtureRequest, ours: Session, stranger: zenoh.Session
) -> Iterator[Listening]:
    listening = Listening(ours, stranger, TOPICS[request.param])
    yield listening
    listening.subscriber.close()


def test_a_topic_delivers_what_is_valid_now_and_what_was_released(listening: Listening) -> None:
    codec = listening.topic.codec
    assert listening.outcome(golden(codec)) == "delivered"
    old = as_released(codec)
    if old is not None:
        assert listening.outcome(old) == "delivered"
    assert listening.rejected() == {}


def test_a_topic_counts_what_is_damaged_and_goes_on(listening: Listening) -> None:
    codec = listening.topic.codec
    outcomes = [listening.outcome(payload) for payload in mutated(golden(codec), seed=14)]
    assert all(one == "delivered" or one.startswith("rejected_") for one in outcomes)
    assert any(one != "delivered" for one in outcomes)


def test_a_topic_refuses_what_is_hostile_and_goes_on(listening: Listening) -> None:
    codec = listening.topic.codec
    for what, (payload, encoding) in hostile(codec).items():
        outcome = listening.outcome(payload, encoding=encoding)
        assert outcome.startswith("rejected_"), f"{what}: {outcome}"
    encoding = f"{ENCODING_PREFIX}palpate.v2.Any"
    assert listening.outcome(b"", encoding=encoding) == "rejected_future_contract"
    assert listening.outcome(b"").startswith("rejected_"), "a stream has no empty messages"
    anywhere = listening.key().replace("/lab/", "/*/")
    assert listening.outcome(golden(codec), key=anywhere) == "rejected_key"


def test_a_topic_goes_on_after_a_message_that_is_too_large(listening: Listening) -> None:
    """The receiver's Zenoh drops it and tells nobody; so our own side refuses to send it."""
    listening.send(OVERSIZE)
    assert listening.outcome(golden(listening.topic.codec)) == "delivered"


def test_our_publisher_refuses_what_is_too_large(ours: Session) -> None:
    for topic in TOPICS.values():
        with ours.publisher(topic, sensor="a", service="features", instance="a") as publisher:
            with pytest.raises(WireError, match="larger than a message may be") as caught:
                publisher.put_payload(OVERSIZE)
            assert caught.value.reason == "size"


# --- questions ------------------------------------------------------------------------------------


class Answering:
    """A queryable of ours that serves one endpoint, and a stranger who asks."""

    def __init__(self, ours: Session, stranger: zenoh.Session, name: str) -> None:
        self.endpoint: Endpoint[Any, Any] = ENDPOINTS[name]
        self._stranger = stranger
        self.key = endpoint_key(self.endpoint, "asked")
        reply = self.endpoint.reply.decode(golden(self.endpoint.reply))
        self.queryable = Queryable(
            ours._raw, self.key, self.endpoint, single_reply(lambda _: reply), capacity=8
        )
        wait_for(lambda: self.outcome(golden(self.endpoint.request)), f"{self.key} is not served")

    def outcome(
        self, payload: bytes, *, encoding: str = "", key: str = "", attachment: bytes | None = None
    ) -> ErrorReply | str:
        """What a question ends in: ``answered``, a typed error, or nothing (``""``)."""
        replies = list(
            self._stranger.get(
                key or self.key,
                payload=payload,
                encoding=zenoh.Encoding(encoding or ENCODING_PREFIX + self.endpoint.request.schema),
                attachment=attachment,
                timeout=LIVE_S,
            )
        )
        if not replies:
            return ""
        (reply,) = replies
        if reply.ok is not None:
            assert str(reply.ok.encoding) == ENCODING_PREFIX + self.endpoint.reply.schema
            self.endpoint.reply.decode(reply.ok.payload.to_bytes())
            return "answered"
        assert reply.err is not None
        assert str(reply.err.encoding) == ENCODING_PREFIX + ERROR.schema
        return ERROR.decode(reply.err.payload.to_bytes())


def endpoint_key(endpoint: Endpoint[Any, Any], name: str) -> str:
    if endpoint.per_service:
        return service_key("lab", "contract", name, endpoint.name)
    return sensor_key("lab", name, endpoint.name)


def refused(outcome: ErrorReply | str) -> bool:
    return (
        isinstance(outcome, ErrorReply)
        and outcome.code is ErrorCode.INVALID_REQUEST
        and bool(outcome.message and outcome.remedy)
    )


@pytest.fixture(params=sorted(ENDPOINTS))
def answering(
    request: pytest.FixtureRequest, ours: Session, stranger: zenoh.Session
) -> Iterator[Answering]:
    answering = Answering(ours, stranger, request.param)
    yield answering
    answering.queryable.close()


def test_an_endpoint_answers_what_is_valid_now_and_what_was_released(answering: Answering) -> None:
    codec = answering.endpoint.request
    assert answering.outcome(golden(codec)) == "answered"
    assert answering.outcome(golden(codec), attachment=attachment_of(5.0)) == "answered"
    old = as_released(codec)
    if old is not None:
        assert answering.outcome(old) == "answered"


def test_an_endpoint_answers_or_refuses_what_is_damaged(answering: Answering) -> None:
    payload = golden(answering.endpoint.request)
    for broken in mutated(payload, seed=14):
        outcome = answering.outcome(broken)
        assert outcome == "answered" or refused(outcome), outcome
    assert answering.outcome(payload) == "answered"


def test_an_endpoint_refuses_what_is_hostile_and_goes_on(answering: Answering) -> None:
    codec = answering.endpoint.request
    for what, (payload, encoding) in hostile(codec).items():
        outcome = answering.outcome(payload, encoding=encoding)
        # An empty request has no schema to be wrong.
        assert refused(outcome) or (not payload and outcome == "answered"), what
    outcome = answering.outcome(b"")
    assert outcome == "answered" or refused(outcome), "an empty request may mean the defaults"
    assert refused(answering.outcome(golden(codec), attachment=b"palpate.v1;timeout_ms=-1"))
    wild = answering.key.replace("/asked/", "/*/")
    outcome = answering.outcome(golden(codec), key=wild)
    assert (outcome == "answered") if answering.endpoint.per_service else refused(outcome)
    late = answering.outcome(golden(codec), attachment=b"palpate.v1;timeout_ms=0")
    assert isinstance(late, ErrorReply)
    assert late.code is ErrorCode.DEADLINE_EXCEEDED
    assert answering.outcome(golden(codec)) == "answered"

    def open_questions() -> int:
        counters = answering.queryable.counters
        return 2 * counters["received"] - sum(counters.values())

    wait_for(lambda: open_questions() == 0, "each question is counted once as what it ended in")


@pytest.mark.parametrize("name", sorted(ENDPOINTS))
def test_a_foreign_answer_is_a_value_or_a_typed_error(
    name: str, ours: Session, stranger: zenoh.Session
) -> None:
    endpoint = ENDPOINTS[name]
    key = endpoint_key(endpoint, "foreign")
    request = endpoint.request.decode(golden(endpoint.request))
    valid = golden(endpoint.reply)
    encoding = ENCODING_PREFIX + endpoint.reply.schema
    answers: list[Callable[[zenoh.Query], None]] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            answers[-1](query)

    def replying(payload: bytes, encoding: str) -> Callable[[zenoh.Query], None]:
        return lambda query: query.reply(key, payload, encoding=zenoh.Encoding(encoding))

    def failing(payload: bytes, encoding: str) -> Callable[[zenoh.Query], None]:
        return lambda query: query.reply_err(payload, encoding=zenoh.Encoding(encoding))

    def outcome(answer: Callable[[zenoh.Query], None]) -> object:
        """The value, or the typed error; another exception fails the test."""
        answers.append(answer)
        try:
            return ours.query(
                endpoint,
                request,
                sensor="foreign",
                service="contract",
                instance="foreign",
                timeout_s=LIVE_S,
            )
        except PalpateError as error:
            return error if error.problem and error.remedy else "an error without a remedy"

    queryable = stranger.declare_queryable(key, answer, complete=True)
    try:
        good = replying(valid, encoding)
        wait_for(lambda: not isinstance(outcome(good), PalpateError), f"{key} is not served")
        old = as_released(endpoint.reply)
        if old is not None:
            assert not isinstance(outcome(replying(old, encoding)), PalpateError)
        for broken in mutated(valid, seed=15):
            outcome(replying(broken, encoding))
        for what, (payload, schema) in hostile(endpoint.reply).items():
            assert isinstance(outcome(replying(payload, schema)), WireError), what
        for bad in (
            failing(b"\xff\xff", ENCODING_PREFIX + ERROR.schema),
            failing(b"no", "zenoh/bytes"),
            failing(b"", ""),
            lambda query: None,
            replying(OVERSIZE, encoding),
        ):
            assert isinstance(outcome(bad), PalpateError)
        assert not isinstance(outcome(good), PalpateError), "the next question is answered"
    finally:
        queryable.undeclare()


def test_every_endpoint_and_topic_of_the_package_is_in_its_table() -> None:
    from palpate.bus import endpoints, topics

    assert {id(one) for one in ENDPOINTS.values()} == {
        id(one) for one in vars(endpoints).values() if isinstance(one, Endpoint)
    }
    assert {id(one) for one in TOPICS.values()} == {
        id(one) for one in vars(topics).values() if isinstance(one, Topic)
    }
