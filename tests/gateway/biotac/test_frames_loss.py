"""PAC samples keep their place where slots are lost; the quick way and the long one agree."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.gateway.single_slots import Slot, slot_block

from palpate.messages import BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT, FrameLayout
from palpate_gateway.biotac.frames import FrameAssembler
from palpate_gateway.biotac.slots import UNKNOWN, SlotBlock
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading

PERIOD_S = 1 / 4400
LAYOUTS = [BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT]


def frame_of(
    frame: int, layout: FrameLayout, *, pac_first: bool = False, told: bool = True
) -> list[Slot]:
    """A frame whose values tell the channel, and of PAC the number of the sample."""
    order = ch.interleaved(layout, pac_first=pac_first)
    return [
        Slot(
            channel,
            1000 + place // 2 if channel == ch.PAC else 2000 + channel,
            True,
            (frame * layout.slots + place) * PERIOD_S,
            0,
            frame,
            place if told else UNKNOWN,
        )
        for place, channel in enumerate(order)
    ]


def assemble(
    slots: list[Slot], layout: FrameLayout, *, timed: bool = True, block: int = 10_000
) -> tuple[list[ElectrodeReading], FrameAssembler]:
    assembler = FrameAssembler(PERIOD_S, layout, timed=timed)
    readings: list[ElectrodeReading] = []
    for at in range(0, len(slots), block):
        readings += assembler.push(slot_block(slots[at : at + block]))
    return readings + assembler.finish(), assembler


def bad_channels(reading: ElectrodeReading, layout: FrameLayout) -> list[str]:
    """Names of the channels that are not valid; all others must hold what they were sent."""
    truth = [2000 + channel for channel in ch.channels_of(layout)]
    truth += [1000 + number for number in range(layout.pac_samples)]
    values = [*reading.electrodes, reading.pdc, reading.tac, reading.tdc, *reading.pac]
    bad = []
    for bit, (value, true) in enumerate(zip(values, truth, strict=True)):
        if reading.validity >> bit & 1:
            assert value == true, layout.bit_name(bit)
        else:
            assert value == 0, layout.bit_name(bit)
            bad.append(layout.bit_name(bit))
    return bad


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("pac_first", [True, False])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_whole_frame(layout: FrameLayout, pac_first: bool, told: bool) -> None:
    slots = frame_of(5, layout, pac_first=pac_first, told=told)
    slots += frame_of(6, layout, pac_first=pac_first, told=told)
    readings, assembler = assemble(slots, layout)
    assert [reading.tick for reading in readings] == [5, 6]
    for reading in readings:
        assert bad_channels(reading, layout) == []
        assert reading.validity == layout.all_valid
        assert (len(reading.electrodes), len(reading.pac)) == (
            layout.electrodes,
            layout.pac_samples,
        )
    assert assembler.counters["incomplete_frames"] == 0


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("pac_first", [True, False])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_any_lost_slot_leaves_the_others_in_place(
    layout: FrameLayout, pac_first: bool, told: bool, timed: bool
) -> None:
    for lost in range(layout.slots):
        slots = frame_of(1, layout, pac_first=pac_first, told=told)
        order = [slot.channel for slot in slots]
        second = frame_of(2, layout, pac_first=pac_first, told=told)
        del second[lost]
        third = frame_of(3, layout, pac_first=pac_first, told=told)
        readings, assembler = assemble(slots + second + third, layout, timed=timed)
        name = f"PAC[{lost // 2}]" if order[lost] == ch.PAC else ch.channel_name(order[lost])
        assert [bad_channels(reading, layout) for reading in readings] == [[], [name], []]
        assert assembler.counters["incomplete_frames"] == 1
        assert assembler.counters["duplicate_slots"] == assembler.counters["unplaced_slots"] == 0


def test_a_frame_that_lost_its_first_slots_began_when_they_were_due() -> None:
    slots = frame_of(1, BIOTAC_LAYOUT) + frame_of(2, BIOTAC_LAYOUT)[3:] + frame_of(3, BIOTAC_LAYOUT)
    readings, _ = assemble(slots, BIOTAC_LAYOUT)
    assert bad_channels(readings[1], BIOTAC_LAYOUT) == ["E1", "E2", "PAC[0]"]
    times_s = [reading.time_s for reading in readings]
    np.testing.assert_allclose(times_s, [0.01, 0.02, 0.03], atol=1e-12)


@pytest.mark.parametrize("pac_first", [True, False])
def test_a_lost_slot_before_the_first_whole_frame(pac_first: bool) -> None:
    """The order is learnt from what follows, or from how the frame itself begins and ends."""
    layout = BIOTAC_LAYOUT
    lossy = frame_of(1, layout, pac_first=pac_first, told=False)
    whole = frame_of(2, layout, pac_first=pac_first, told=False)
    first_or_last = 0 if pac_first else len(lossy) - 1  # a PAC sample: both orders are possible
    del lossy[first_or_last]
    readings, _ = assemble(lossy + whole, layout)
    assert bad_channels(readings[0], layout) == [f"PAC[{first_or_last // 2}]"]
    alone, assembler = assemble(lossy, layout)
    assert len(bad_channels(alone[0], layout)) == layout.pac_samples
    assert assembler.counters["unplaced_slots"] == layout.pac_samples - 1
    middle = frame_of(1, layout, pac_first=pac_first, told=False)
    lost = 21 - (middle[21].channel != ch.PAC)
    del middle[lost]
    assert bad_channels(assemble(middle, layout)[0][0], layout) == [f"PAC[{lost // 2}]"]


def test_a_sample_that_may_be_one_of_two_is_placed_by_time_or_left_out() -> None:
    layout = BIOTAC_LAYOUT
    slots = frame_of(1, layout, told=False) + frame_of(2, layout, told=False)
    e3 = 44 + 4
    assert [slot.channel for slot in slots[e3 : e3 + 2]] == [19, ch.PAC]
    for lost, kept in ((e3 - 1, e3 + 1), (e3 + 1, e3 - 1)):  # E3, and a PAC sample beside it
        name = f"PAC[{(kept - 44) // 2}]"
        gone = f"PAC[{(lost - 44) // 2}]"
        some = [slot for k, slot in enumerate(slots) if k not in (e3, lost)]
        readings, assembler = assemble(some, layout)
        assert bad_channels(readings[1], layout) == ["E3", gone]
        assert assembler.counters["unplaced_slots"] == 0
        readings, assembler = assemble(some, layout, timed=False)
        assert bad_channels(readings[1], layout) == ["E3", *sorted([name, gone])]
        assert assembler.counters["unplaced_slots"] == 1
        # A step of the clock inside the frame: its times do not tell.
        jumped = [s._replace(time_s=s.time_s + (s.channel == 30) * 1e-3) for s in some]
        readings, assembler = assemble(jumped, layout)
        assert bad_channels(readings[1], layout) == ["E3", *sorted([name, gone])]


def test_times_place_a_sample_unless_they_were_made_by_counting() -> None:
    layout = BIOTAC_LAYOUT
    slots = frame_of(1, layout, told=False) + frame_of(2, layout, told=False)
    del slots[44 + 3 : 44 + 5]  # a PAC sample, and E3 behind it
    assembler = FrameAssembler(PERIOD_S)
    readings = assembler.push(slot_block(slots)) + assembler.finish()
    assert bad_channels(readings[1], layout) == ["E3", "PAC[1]"]


def test_a_frame_is_cut_if_it_ends_unlike_the_one_before() -> None:
    first, second = frame_of(1, BIOTAC_LAYOUT), frame_of(2, BIOTAC_LAYOUT)
    assembler = FrameAssembler(PERIOD_S)
    assert not assembler.ends_inside_frame, "nothing has begun"
    assembler.push(slot_block(first[:-1]))
    assert assembler.ends_inside_frame, "how frames end is not known yet"
    assembler.push(slot_block(first[-1:]))
    assert not assembler.ends_inside_frame
    assembler.push(slot_block(second[:-2]))
    assert assembler.ends_inside_frame
    assembler.push(slot_block(second[-2:]))
    for frame, lost in ((3, 9), (4, 41)):
        slots = frame_of(frame, BIOTAC_LAYOUT)
        assembler.push(slot_block([*slots[:lost], *slots[lost + 1 :]]))
        assert assembler.pending_slots == 43
        assert not assembler.ends_inside_frame, "a slot was lost on the way"


def test_repeated_slots_change_nothing() -> None:
    layout = BIOTAC_LAYOUT
    whole, second = frame_of(1, layout, told=False), frame_of(2, layout, told=False)
    repeated = [slot for slot in second for _ in range(1 + (slot.channel in (20, ch.PAC)))]
    readings, assembler = assemble(whole + repeated, layout)
    assert [bad_channels(reading, layout) for reading in readings] == [[], []]
    assert assembler.counters["duplicate_slots"] == 23


def test_positions_of_another_round_are_not_taken_for_those_of_the_last() -> None:
    """PAC once among all channels: its time in the frame says which sample it is."""
    layout = BIOTAC_LAYOUT
    order = [*ch.channels_of(layout), ch.PAC]
    slots = frame_of(1, layout)
    for frame in (2, 3):
        slots += [
            Slot(c, 1011 if c == ch.PAC else 2000 + c, True, frame * 0.01, 0, frame, place)
            for place, c in enumerate(order)
        ]
    readings, assembler = assemble(slots, layout)
    for reading in readings[1:]:
        bad = bad_channels(reading, layout)
        assert bad == [f"PAC[{k}]" for k in range(22) if k != 11]
    assert assembler.counters["unplaced_slots"] == 0


def test_any_order_of_sampling_is_learnt() -> None:
    """All others first, then all PAC samples, with an unused Hall sensor between."""
    layout = BIOTAC_SP_LAYOUT
    order = [*ch.channels_of(layout), ch.HALL, *[ch.PAC] * layout.pac_samples]
    for told in (True, False):
        slots = [
            Slot(
                channel,
                1000 + place - 28 if channel == ch.PAC else 2000 + channel,
                True,
                (55 * frame + place) * PERIOD_S,
                0,
                frame,
                place if told else UNKNOWN,
            )
            for frame in range(4)
            for place, channel in enumerate(order)
        ]
        del slots[2 * 55 + 40]
        readings, assembler = assemble(slots, layout)
        bad = [bad_channels(reading, layout) for reading in readings]
        assert bad == [[], [], ["PAC[12]"], []]
        assert assembler.counters["ignored_slots"] == 4


def test_electrodes_that_the_layout_does_not_have_are_counted() -> None:
    slots = frame_of(1, BIOTAC_SP_LAYOUT) + frame_of(2, BIOTAC_SP_LAYOUT)
    readings, assembler = assemble(slots, BIOTAC_LAYOUT)
    assert assembler.counters["other_electrodes"] == 10
    assert [reading.validity.bit_count() for reading in readings] == [44, 44]
    _, assembler = assemble(frame_of(1, BIOTAC_LAYOUT), BIOTAC_SP_LAYOUT)
    assert assembler.counters["other_electrodes"] == 0


# --- whatever comes: nothing in a wrong place, and one answer by both ways ---


class LongWay(FrameAssembler):
    """The assembler without its way for whole frames in the usual order."""

    def _take_usual(self, slots: SlotBlock, readings: list[ElectrodeReading]) -> int:
        return 0


class CountedLongWay(FrameAssembler):
    """Counts the slots that go the long way."""

    slots = 0

    def _assemble(self, slots: SlotBlock, starts: npt.NDArray[np.int64]) -> list[ElectrodeReading]:
        self.slots += len(slots)
        return super()._assemble(slots, starts)


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_whole_frames_go_the_quick_way(layout: FrameLayout, told: bool) -> None:
    assembler = CountedLongWay(PERIOD_S, layout)
    assembler.push(slot_block([*frame_of(1, layout, told=told), *frame_of(2, layout, told=told)]))
    learnt = assembler.slots
    several = [slot for frame in range(3, 7) for slot in frame_of(frame, layout, told=told)]
    assert len(assembler.push(slot_block(several))) == 4
    assert assembler.slots == learnt, "the order of sampling was known"
    assembler.push(slot_block(frame_of(7, layout, told=told)[1:]))
    assembler.finish()
    assert assembler.slots > learnt


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("counter", ["frame", "batch"])
def test_halves_of_two_frames_are_no_whole_one(counter: str, told: bool) -> None:
    """Though their channels come in the usual order."""
    layout = BIOTAC_LAYOUT
    change: dict[str, Any] = {counter: 9}
    later = [slot._replace(**change) for slot in frame_of(3, layout, told=told)]
    halves = [*frame_of(3, layout, told=told)[:22], *later[22:]]
    readings, _ = assemble([*frame_of(1, layout), *frame_of(2, layout), *halves], layout)
    assert [len(bad_channels(one, layout)) for one in readings] == [0, 0, 22, 22]


def test_a_round_from_another_place_goes_the_long_way() -> None:
    """Usual channels, but positions that tell of another round: the channels decide."""
    layout = BIOTAC_LAYOUT
    assembler = CountedLongWay(PERIOD_S, layout)
    assembler.push(slot_block([*frame_of(1, layout), *frame_of(2, layout)]))
    learnt = assembler.slots
    moved = [s._replace(position=(s.position + 2) % 44) for s in frame_of(3, layout)]
    assembler.push(slot_block(moved))
    assert assembler.slots == learnt + len(moved)


@st.composite
def streams(draw: st.DrawFn) -> tuple[FrameLayout, list[Slot], int]:
    """Frames with slots lost, repeated or of bad parity, and the size of the blocks."""
    layout = draw(st.sampled_from(LAYOUTS))
    pac_first, told = draw(st.booleans()), draw(st.booleans())
    slots: list[Slot] = []
    for frame in draw(st.lists(st.integers(0, 9), min_size=1, max_size=8)):
        one = frame_of(frame, layout, pac_first=pac_first, told=told)
        for at in draw(st.lists(st.integers(0, layout.slots - 1), max_size=3)):
            change = draw(st.sampled_from(["lose", "repeat", "bad", "value"]))
            at = min(at, len(one) - 1)
            if change == "lose":
                del one[at]
            elif change == "repeat":
                one.insert(at, one[at])
            elif change == "bad":
                one[at] = one[at]._replace(good=False)
            elif change == "value":
                one[at] = one[at]._replace(value=draw(st.sampled_from([0, 7, 4095])))
        slots += one
    size = draw(st.sampled_from([layout.slots, 2 * layout.slots, 7, 60, 1000]))
    return layout, slots, size


@settings(max_examples=100, deadline=None)
@given(streams())
def test_both_ways_agree(stream: tuple[FrameLayout, list[Slot], int]) -> None:
    layout, slots, size = stream
    ways = [kind(PERIOD_S, layout) for kind in (FrameAssembler, LongWay)]
    for at in range(0, len(slots), size):
        block = slot_block(slots[at : at + size])
        quick, long = (way.push(block) for way in ways)
        assert [str(one) for one in quick] == [str(one) for one in long]
        assert ways[0].counters == ways[1].counters
        assert ways[0].pending_slots == ways[1].pending_slots
        if not ways[0].counters["duplicate_slots"]:  # the last slot may have come twice
            assert ways[0].ends_inside_frame == ways[1].ends_inside_frame
        for one, other in zip(quick, long, strict=True):
            assert one.electrodes.dtype == other.electrodes.dtype == np.uint16
            assert {type(getattr(one, f.name)) for f in dataclasses.fields(one)} == {
                type(getattr(other, f.name)) for f in dataclasses.fields(other)
            }
    assert [str(one) for one in ways[0].finish()] == [str(one) for one in ways[1].finish()]
    assert ways[0].parity_errors_by_channel == ways[1].parity_errors_by_channel


@settings(max_examples=100, deadline=None)
@example(BIOTAC_LAYOUT, True, False, {1, 2}, False)
@given(
    st.sampled_from(LAYOUTS),
    st.booleans(),
    st.booleans(),
    st.sets(st.integers(0, 53), max_size=50),
    st.booleans(),
)
def test_nothing_is_ever_in_a_wrong_place(
    layout: FrameLayout, pac_first: bool, told: bool, lost: set[int], timed: bool
) -> None:
    whole = frame_of(1, layout, pac_first=pac_first, told=told)
    second = frame_of(2, layout, pac_first=pac_first, told=told)
    kept = [slot for place, slot in enumerate(second) if place not in lost]
    readings, assembler = assemble(whole + kept, layout, timed=timed)
    if not kept:
        return
    assert len(bad_channels(readings[1], layout)) >= layout.slots - len(kept)
    if told or timed:
        few = sum(slot.channel != ch.PAC for slot in kept) == 0
        assert few or assembler.counters["unplaced_slots"] == 0
    assert assembler.counters["duplicate_slots"] == 0
