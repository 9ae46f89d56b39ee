from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.gateway.single_slots import Slot, slot_block

from palpate.messages import BIOTAC_LAYOUT
from palpate_gateway.biotac.frames import FrameAssembler
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading

PERIOD_S = 1 / 4400


def slots_of(frame: int, *, start: str = "pac", batch: int = 0) -> list[Slot]:
    slow = [*range(17, 36), ch.PDC, ch.TAC, ch.TDC]
    pairs = [(0, one) if start == "pac" else (one, 0) for one in slow]
    ids = [channel for pair in pairs for channel in pair]
    return [
        Slot(channel, 100 + 50 * channel + k, True, (frame * 44 + k) * PERIOD_S, batch, frame)
        for k, channel in enumerate(ids)
    ]


def assemble(slots: list[Slot], block: int = 1000) -> tuple[list[ElectrodeReading], FrameAssembler]:
    assembler = FrameAssembler(PERIOD_S)
    readings: list[ElectrodeReading] = []
    for at in range(0, len(slots), block):
        readings += assembler.push(slot_block(slots[at : at + block]))
    return readings + assembler.finish(), assembler


@pytest.mark.parametrize("start", ["pac", "e1"])
def test_decodes_by_channel_id(start: str) -> None:
    slots = slots_of(7, start=start)
    readings, assembler = assemble(slots)
    assert len(readings) == 1
    reading = readings[0]
    by_channel = {slot.channel: slot.value for slot in slots if slot.channel}
    assert reading.electrodes.tolist() == [by_channel[c] for c in range(17, 36)]
    assert (reading.pdc, reading.tac, reading.tdc) == (by_channel[1], by_channel[2], by_channel[3])
    assert reading.pac.tolist() == [slot.value for slot in slots if slot.channel == 0]
    assert reading.validity == ch.ALL_VALID
    assert (reading.tick, reading.missed_before) == (7, 0)
    assert assembler.counters["samples"] == 44


@settings(max_examples=50)
@given(st.permutations(range(44)), st.integers(1, 100))
def test_order_and_blocks_do_not_matter(order: list[int], block: int) -> None:
    first, second = slots_of(1), slots_of(2)
    shuffled = [first[k] for k in order] + second
    readings, _ = assemble(shuffled, block)
    whole, _ = assemble([*first, *second])
    assert [r.electrodes.tolist() for r in readings] == [r.electrodes.tolist() for r in whole]
    assert [r.tick for r in readings] == [1, 2]


def test_whole_frame_is_delivered_at_once() -> None:
    assembler = FrameAssembler(PERIOD_S)
    assert len(assembler.push(slot_block(slots_of(1)[:43]))) == 0
    assert len(assembler.push(slot_block(slots_of(1)[43:]))) == 1
    # A late repetition of its slots is no new frame.
    assert assembler.push(slot_block(slots_of(1)[:3])) == []
    assert assembler.counters["duplicate_slots"] == 3


@pytest.mark.parametrize("block", [1, 44, 1000])
@pytest.mark.parametrize(("start", "twice"), [("e1", 1), ("pac", 2)])
def test_a_pac_slot_that_came_twice_shifts_no_other(start: str, twice: int, block: int) -> None:
    placed = [
        [slot._replace(position=k) for k, slot in enumerate(slots_of(frame, start=start))]
        for frame in (1, 2, 3)
    ]
    doubled = [*placed[1][: twice + 1], *placed[1][twice:]]
    readings, assembler = assemble([*placed[0], *doubled, *placed[2]], block)
    assert [one.tick for one in readings] == [1, 2, 3]
    right = [slot.value for slot in placed[1] if slot.channel == ch.PAC]
    for k, value in enumerate(readings[1].pac.tolist()):
        good = readings[1].validity >> ch.FIRST_PAC_BIT + k & 1
        assert value == (right[k] if good else 0)
    assert assembler.counters["duplicate_slots"] >= 1


def test_missing_slots_are_invalid_not_fatal() -> None:
    slots = [s for s in slots_of(1) if s.channel not in (ch.PDC, 20)][:-2]
    readings, assembler = assemble(slots + slots_of(2))
    bad = [BIOTAC_LAYOUT.bit_name(b) for b in range(44) if not readings[0].validity >> b & 1]
    # Two slots of the frame's end and two others are gone: TDC and one PAC, PDC and E4.
    assert bad == ["E4", "PDC", "TDC", "PAC[21]"]
    assert readings[0].electrodes[3] == 0
    assert readings[1].validity == ch.ALL_VALID
    assert assembler.counters["incomplete_frames"] == 1


def test_bad_parity_is_invalid_and_counted_by_channel() -> None:
    slots = slots_of(1)
    slots[1] = slots[1]._replace(good=False)
    slots[2] = slots[2]._replace(good=False)
    readings, assembler = assemble(slots)
    assert readings[0].validity == ch.ALL_VALID & ~1 & ~(1 << ch.FIRST_PAC_BIT + 1)
    assert readings[0].electrodes[0] == slots[1].value
    assert assembler.counters["parity_errors"] == 2
    assert assembler.parity_errors_by_channel == {"E1": 1, "PAC": 1}


def test_unknown_hall_and_surplus_slots_are_counted() -> None:
    slots = slots_of(1)
    extra = [
        slots[-1]._replace(channel=50),
        slots[-1]._replace(channel=-3),
        slots[-1]._replace(channel=ch.HALL),
        slots[-1]._replace(channel=17, value=4000),
        slots[-1]._replace(channel=0),
    ]
    readings, assembler = assemble(extra[:4] + slots + slots_of(2))
    assert readings[0].electrodes[0] == 4000  # the first wins
    counters = assembler.counters
    assert counters["unknown_channels"] == 2
    assert counters["ignored_slots"] == 1
    assert counters["duplicate_slots"] == 1
    _, assembler = assemble([extra[4], *slots])
    assert assembler.counters["duplicate_slots"] == 1


def test_missing_frames_restarts_and_jumps() -> None:
    slots = slots_of(5) + slots_of(8) + slots_of(2) + slots_of(3)
    readings, assembler = assemble(slots)
    assert [r.missed_before for r in readings] == [0, 2, 0, 0]
    assert [r.tick for r in readings] == [5, 8, 9, 10]
    assert assembler.counters["missing_frames"] == 2
    assert assembler.counters["counter_restarts"] == 1
    assert assembler.counters["time_jumps"] == 2  # over two frames, and back


def test_a_million_frames_may_be_lost_and_no_more() -> None:
    for lost, restarts in ((1_000_000, 0), (1_000_001, 1)):
        readings, assembler = assemble(slots_of(5) + slots_of(6 + lost))
        assert assembler.counters["counter_restarts"] == restarts
        assert readings[1].missed_before == (0 if restarts else lost)


def test_time_jump_is_more_than_a_millisecond_off_the_grid() -> None:
    near, far = slots_of(1), slots_of(1)
    near[10:] = [s._replace(time_s=s.time_s + 0.9e-3) for s in near[10:]]
    far[10:] = [s._replace(time_s=s.time_s + 1.1e-3) for s in far[10:]]
    assert assemble(near)[1].counters["time_jumps"] == 0
    assert assemble(far)[1].counters["time_jumps"] == 1
    assert assemble(far, block=10)[1].counters["time_jumps"] == 1


def test_saturated_samples_are_counted_and_kept() -> None:
    slots = slots_of(1)
    slots[0] = slots[0]._replace(value=4095)
    slots[1] = slots[1]._replace(value=0)
    readings, assembler = assemble(slots)
    assert assembler.counters["saturated_samples"] == 2
    assert readings[0].validity == ch.ALL_VALID
    for value in (0, 4095):
        alone = [*slots_of(1)[:-1], slots_of(1)[-1]._replace(value=value)]
        assert assemble(alone)[1].counters["saturated_samples"] == 1


slot_strategy = st.builds(
    Slot,
    channel=st.integers(-5, 300),
    value=st.integers(0, 4095),
    good=st.booleans(),
    time_s=st.floats(0, 10),
    batch=st.integers(0, 3),
    frame=st.integers(0, 5),
    position=st.integers(-1, 60),
)


@settings(max_examples=100)
@given(st.lists(slot_strategy, max_size=120), st.integers(1, 50))
def test_any_slots_are_accounted_for(slots: list[Slot], block: int) -> None:
    readings, assembler = assemble(slots, block)
    counters = assembler.counters
    assert counters["samples"] == len(slots)
    assert counters["frames"] == len(readings)
    present = sum(r.validity.bit_count() for r in readings)
    refused = sum(
        counters[name]
        for name in (
            "unknown_channels",
            "ignored_slots",
            "other_electrodes",
            "duplicate_slots",
            "unplaced_slots",
        )
    )
    assert present <= len(slots) - refused
    ticks = [r.tick for r in readings]
    assert ticks == sorted(set(ticks))
    assert all(r.electrodes.dtype == np.uint16 and r.pac.shape == (22,) for r in readings)
