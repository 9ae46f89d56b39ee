from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.gateway.single_slots import Slot, slot_block

from palpate_gateway.biotac.frames import FrameAssembler
from palpate_gateway.protocols import channels as ch
from palpate_gateway.protocols.channels import SEQUENCES
from palpate_gateway.protocols.slot_clock import SlotClock, SlotOrder, SlotPlace

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


def test_sequences_of_the_reference() -> None:
    lengths = {name: len(sequence) for name, sequence in SEQUENCES.items()}
    assert lengths == {
        "biotac_e1_first": 44,
        "biotac_pac_first": 44,
        "biotac_sp_e1_first": 54,
        "biotac_sp_pac_first": 54,
        "numatac": 2,
    }
    assert E1_FIRST[:4] == (17, 0, 18, 0)
    assert E1_FIRST[-6:] == (1, 0, 2, 0, 3, 0)
    assert SEQUENCES["biotac_pac_first"][-1] == ch.TDC
    assert [sequence.count(ch.PAC) for sequence in SEQUENCES.values()] == [22, 22, 27, 27, 1]


@pytest.mark.parametrize("sequence", SEQUENCES.values())
def test_whole_stream_is_placed_on_the_grid(sequence: tuple[int, ...]) -> None:
    clock = SlotClock(sequence=sequence)
    size = len(sequence)
    places = place_all(clock, stream(sequence))
    begun = size if sequence.count(sequence[0]) > 1 else 0  # such a PAC does not tell its position
    assert [p.frame * size + p.position + begun for p in places] == list(range(begun, 6 * size))
    for k, place in enumerate(places):
        assert place.time_s == pytest.approx(START_S + (begun + k) * PERIOD_S, abs=1e-9)
    assert counted(clock) == ({"unplaced": begun} if begun else {})


@pytest.mark.parametrize("first", [1, 2, 43])
def test_frames_begin_with_a_whole_one(first: int) -> None:
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, stream(first=first))
    assert (places[0].frame, places[0].position) == (0, 0)
    assert places[0].time_s == pytest.approx(START_S + 44 * PERIOD_S)
    assert counted(clock) == {"unplaced": 44 - first}


@pytest.mark.parametrize("name", ["biotac_e1_first", "biotac_sp_e1_first"])
@pytest.mark.parametrize("first", [0, 7, 20])
def test_the_order_is_learnt(name: str, first: int) -> None:
    sequence = SEQUENCES[name]
    clock = SlotClock()
    assert clock.sequence == ()
    places = place_all(clock, stream(sequence, first=first))
    assert clock.sequence == sequence
    assert (places[0].frame, places[0].position) == (0, 0)
    assert {p.frame for p in places if p.position == 10} == set(range(places[-1].frame + 1))


def test_numatac_and_other_sequences_are_learnt() -> None:
    clock = SlotClock()
    place_all(clock, stream(SEQUENCES["numatac"], frames=100))
    assert clock.sequence == (ch.PDC, ch.PAC)
    odd = (*range(17, 41), ch.PAC, ch.PDC, ch.TAC, ch.TDC)
    clock = SlotClock()
    place_all(clock, stream(odd, frames=12))
    assert clock.sequence == odd


def test_learning_waits_for_a_stretch_without_loss() -> None:
    slots = stream(frames=8)
    clock = SlotClock()
    place_all(clock, [s for k, s in enumerate(slots) if k % 60 != 30 or k > 180])
    assert clock.sequence == E1_FIRST


def test_another_sequence_begins_another_run() -> None:
    sp = SEQUENCES["biotac_sp_e1_first"]
    slots = stream(frames=10)
    end_s = slots[-1][1] + PERIOD_S
    slots += [(c, t - START_S + end_s) for c, t in stream(sp, frames=10)]
    clock = SlotClock()
    places = place_all(clock, slots)
    assert clock.sequence == sp
    assert {p.run for p in places} == {0, 1}
    frames = [p.frame for p in places]
    assert frames == sorted(frames)
    configured = SlotClock(sequence=E1_FIRST)
    place_all(configured, slots)
    assert configured.sequence == E1_FIRST
    assert configured.counters["foreign"] == 50


@pytest.mark.parametrize(
    "gone", [[60], [61], [60, 61], [61, 62, 63], list(range(60, 90)), [87, 88]]
)
def test_lost_slots_leave_the_others_in_place(gone: list[int]) -> None:
    slots = stream()
    clock = SlotClock(sequence=E1_FIRST)
    kept = [k for k in range(len(slots)) if k not in gone]
    places = place_all(clock, (slots[k] for k in kept))
    assert counted(clock) == {"lost_slots": len(gone)}
    behind = [p for p, k in zip(places, kept, strict=True) if k > gone[-1] + 1]
    assert [44 * p.frame + p.position for p in behind] == list(range(gone[-1] + 2, 264))


@pytest.mark.parametrize("gone", [1, 7, 43, 44, 45, 60, 75, 88, 130])
@pytest.mark.parametrize("first", [70, 71])
@pytest.mark.parametrize("rate_hz", [4400.0, 4390.0])
def test_exact_stamps_tell_every_loss_at_once(first: int, gone: int, rate_hz: float) -> None:
    slots = stream(frames=5)
    clock = SlotClock(sequence=E1_FIRST, exact=True, slot_rate_hz=rate_hz)
    kept = [*range(first), *range(first + gone, 220)]
    places = place_all(clock, (slots[k] for k in kept))
    assert [44 * p.frame + p.position for p in places] == kept
    assert (clock.counters["lost_frames"], clock.counters["lost_slots"]) == divmod(gone, 44)


def test_repeated_and_late_slots_are_dropped() -> None:
    slots = stream()
    slots[101:101] = [slots[100]]
    slots[151:151] = [slots[145], slots[147]]
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, slots)
    assert counted(clock) == {"late": 3}
    assert len(places) == 6 * 44


@pytest.mark.parametrize("name", ["biotac_e1_first", "biotac_pac_first"])
def test_a_repeated_pac_disturbs_no_further(name: str) -> None:
    sequence = SEQUENCES[name]
    pac = sequence.index(ch.PAC)
    for at in range(132 + pac, 176, 2):
        slots = stream(sequence)
        slots[at:at] = [slots[at]]
        clock = SlotClock(sequence=sequence)
        places = place_all(clock, slots)
        assert set(counted(clock)) <= {"unplaced", "late"}
        assert clock.counters["late"] <= 1
        frames = [p.frame for p in places]
        assert frames == sorted(frames)
        assert places[-1].time_s == pytest.approx(slots[-1][1])


def test_electrodes_that_are_lost_for_long_do_not_confuse() -> None:
    slots = [s for k, s in enumerate(stream()) if not 60 < k < 200 or s[0] == ch.PAC]
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, slots)
    assert counted(clock) == {"lost_slots": 70 - 1}
    assert places[-1].time_s == pytest.approx(slots[-1][1])


def test_foreign_channels_take_no_place() -> None:
    slots = stream()
    slots.insert(100, (ch.HALL, slots[100][1]))
    clock = SlotClock(sequence=E1_FIRST)
    assert len(place_all(clock, slots)) == 6 * 44
    assert counted(clock) == {"foreign": 1}


def test_wrong_arguments() -> None:
    with pytest.raises(ValueError, match="exactly once"):
        SlotOrder([0, 1, 0, 1])
    with pytest.raises(ValueError, match="not positive"):
        SlotClock(slot_rate_hz=0.0)


def test_places_make_slots_for_the_assembler() -> None:
    clock = SlotClock(sequence=E1_FIRST)
    slots = stream(frames=10)
    del slots[100], slots[200:300]
    block = slot_block(
        [
            Slot(channel, 7, True, place.time_s, place.run, place.frame)
            for channel, stamp_s in slots
            if (place := clock.place(channel, stamp_s)) is not None
        ]
    )
    assembler = FrameAssembler(PERIOD_S)
    readings = [*assembler.push(block), *assembler.finish()]
    assert [r.tick for r in readings] == [0, 1, 2, 3, 4, 6, 7, 8, 9]
    assert assembler.counters["missing_frames"] == 1
    assert assembler.counters["incomplete_frames"] == 3


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([0, 1, 2, 3, 15, 17, 20, 35, 50]), st.floats(-1, 1)), max_size=80
    )
)
def test_any_slots_are_accounted_for(steps: list[tuple[int, float]]) -> None:
    clock = SlotClock(sequence=E1_FIRST)
    stamps = itertools.accumulate((step for _, step in steps), initial=START_S)
    places = place_all(clock, zip((channel for channel, _ in steps), stamps, strict=False))
    counters = clock.counters
    told = sum(counters[key] for key in ("placed", "unplaced", "foreign", "late"))
    assert told == len(steps)
    assert counters["placed"] == len(places)
    frames = [p.frame for p in places]
    assert frames == sorted(frames)


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(SEQUENCES)),
    st.lists(st.tuples(st.sampled_from([0, 1, 2, 3, 17, 20, 35]), st.floats(0, 0.1)), max_size=60),
    st.booleans(),
    st.booleans(),
)
def test_clean_slots_behind_any_others_find_their_place(
    name: str, steps: list[tuple[int, float]], learns: bool, exact: bool
) -> None:
    sequence = SEQUENCES[name]
    clock = SlotClock(sequence=None if learns else sequence, exact=exact)
    stamps = itertools.accumulate((-step for _, step in steps), initial=START_S)
    junk = list(zip((channel for channel, _ in steps), stamps, strict=False))
    place_all(clock, reversed(junk))
    clean = stream(sequence, frames=20 if len(sequence) > 2 else 200)
    places = [clock.place(channel, stamp_s) for channel, stamp_s in clean]
    known = clock.sequence
    for (channel, stamp_s), place in list(zip(clean, places, strict=True))[-2 * len(sequence) :]:
        assert place is not None
        assert known[place.position] == channel
        # Each of the other slots may have moved the grid by up to a frame and a stamp.
        assert abs(place.time_s - stamp_s) < 0.1 + 60 * 54 * PERIOD_S
    assert clock.counters["placed"] <= len(steps) + len(clean)


@settings(max_examples=100, deadline=None)
@given(st.sets(st.integers(50, 400), max_size=60), st.floats(0, 9e-4))
def test_scattered_loss_is_counted_exactly(gone: set[int], scatter_s: float) -> None:
    slots = stream(frames=12)
    jitter: Iterator[float] = itertools.cycle((0.0, scatter_s, scatter_s / 3))
    kept = [(c, t + next(jitter)) for k, (c, t) in enumerate(slots) if k not in gone]
    clock = SlotClock(sequence=E1_FIRST)
    places = place_all(clock, kept)
    assert clock.counters["lost_slots"] == len(gone)
    assert (places[-1].frame, places[-1].position) == (11, 43)


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(SEQUENCES)),
    st.booleans(),
    st.booleans(),
    st.sets(st.integers(0, 1500), max_size=12),
    st.dictionaries(st.integers(0, 1500), st.sampled_from([2e-3, 8e-3, 0.03, 0.2]), max_size=3),
    st.lists(st.floats(0, 1e-3), min_size=7, max_size=7),
    st.lists(st.integers(1, 90), min_size=1, max_size=20),
)
def test_many_slots_find_the_places_that_each_finds_alone(
    name: str,
    learns: bool,
    exact: bool,
    gone: set[int],
    stalls: dict[int, float],
    jitter: list[float],
    sizes: list[int],
) -> None:
    sequence = SEQUENCES[name]
    slots = stream(sequence, frames=1500 // len(sequence))
    for at, stall_s in stalls.items():
        until_s = START_S + at * PERIOD_S + stall_s
        slots = [*slots[:at], *((c, max(t, until_s)) for c, t in slots[at:])]
    if not exact:
        slots = [(c, t + j) for (c, t), j in zip(slots, itertools.cycle(jitter), strict=False)]
    slots = [slot for k, slot in enumerate(slots) if k not in gone]
    alone = SlotClock(sequence=None if learns else sequence, exact=exact)
    expected = [
        (k, place) for k, slot in enumerate(slots) if (place := alone.place(*slot)) is not None
    ]
    clock = SlotClock(sequence=None if learns else sequence, exact=exact)
    told: list[tuple[int, SlotPlace]] = []
    begin = 0
    for size in itertools.cycle(sizes):
        batch = slots[begin : begin + size]
        if not batch:
            break
        channels, stamps_s = (np.array(column) for column in zip(*batch, strict=True))
        places = clock.place_all(channels, stamps_s)
        columns = (places.run, places.frame, places.position, places.time_s)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        kept = (begin + places.kept).tolist()
        told += [(k, SlotPlace(*row)) for k, row in zip(kept, rows, strict=True)]
        begin += size
    assert told == expected
    assert clock.counters == alone.counters
    assert clock.sequence == alone.sequence
