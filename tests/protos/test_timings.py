"""Stage timings travel beside an estimate: the payload stays what it is."""

from __future__ import annotations

from typing import Any

import pytest

from palpate.bus import Session
from palpate.bus.topics import FEATURES
from palpate.codec import STAGE_TIMINGS
from palpate.messages import StageTimings

TIMINGS = StageTimings(2**-9, 2**-14, 2**-15, 2**-16, 2**-12, 2**-13)


@pytest.mark.parametrize(
    ("attachment", "expected"),
    [
        (STAGE_TIMINGS.encode(TIMINGS), TIMINGS),
        (None, None),
        (b"\xff\xff\xff", None),
        (b"\x15\x00\x00\xc0\x7f", None),  # waiting_s is NaN
    ],
)
def test_timings_come_as_they_were_sent_and_never_cost_a_message(
    pair: tuple[Session, Session],
    examples: dict[str, Any],
    wait_until: Any,
    attachment: bytes | None,
    expected: StageTimings | None,
) -> None:
    a, b = pair
    estimate = examples["FeatureEstimate"]
    with (
        a.publisher(FEATURES, sensor="finger") as publisher,
        b.subscriber(FEATURES, sensor="finger") as subscriber,
    ):
        wait_until(publisher.matched)
        publisher.put_payload(publisher.encode(estimate), attachment=attachment)
        received = subscriber.next(20.0)
    assert received.payload == FEATURES.codec.encode(estimate)
    assert received.timings == expected
    assert received.decode_s >= 0.0
