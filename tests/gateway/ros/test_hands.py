"""From tactile messages to readings of a finger: counts, times, and what is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.gateway.ros_fakes import BEGAN_NS, all_fields, electrodes_of, hand_fields
from tests.protos.ros_idl import Biotac, BiotacAll, Header, Time

from palpate.errors import WireError
from palpate.messages import BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT, SensorType
from palpate.ros.layouts import BIOTAC_ALL, BIOTAC_HAND, encode
from palpate_gateway.protocols.ros_hands import RosFinger, RosHand, decode_hand
from palpate_gateway.readings import ElectrodeReading
from palpate_gateway.ros.finger_track import FingerTrack

PERIOD_NS = 10_000_000


def hand_of(k: int, *, layout: str = BIOTAC_ALL, time_ns: int | None = None) -> RosHand:
    at_ns = BEGAN_NS + PERIOD_NS * k if time_ns is None else time_ns
    fields = all_fields(k, at_ns) if layout == BIOTAC_ALL else hand_fields(k, at_ns)
    return decode_hand(encode(fields, layout), layout)


def good(reading: ElectrodeReading) -> list[str]:
    """Names of the channels that claim to be good."""
    layout = BIOTAC_LAYOUT if len(reading.electrodes) == 19 else BIOTAC_SP_LAYOUT
    return [layout.bit_name(bit) for bit in range(layout.slots) if reading.validity >> bit & 1]


SLOW = [*(f"E{k}" for k in range(1, 20)), "PDC", "TAC", "TDC"]


class TestLayouts:
    def test_a_whole_frame_has_all_channels_and_its_own_time(self) -> None:
        hand = hand_of(3, layout=BIOTAC_HAND)
        assert hand.time_ns == BEGAN_NS + 3 * PERIOD_NS
        assert hand.end_ns - hand.time_ns == PERIOD_NS
        assert hand.slot_period_s == pytest.approx(1 / 4400, rel=1e-4)
        reading = FingerTrack(1, rate_hz=100.0).take(hand)
        assert reading is not None
        assert reading.electrodes.tolist() == [value + 7 for value in electrodes_of(3)]
        assert (reading.pdc, reading.tac, reading.tdc) == (2603, 2045, 1914)
        assert reading.pac.tolist() == list(range(2000, 2022))
        assert reading.validity == BIOTAC_LAYOUT.all_valid
        assert reading.electrodes.dtype == reading.pac.dtype == np.uint16

    def test_a_shadow_hand_has_two_pac_samples_and_the_others_are_marked(self) -> None:
        reading = FingerTrack(1, rate_hz=100.0).take(hand_of(3))
        assert reading is not None
        assert reading.electrodes.tolist() == electrodes_of(3)
        assert reading.pac.tolist() == [2040, 2041, *[0] * 20]
        assert good(reading) == [*SLOW, "PAC[0]", "PAC[1]"]

    def test_offsets_of_zero_are_no_slot_period(self) -> None:
        fields = hand_fields(0, BEGAN_NS, offsets=False)
        hand = decode_hand(encode(fields, BIOTAC_HAND), BIOTAC_HAND)
        assert hand.slot_period_s == pytest.approx(1 / 4400)

    def test_ros_1_has_the_same_content_and_a_number(self) -> None:
        payload = encode(all_fields(3, BEGAN_NS, "ros1"), BIOTAC_ALL, "ros1")
        hand = decode_hand(payload, BIOTAC_ALL, "ros1")
        assert hand.sequence == 3
        assert replace(hand, sequence=None) == hand_of(3, time_ns=BEGAN_NS)

    def test_a_finger_that_is_zero_is_not_connected(self) -> None:
        assert [finger is not None for finger in hand_of(0).fingers] == [True, *[False] * 4]

    @pytest.mark.parametrize("electrodes", [18, 20])
    def test_another_number_of_electrodes_is_refused(self, electrodes: int) -> None:
        fields = all_fields(0, BEGAN_NS)
        fields["tactiles"][0]["electrodes"] = np.full(electrodes, 2000, np.int16)
        with pytest.raises(WireError, match=f"{electrodes} electrodes") as caught:
            decode_hand(encode(fields, BIOTAC_ALL), BIOTAC_ALL)
        assert caught.value.reason == "electrode_count"

    def test_24_electrodes_are_a_biotac_sp(self) -> None:
        fields = all_fields(0, BEGAN_NS)
        fields["tactiles"][0]["electrodes"] = np.arange(2000, 2024, dtype=np.int16)
        hand = decode_hand(encode(fields, BIOTAC_ALL), BIOTAC_ALL)
        finger = hand.fingers[0]
        assert finger is not None
        assert finger.sensor_type is SensorType.BIOTAC_SP
        reading = FingerTrack(1, rate_hz=100.0).take(hand)
        assert reading is not None
        assert len(reading.pac) == 27
        assert good(reading)[-5:] == ["PDC", "TAC", "TDC", "PAC[0]", "PAC[1]"]

    def test_stray_bytes_after_a_serial_are_cut(self) -> None:
        fields = hand_fields(0, BEGAN_NS, serials=("BTSP0001\x00\x10",))
        # A string of CDR ends at its own 0; this is what a bag of ROS 1 can hold.
        fields["header"]["seq"] = 0
        hand = decode_hand(encode(fields, BIOTAC_HAND, "ros1"), BIOTAC_HAND, "ros1")
        assert hand.fingers[0] is not None
        assert hand.fingers[0].serial == "BTSP0001"


shorts = st.integers(-(2**15), 2**15 - 1)
fingers = st.builds(
    Biotac, shorts, shorts, shorts, shorts, shorts, st.lists(shorts, min_size=19, max_size=19)
)
hands = st.lists(fingers, min_size=5, max_size=5).map(
    lambda five: BiotacAll(Header(Time(5, 0), "hand"), five)
)


@settings(max_examples=60, deadline=None)
@given(hands, st.integers(1, 5))
def test_every_valid_channel_is_what_was_sent_and_no_other_is_valid(
    message: BiotacAll, place: int
) -> None:
    sent = message.tactiles[place - 1]
    track = FingerTrack(place, rate_hz=100.0)
    reading = track.take(decode_hand(message.serialize(), BIOTAC_ALL))
    slow = [*sent.electrodes, sent.pdc, sent.tac, sent.tdc]
    if not any([*slow, sent.pac0, sent.pac1]):
        assert reading is None
        return
    assert reading is not None
    values = [*reading.electrodes, reading.pdc, reading.tac, reading.tdc, *reading.pac]
    any_pac = 0 < sent.pac0 <= 4095 or 0 < sent.pac1 <= 4095
    expected = [0 < value <= 4095 for value in slow]
    expected += [0 <= value <= 4095 and any_pac for value in (sent.pac0, sent.pac1)] + [False] * 20
    told = [bool(reading.validity >> bit & 1) for bit in range(44)]
    assert told == expected
    for value, is_good, was in zip(values, told, [*slow, sent.pac0, sent.pac1], strict=False):
        assert not is_good or value == was
    bad = sum(not 0 <= value <= 4095 for value in [*slow, sent.pac0, sent.pac1])
    assert track.counters["bad_counts"] == bad


@settings(max_examples=100, deadline=None)
@given(hands, st.data())
def test_damaged_bytes_are_a_typed_error_or_a_message(
    message: BiotacAll, data: st.DataObject
) -> None:
    payload = bytearray(message.serialize())
    for _ in range(3):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.one_of(st.just(len(payload)), st.integers(0, len(payload))))
    try:
        hand = decode_hand(bytes(payload[:cut]), BIOTAC_ALL)
    except WireError:
        return
    reading = FingerTrack(1, rate_hz=100.0).take(hand)
    if reading is None:
        return
    values = [*reading.electrodes, reading.pdc, reading.tac, reading.tdc, *reading.pac]
    valid = [value for bit, value in enumerate(values) if reading.validity >> bit & 1]
    assert all(0 <= value <= 4095 for value in valid)


class TestTrack:
    def test_a_repeat_of_the_electrodes_is_no_reading(self) -> None:
        track = FingerTrack(1, rate_hz=100.0)
        took = [track.take(hand_of(k // 3, time_ns=BEGAN_NS + 3_000_000 * k)) for k in range(9)]
        assert [reading is not None for reading in took] == [True, False, False] * 3
        assert track.counters["repeated_readings"] == 6
        assert track.counters["samples"] == 3

    def test_a_repeat_with_another_pac_is_still_a_repeat(self) -> None:
        track = FingerTrack(1, rate_hz=100.0)
        hand = hand_of(0)
        assert track.take(hand) is not None
        finger = hand.fingers[0]
        assert finger is not None
        shaken = replace(hand, time_ns=hand.time_ns + 1, fingers=(replace(finger, pac=(1, 2)),))
        assert track.take(shaken) is None

    def test_repeats_are_kept_on_request_and_of_whole_frames_always(self) -> None:
        for layout, repeats in ((BIOTAC_ALL, "keep"), (BIOTAC_HAND, "drop")):
            track = FingerTrack(1, rate_hz=100.0, repeats=repeats)  # type: ignore[arg-type]
            times = [BEGAN_NS + PERIOD_NS * k for k in range(4)]
            took = [track.take(hand_of(0, layout=layout, time_ns=at)) for at in times]
            assert None not in took

    def test_a_message_that_came_twice_or_late_is_dropped(self) -> None:
        track = FingerTrack(1, rate_hz=100.0)
        took = [track.take(hand_of(k)) for k in (0, 1, 1, 3, 2, 4)]
        assert [reading is not None for reading in took] == [True, True, False, True, False, True]
        assert track.counters["repeated_messages"] == 1
        assert track.counters["late_messages"] == 1
        assert not track.restarted

    def test_a_clock_that_is_set_back_is_a_restart(self) -> None:
        track = FingerTrack(1, rate_hz=100.0)
        track.take(hand_of(1000))
        for k in range(9):
            track.take(hand_of(k))
        assert not track.restarted
        track.take(hand_of(9))
        assert track.restarted

    @pytest.mark.parametrize("lost", [None, 0])
    def test_a_clock_that_is_set_forward_makes_nothing_missing(self, lost: int | None) -> None:
        track = FingerTrack(1, rate_hz=100.0)
        set_forward = 100 * 86_400 * 365 * 8  # frames of eight years
        for k in (0, 1, set_forward, set_forward + 1):
            reading = track.take(hand_of(k), lost=lost)
            assert reading is not None
            assert reading.missed_before == 0
        assert (track.counters["time_jumps"], track.counters["missing_readings"]) == (1, 0)
        again = track.take(hand_of(set_forward + 4))
        assert again is not None
        assert again.missed_before == 2, "it is followed as before"

    @pytest.mark.parametrize(("lost", "missed"), [(None, 3), (3, 3), (1, 1), (0, 0), (9, 3)])
    def test_missing_readings_are_counted_by_time_and_number(
        self, lost: int | None, missed: int
    ) -> None:
        track = FingerTrack(1, rate_hz=100.0)
        first, second = track.take(hand_of(0)), track.take(hand_of(4), lost=lost)
        assert first is not None
        assert second is not None
        assert second.missed_before == missed == track.counters["missing_readings"]
        assert second.tick - first.tick == 1 + missed
        assert second.time_s - first.time_s == pytest.approx(0.04)

    @pytest.mark.parametrize("after", ["absent", "repeated"])
    def test_a_gap_is_told_by_the_next_reading_though_a_message_without_one_comes_first(
        self, after: str
    ) -> None:
        track = FingerTrack(1, rate_hz=100.0)
        hand = hand_of(0)
        track.take(hand)
        empty = replace(hand, time_ns=BEGAN_NS + 4 * PERIOD_NS)
        if after == "absent":
            empty = replace(empty, fingers=(None,) * 5)
        assert track.take(empty) is None
        reading = track.take(hand_of(5))
        assert reading is not None
        assert reading.missed_before == track.counters["missing_readings"] == 3

    def test_a_channel_that_was_never_filled_is_marked(self) -> None:
        track = FingerTrack(1, rate_hz=100.0, repeats="keep")
        told = []
        for k, (tac, pac0) in enumerate([(0, 0), (0, 0), (5, 0), (0, 7), (0, 0)]):
            fields = all_fields(k, BEGAN_NS + PERIOD_NS * k)
            fields["tactiles"][0] |= {"tac": tac, "pac0": pac0, "pac1": 0}
            reading = track.take(decode_hand(encode(fields, BIOTAC_ALL), BIOTAC_ALL))
            assert reading is not None
            told.append([name in good(reading) for name in ("TAC", "PAC[0]", "PAC[1]")])
        # Once filled, 0 is a value: full scale down.
        assert told == [
            [False] * 3, [False] * 3, [True, False, False], [True] * 3, [True] * 3,
        ]  # fmt: skip

    def test_channels_that_the_user_calls_missing_are_marked(self) -> None:
        track = FingerTrack(1, rate_hz=100.0, missing=("pac", "tac", "tdc"))
        reading = track.take(hand_of(0, layout=BIOTAC_HAND))
        assert reading is not None
        assert good(reading) == [name for name in SLOW if name not in ("TAC", "TDC")]

    def test_a_finger_is_found_by_place_or_serial(self) -> None:
        fields = hand_fields(0, BEGAN_NS, serials=("BT1", "BT2"))
        hand = decode_hand(encode(fields, BIOTAC_HAND), BIOTAC_HAND)
        found = [
            FingerTrack(2, rate_hz=100.0).find(hand),
            FingerTrack(1, serial="BT2", rate_hz=100.0).find(hand),
        ]
        assert found[0] == found[1] == hand.fingers[1]
        assert FingerTrack(3, rate_hz=100.0).find(hand) is None
        assert FingerTrack(1, serial="BT3", rate_hz=100.0).find(hand) is None

    def test_the_arrival_belongs_to_the_end_of_the_frame(self) -> None:
        track = FingerTrack(1, rate_hz=100.0)
        reading = track.take(hand_of(0, layout=BIOTAC_HAND), arrival_ns=123)
        assert reading is not None
        assert reading.observed is not None
        assert reading.observed.device_s - reading.time_s == pytest.approx(0.01)
        assert reading.observed.arrival_ns == 123

    def test_a_finger_that_is_away_is_counted(self) -> None:
        track = FingerTrack(4, rate_hz=100.0)
        assert track.take(hand_of(0)) is None
        assert track.counters["absent"] == 1


def test_a_finger_knows_its_type() -> None:
    assert RosFinger("", (1,) * 22, (0, 0)).sensor_type is SensorType.BIOTAC
