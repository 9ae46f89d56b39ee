from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from palpate_gateway.protocols.channels import SEQUENCES
from palpate_gateway.protocols.slot_clock import SlotClock, SlotPlace
from palpate_gateway.recordings.text_log import TextLogReader

E1_FIRST = SEQUENCES["biotac_e1_first"]
PERIOD_S = 1 / 4400
START_S = 1000.0

Stamped = tuple[int, float]


def stream(
    sequence: tuple[int, ...] = E1_FIRST, *, frames: int = 6, first: int = 0
) -> list[Stamped]:
    """Slots with exact stamps, from a position on."""
    slots = itertools.islice(itertools.cycle(sequence), first, frames * len(sequence))
    return [(channel, START_S + k * PERIOD_S) for k, channel in enumerate(slots, first)]


def place_all(clock: SlotClock, slots: Iterable[Stamped]) -> list[SlotPlace]:
    places = (clock.place(channel, stamp_s) for channel, stamp_s in slots)
    return [place for place in places if place is not None]


def counted(clock: SlotClock) -> dict[str, int]:
    return {key: count for key, count in clock.counters.items() if count and key != "placed"}


def stalled(slots: list[Stamped], at: int, until_s: float) -> list[Stamped]:
    """What came from slot ``at`` on is seen when the host wakes, then as fast as it can."""
    awake = (until_s + 20e-6 * k for k in itertools.count())
    return slots[:at] + [(c, max(t, next(awake))) for c, t in slots[at:]]


@pytest.mark.parametrize("gone", [45, 60, 88, 100, 130])
@pytest.mark.parametrize("first", [70, 71])
def test_more_than_a_frame_is_counted_by_the_stamps(first: int, gone: int) -> None:
    slots = stream(frames=14)
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, slots[:first] + slots[first + gone :])
    lost = 44 * clock.counters["lost_frames"] + clock.counters["lost_slots"]
    assert lost == gone
    assert 44 * places[-1].frame + places[-1].position == 14 * 44 - 1
    assert places[-1].time_s == pytest.approx(slots[-1][1])


def test_a_long_pause_is_known_at_once() -> None:
    slots = stream(frames=80)
    clock = SlotClock(sequence=E1_FIRST)
    place_all(clock, slots[:80])
    place = clock.place(*slots[80 + 50 * 44 + 4])
    assert place is not None
    assert (place.frame, place.position) == (51, 40)
    assert counted(clock) == {"lost_slots": 4, "lost_frames": 50}


@pytest.mark.parametrize("stall_s", [8e-3, 15e-3, 0.03, 0.2])
@pytest.mark.parametrize("at", [300, 301, 352])
def test_a_stall_of_the_host_is_no_loss(at: int, stall_s: float) -> None:
    slots = stream(frames=60)
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, stalled(slots, at, slots[at][1] + stall_s))
    assert counted(clock) == {}
    assert places[-1].time_s == pytest.approx(slots[-1][1])


@pytest.mark.parametrize("at_once", [92, 100, 130])
def test_a_starved_sender_that_catches_up_slowly_has_lost_nothing(at_once: int) -> None:
    """It runs 1 ms in 20, and sends a little more each time than was sampled meanwhile."""
    slots = stream(frames=200)
    wakes_s = (slots[300][1] + 0.06 + 0.02 * k for k in itertools.count())
    seen, at = slots[:300], 300
    while at < len(slots):
        wake_s = next(wakes_s)
        due = [slot for slot in slots[at : at + at_once] if slot[1] <= wake_s]
        seen += [(channel, wake_s + 10e-6 * k) for k, (channel, _) in enumerate(due)]
        at += len(due)
        if len(due) < at_once:
            break
    seen += slots[at:]
    clock = SlotClock(sequence=E1_FIRST)
    place_all(clock, seen)
    assert counted(clock) == {}


def starved(slots: list[Stamped], seed: int) -> list[Stamped]:
    """From slot 2000 to 6000 its sender gets the processor in turns; at last it makes up."""
    rng = np.random.default_rng(seed)
    now_s = slots[2000][1] + 0.03
    seen = slots[:2000]
    while len(seen) < 6000:
        turn_s = float(rng.uniform(3e-3, 9e-3))
        now_s += turn_s
        for channel, due_s in slots[len(seen) :][: int(turn_s / PERIOD_S * rng.uniform(0.6, 1.5))]:
            if due_s < now_s:
                seen.append((channel, now_s))
                now_s += 20e-6
    queue = (now_s + 60e-6 * k for k in itertools.count())
    return seen + [(channel, max(due_s, next(queue))) for channel, due_s in slots[len(seen) :]]


@pytest.mark.parametrize("seed", range(20))
def test_a_starved_sender_that_falls_behind_in_turns_has_lost_nothing(seed: int) -> None:
    clock = SlotClock(sequence=E1_FIRST)
    place_all(clock, starved(scattered(stream(frames=300), 3e-4), seed))
    assert counted(clock) == {}


def scattered(slots: list[Stamped], by_s: float) -> list[Stamped]:
    """Stamps come late by some time, and in order."""
    late_s = np.random.default_rng(0).exponential(by_s, len(slots))
    stamps_s = np.maximum.accumulate(np.array([stamp_s for _, stamp_s in slots]) + late_s)
    return [(channel, stamp_s) for (channel, _), stamp_s in zip(slots, stamps_s, strict=True)]


@pytest.mark.parametrize("clump_s", [0.0, 2e-3, 16e-3, 50e-3])
def test_whole_frames_that_are_gone_are_told_once_what_follows_is_steady(clump_s: float) -> None:
    slots = scattered(stream(frames=500), 3e-4)
    if clump_s:
        slots = [(c, (t // clump_s + 1) * clump_s) for c, t in slots]
    clock = SlotClock(sequence=E1_FIRST)
    gone = 12
    places = place_all(clock, slots[: 44 * 100] + slots[44 * (100 + gone) :])
    assert counted(clock) == {"lost_frames": gone}
    told = next(k for k, place in enumerate(places) if place.frame >= 100 + gone)
    # Clumps longer than a frame look like a host that stalls again and again.
    assert told / 44 - 100 <= (8 if clump_s < 0.01 else 210)


def test_a_full_queue_behind_a_stall_is_a_loss() -> None:
    slots = stream(frames=100)
    until_s = slots[300][1] + 0.3
    seen = stalled(slots, 300, until_s)
    # The queue held 500 slots; what came while it was full is gone.
    seen = seen[:800] + [(c, t) for c, t in slots[800:] if t > until_s + 0.01]
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, seen)
    lost = 44 * clock.counters["lost_frames"] + clock.counters["lost_slots"]
    assert lost == len(slots) - len(seen)
    assert places[-1].frame == 99


@pytest.mark.parametrize("clump_s", [2e-3, 16e-3, 50e-3])
def test_an_adapter_that_delivers_in_clumps(clump_s: float) -> None:
    slots = stream(frames=100)
    clumped = [(c, (t // clump_s + 1) * clump_s) for c, t in slots]
    del clumped[1000:1007]
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, clumped)
    assert counted(clock) == {"lost_slots": 7}
    assert (places[-1].frame, places[-1].position) == (99, 43)


def test_a_sender_that_pauses_off_the_grid_begins_a_new_one() -> None:
    slots = stream(frames=40)
    late_s = 0.104  # ten frames and 4 ms
    seen = slots[:440] + [(c, t + late_s) for c, t in slots[440:]]
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, seen)
    assert counted(clock) == {"lost_frames": 10}
    assert places[-1].time_s == pytest.approx(seen[-1][1], abs=1e-6)


def test_pauses_of_the_public_capture(shared_data: Path) -> None:
    # One frame is missing behind every batch, and 154 pauses leave the order whole.
    blocks = list(TextLogReader(shared_data / "syntouch_btd_raw" / "data.btd.gz").blocks())
    channels = np.concatenate([block.channel for block in blocks]).tolist()
    times = np.concatenate([block.time_s for block in blocks]).tolist()
    for exact in (False, True):
        clock = SlotClock(sequence=SEQUENCES["biotac_pac_first"], exact=exact)
        places = place_all(clock, zip(channels, times, strict=True))
        assert clock.counters["lost_slots"] == 0
        span_frames = (times[-1] - times[0]) / (44 * PERIOD_S)
        assert places[-1].frame == pytest.approx(span_frames - 1, abs=8)
        assert places[-1].time_s == pytest.approx(times[-1], abs=1e-3)
