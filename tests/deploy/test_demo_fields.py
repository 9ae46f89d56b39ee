"""Fields and syntheses of the demo, matched with what is known of them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from palpate.errors import LinkError, StreamTimeout
from palpate.messages import Origin, Stamp
from palpate_deploy.demo.comparison import FieldComparison, FieldStreams

MS = 1_000_000


@dataclass
class Message:
    """Any message, by its attributes."""

    stamp: Any = None
    source: Any = None
    displacement: Any = None
    tared_counts: Any = None
    electrodes: Any = None
    tare_id: int = 7


@dataclass
class Stream:
    """A subscriber that has some messages."""

    waiting: deque[Any] = field(default_factory=deque)

    def next(self, timeout_s: float) -> Any:
        assert timeout_s == 0
        if not self.waiting:
            raise StreamTimeout("nothing", remedy="wait")
        return type("Received", (), {"message": self.waiting.popleft()})


def stamp(ms: int) -> Stamp:
    return Stamp(
        sequence=ms,
        monotonic_ns=ms * MS,
        wall_ns=ms * MS,
        clock_id=1,
        device_tick=ms,
        origin=Origin.SIMULATED,
    )


@pytest.fixture
def streams() -> Any:
    parts: Any = [*(Stream() for _ in range(4)), find]
    return FieldStreams(*parts)


REST = np.full(19, 3000.0)


def find(tare_id: int) -> Any:
    """The tare of before the client came: nobody announces it again."""
    if tare_id != 7:
        raise LinkError("no gateway", remedy="start one")
    return Message(electrodes=REST)


def moved(mm: float) -> Any:
    return np.full((10, 3), mm * 1e-3 / np.sqrt(3), np.float32)


def test_truth_between_two_known_fields_is_on_their_line(streams: Any) -> None:
    comparison = FieldComparison()
    streams.truth.waiting += [
        Message(stamp=stamp(0), displacement=moved(0.2)),
        Message(stamp=stamp(50), displacement=moved(0.4)),
    ]
    streams.field.waiting.append(Message(source=stamp(25), displacement=moved(0.35)))
    comparison.take(streams)
    found = comparison.medians()
    assert found.fields == 1
    assert found.moved_m == pytest.approx(0.3e-3, rel=1e-5)
    assert found.field_m == pytest.approx(0.05e-3, rel=1e-4)


def test_estimate_waits_for_the_truth_that_comes_later(streams: Any) -> None:
    comparison = FieldComparison()
    streams.truth.waiting.append(Message(stamp=stamp(0), displacement=moved(0.2)))
    streams.field.waiting.append(Message(source=stamp(10), displacement=moved(0.2)))
    comparison.take(streams)
    assert comparison.medians().fields == 0
    streams.truth.waiting.append(Message(stamp=stamp(50), displacement=moved(0.2)))
    comparison.take(streams)
    assert comparison.medians().fields == 1
    assert comparison.medians().field_m == pytest.approx(0.0, abs=1e-9)


def test_untouched_moments_and_other_meshes_do_not_count(streams: Any) -> None:
    comparison = FieldComparison()
    streams.truth.waiting += [
        Message(stamp=stamp(t), displacement=moved(0.01)) for t in (0, 50, 100)
    ]
    streams.truth.waiting.append(Message(stamp=stamp(150), displacement=moved(1.0)))
    streams.field.waiting.append(Message(source=stamp(20), displacement=moved(0.0)))
    streams.field.waiting.append(
        Message(source=stamp(150), displacement=np.zeros((4, 3), np.float32))
    )
    comparison.take(streams)
    assert comparison.medians().fields == 0


def test_synthesis_is_held_against_the_tared_frame_of_the_same_instant(streams: Any) -> None:
    comparison = FieldComparison()
    pressed = REST.copy()
    pressed[3] -= 500
    for at, counts, tare_id in ((10, pressed, 7), (20, REST, 7), (40, pressed, 8)):
        frame = Message(stamp=stamp(at), electrodes=counts, tare_id=tare_id)
        streams.electrodes.waiting.append(frame)
    for at in (10, 20, 30, 40):
        streams.synthesis.waiting.append(
            Message(source=stamp(at), tared_counts=pressed - REST + 19.0)
        )
    comparison.take(streams)
    found = comparison.medians()
    # Untouched at 20 ms, no frame at 30 ms, a tare that nobody knows at 40 ms.
    assert found.syntheses == 1
    assert found.counts == pytest.approx(19.0)
