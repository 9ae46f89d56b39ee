"""Keys of the tokens by which gateways claim sensors, and the session id that they share."""

from __future__ import annotations

from dataclasses import replace

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from palpate.bus.topics import (
    SensorClaim,
    claim_key,
    claims_key,
    parse_claim_key,
    sensor_key,
)
from palpate.codec import ELECTRODE_FRAME
from palpate.errors import WireError
from palpate.messages import ElectrodeFrame

CLAIM = SensorClaim(
    "lab", "finger-1", 0xABC, True, 1_763_719_200_123_456_789, "gateway-2", "labpc", "BT/0001 *$"
)


@given(
    serial=st.text(max_size=64),
    host=st.text(max_size=64),
    session_id=st.integers(1, 2**64 - 1),
    since_ns=st.integers(0, 2**63 - 1),
    held=st.booleans(),
)
def test_any_claim_comes_back_from_its_key(
    serial: str, host: str, session_id: int, since_ns: int, held: bool
) -> None:
    serial, host = (text.encode("utf-8", "ignore").decode() for text in (serial, host))
    claim = SensorClaim("lab", "finger", session_id, held, since_ns, "gateway", host, serial)
    key = claim_key(claim)
    assert parse_claim_key(key) == claim
    assert str(zenoh.KeyExpr(key)) == key  # canonical, without wildcards


def test_claims_are_found_by_their_pattern_and_by_no_other() -> None:
    def matches(pattern: str, claim: SensorClaim) -> bool:
        return zenoh.KeyExpr(pattern).intersects(zenoh.KeyExpr(claim_key(claim)))

    waiting = replace(CLAIM, held=False, host="", serial="")
    for claim in (CLAIM, waiting):
        assert matches(claims_key("*"), claim)
        assert matches(claims_key("lab", "finger-1"), claim)
        assert not matches(claims_key("lab", "finger-2"), claim)
        assert not matches(claims_key("other"), claim)
        for foreign in ("**", "palpate/**", "palpate/@v1/**", sensor_key("*", "*", "electrodes")):
            assert not matches(foreign, claim)
    assert matches(claims_key("lab", held_only=True), CLAIM)
    assert not matches(claims_key("lab", held_only=True), waiting)


@pytest.mark.parametrize(
    "change",
    [
        ("palpate/@v1/@sensor/", "palpate/@v2/@sensor/"),
        ("/held/", "/owned/"),
        ("/finger-1/", "/Finger/"),
        ("/0000000000000abc/", "/0000000000000000/"),
        ("/0000000000000abc/", "/abc/"),
        ("/0000000000000abc/", "/-000000000000abc/"),
        ("/x6c61627063/", "/6c61627063/"),
        ("/x6c61627063/", "/xff/"),
        ("/x6c61627063/", "/"),
    ],
)
def test_other_keys_are_refused(change: tuple[str, str]) -> None:
    key = claim_key(CLAIM)
    assert change[0] in key
    with pytest.raises(WireError) as caught:
        parse_claim_key(key.replace(*change))
    assert caught.value.reason == "key"


def test_who_has_held_the_longest_comes_first() -> None:
    later = replace(CLAIM, session_id=0xAAA, since_wall_ns=CLAIM.since_wall_ns + 1)
    higher = replace(CLAIM, session_id=0xFFF)
    assert min((later, higher, CLAIM), key=lambda one: one.order) is CLAIM
    early = replace(CLAIM, held=False, session_id=0xFFF, since_wall_ns=1)
    lower = replace(CLAIM, held=False, session_id=1)
    assert min((early, lower), key=lambda one: one.order) is lower
    assert min((early, lower, later), key=lambda one: one.order) is later


def test_a_stamp_without_a_session_is_the_bytes_of_an_older_gateway(
    examples: dict[str, ElectrodeFrame],
) -> None:
    old = examples["ElectrodeFrame"]
    named = replace(old, stamp=replace(old.stamp, session_id=2**64 - 1))
    assert (
        old.stamp.session_id
        == ELECTRODE_FRAME.decode(ELECTRODE_FRAME.encode(old)).stamp.session_id
        == 0
    )
    assert ELECTRODE_FRAME.decode(ELECTRODE_FRAME.encode(named)).stamp == named.stamp
    assert len(ELECTRODE_FRAME.encode(named)) == len(ELECTRODE_FRAME.encode(old)) + 9


@pytest.mark.parametrize("session_id", [-1, 2**64])
def test_a_session_id_beyond_64_bits_is_refused(
    examples: dict[str, ElectrodeFrame], session_id: int
) -> None:
    frame = examples["ElectrodeFrame"]
    with pytest.raises(WireError) as caught:
        ELECTRODE_FRAME.encode(replace(frame, stamp=replace(frame.stamp, session_id=session_id)))
    assert caught.value.reason == "stamp"
