from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_gateway.protocols.rdt import (
    AXIA,
    BELIEVABLE_LOSS,
    HEX,
    LATE_WINDOW,
    NET_FT,
    PROFILES,
    SCHUNK_FTN,
    START_REQUEST,
    STOP_REQUEST,
    U32,
    RdtDecoder,
    RdtProfile,
    RdtRecord,
    RdtScale,
    RdtSequence,
    RdtStep,
    hex_filter_request,
    hex_period_request,
    hex_sensor_number,
    unwrap,
)

# The vector of the hardware reference, section 3.2.
VECTOR = bytes.fromhex(
    "00000001 00001B58 00000000 0016E360 FFFC2F70 000F4240 00004E20 FFFFD8F0 00001388"
)
RECORD = RdtRecord(1, 7000, 0, (1_500_000, -250_000, 1_000_000, 20_000, -10_000, 5_000))

u32 = st.integers(0, U32 - 1)
i32 = st.integers(-(2**31), 2**31 - 1)
record = st.builds(RdtRecord, u32, u32, u32, st.tuples(i32, i32, i32, i32, i32, i32))


def encoded(one: RdtRecord) -> bytes:
    """The 36 bytes that a device sends."""
    numbers = (one.rdt_sequence, one.ft_sequence, one.status)
    return b"".join(n.to_bytes(4, "big") for n in numbers) + b"".join(
        count.to_bytes(4, "big", signed=True) for count in one.counts
    )


def test_record_vector() -> None:
    decoder = RdtDecoder()
    assert decoder.feed(VECTOR) == [RECORD]
    assert encoded(RECORD) == VECTOR
    assert decoder.counters == {"datagrams": 1, "records": 1, "bad_lengths": 0, "junk_bytes": 0}
    wrench = RdtScale(1e6, 1e6).wrench(RECORD.counts)
    np.testing.assert_allclose(wrench, [1.5, -0.25, 1.0, 0.02, -0.01, 0.005], rtol=1e-15)


@settings(max_examples=100, deadline=None)
@given(st.lists(record, min_size=1, max_size=40))
def test_buffered_records(records: list[RdtRecord]) -> None:
    datagram = b"".join(map(encoded, records))
    assert RdtDecoder().feed(datagram) == records
    for k, one in enumerate(records):
        assert RdtDecoder().feed(datagram[36 * k :][:36]) == [one]
    scale = RdtScale(10_000.0, 100_000.0)
    wrenches = scale.wrench([one.counts for one in records])
    assert wrenches.shape == (len(records), 6)


@pytest.mark.parametrize("length", [0, 1, 8, 35, 37, 71, 1400])
def test_other_lengths_are_counted(length: int) -> None:
    decoder = RdtDecoder()
    assert decoder.feed(bytes(length)) == []
    assert decoder.feed(VECTOR) == [RECORD]
    assert decoder.counters["bad_lengths"] == 1
    assert decoder.counters["junk_bytes"] == length


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=120)))
def test_no_datagram_raises_and_every_byte_is_accounted_for(datagrams: list[bytes]) -> None:
    decoder = RdtDecoder()
    found = [one for datagram in datagrams for one in decoder.feed(datagram)]
    counters = decoder.counters
    assert len(found) == counters["records"]
    assert 36 * len(found) + counters["junk_bytes"] + decoder.pending == sum(map(len, datagrams))


def test_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="counts_per_n_m 0"):
        RdtScale(1.0, 0.0)
    with pytest.raises(ValueError, match="counts_per_n nan"):
        RdtScale(float("nan"), 1.0)


def follow(*numbers: tuple[int, int]) -> tuple[list[RdtStep], RdtSequence]:
    sequence = RdtSequence()
    return [sequence.step(rdt, ft) for rdt, ft in numbers], sequence


def test_sequence_in_order_and_with_a_gap() -> None:
    steps, sequence = follow((1, 700), (2, 701), (6, 705), (7, 706))
    assert steps[:2] == [RdtStep(True, True, 0, 0), RdtStep(True, False, 0, 1)]
    assert steps[2:] == [RdtStep(True, False, 3, 5), RdtStep(True, False, 0, 6)]
    assert sequence.counters == RdtSequence().counters | {"lost_records": 3}


def test_repeated_and_late_records_are_dropped() -> None:
    steps, sequence = follow((5, 50), (5, 50), (8, 80), (7, 70), (6, 60), (9, 90))
    assert [step.keep for step in steps] == [True, False, True, False, False, True]
    assert [step.tick for step in steps] == [0, 0, 3, 3, 3, 4]
    counters = sequence.counters
    assert (counters["repeated_records"], counters["late_records"]) == (1, 2)
    assert (counters["lost_records"], counters["restarts"]) == (2, 0)


def test_late_first_record_is_no_restart() -> None:
    steps, _ = follow((2, 20), (1, 10), (3, 30))
    assert [step.keep for step in steps] == [True, False, True]


@pytest.mark.parametrize("before", [1, 2, LATE_WINDOW, 100_000, 3_000_000_000])
def test_restart_is_a_new_epoch(before: int) -> None:
    steps, sequence = follow((before, 7000), (1, 7050), (2, 7051))
    assert steps[1] == RdtStep(True, True, 0, 1)
    assert steps[2] == RdtStep(True, False, 0, 2)
    assert sequence.counters["restarts"] == 1
    assert sequence.counters["lost_records"] == 0


def test_restart_whose_first_records_are_lost() -> None:
    steps, _ = follow((50, 7000), (4, 7050))
    assert steps[1] == RdtStep(True, True, 3, 4)


def test_restart_after_a_loss_of_power() -> None:
    steps, sequence = follow((5000, 90_000), (1, 3), (2, 4))
    assert [step.new_epoch for step in steps] == [True, True, False]
    assert sequence.counters["restarts"] == 1


def test_late_record_of_the_numbers_before_a_restart() -> None:
    steps, sequence = follow((64, 6400), (1, 6420), (65, 6410), (2, 6430))
    assert [step.keep for step in steps] == [True, True, False, True]
    assert steps[3] == RdtStep(True, False, 0, 2)
    assert sequence.counters["late_records"] == 1
    assert sequence.counters["lost_records"] == 0


@pytest.mark.parametrize("before", [(50, 900_000), (2, 900_000)])
@pytest.mark.parametrize("after", [1, 4, 51, 60])
def test_loss_of_power_shows_by_the_counter_alone(before: tuple[int, int], after: int) -> None:
    steps, sequence = follow(before, (after, 30), (after + 1, 40))
    assert [step.new_epoch for step in steps] == [True, True, False]
    assert [step.keep for step in steps] == [True, True, True]
    assert sequence.counters["restarts"] == 1


@pytest.mark.parametrize("behind", [LATE_WINDOW + 1, 700])
def test_record_that_is_late_by_both_numbers_is_no_restart(behind: int) -> None:
    steps, sequence = follow((1000, 51_000), (1000 - behind, 51_000 - behind), (1001, 51_001))
    assert [step.keep for step in steps] == [True, False, True]
    assert sequence.counters["restarts"] == 0
    assert sequence.counters["late_records"] == 1


def test_sequence_wraps() -> None:
    steps, sequence = follow((U32 - 2, 1), (U32 - 1, 2), (0, 3), (U32 - 1, 2), (2, 5), (1, 4))
    assert [step.keep for step in steps] == [True, True, True, False, True, False]
    assert [step.lost for step in steps] == [0, 0, 0, 0, 1, 0]
    assert sequence.counters["restarts"] == 0
    assert sequence.counters["late_records"] == 2


def test_long_loss_is_counted_and_unbelievable_one_is_not() -> None:
    steps, _ = follow((10, 1), (5_000_010, 5_000_001))
    assert steps[1].lost == 4_999_999
    steps, _ = follow((4_000_000_000, 1), (2 * BELIEVABLE_LOSS, 2))
    assert steps[1] == RdtStep(True, True, 0, 1)


def test_device_that_sends_faster_than_it_samples() -> None:
    steps, sequence = follow((1, 10), (2, 10), (4, 11), (3, 11), (5, 11))
    assert [step.keep for step in steps] == [True, True, True, False, True]
    assert sequence.counters["restarts"] == 0


@settings(max_examples=100, deadline=None)
@given(u32, u32, st.lists(st.tuples(st.integers(-5, 5), st.booleans()), max_size=60))
def test_loss_repetition_and_disorder(start: int, ft: int, fates: list[tuple[int, bool]]) -> None:
    """Records keep their order, and what is kept and lost adds up."""
    order = sorted(range(len(fates)), key=lambda k: k + fates[k][0])
    arriving = [k for k in order for _ in range(1 + fates[k][1])]
    sequence = RdtSequence()
    kept = [k for k in arriving if sequence.step((start + k) % U32, (ft + k) % U32).keep]
    assert kept == sorted(set(kept))
    if kept:
        assert sequence.counters["lost_records"] == kept[-1] - kept[0] + 1 - len(kept)
    dropped = sequence.counters["late_records"] + sequence.counters["repeated_records"]
    assert dropped == len(arriving) - len(kept)
    assert sequence.counters["restarts"] == 0


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(u32, u32)))
def test_no_numbers_raise_and_ticks_never_go_back(numbers: list[tuple[int, int]]) -> None:
    steps, _ = follow(*numbers)
    ticks = [step.tick for step in steps if step.keep]
    assert ticks == sorted(set(ticks))


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**48), st.integers(-(2**31), 2**31 - 1))
def test_counter_is_unwrapped(previous: int, step: int) -> None:
    assert unwrap((previous + step) % U32, previous) == previous + step


def test_requests() -> None:
    # The three requests that the hardware reference spells out, section 3.2.
    assert START_REQUEST == bytes.fromhex("1234 0002 00000000")
    assert STOP_REQUEST == bytes.fromhex("1234 0000 00000000")
    for profile in (NET_FT, AXIA, SCHUNK_FTN):
        assert profile.bias_request == bytes.fromhex("1234 0042 00000000")


def test_hex_requests() -> None:
    assert HEX.bias_request == bytes.fromhex("1234 0042 000000FF")
    assert hex_filter_request(4) == bytes.fromhex("1234 0081 00000004")
    assert hex_period_request(10) == bytes.fromhex("1234 0082 0000000A")
    for code in (-1, 7):
        with pytest.raises(ValueError, match=r"not in 0\.\.6"):
            hex_filter_request(code)
    for period_ms in (0, 256):
        with pytest.raises(ValueError, match=r"not in 1\.\.255 ms"):
            hex_period_request(period_ms)


@pytest.mark.parametrize(
    ("profile", "status", "names", "valid", "overloaded"),
    [
        (NET_FT, 0, (), True, False),
        (NET_FT, 0x80010000, ("error summary", "monitor condition latched"), True, False),
        (NET_FT, 0x00010000, ("monitor condition latched",), True, False),
        (NET_FT, 0x80000000, ("error summary",), False, False),
        (NET_FT, 0x80020000, ("error summary", "transducer saturated or converter fault"),
         False, True),
        (NET_FT, 0x80010001, ("error summary", "monitor condition latched", "bit 0"), False, False),
        (NET_FT, 0x88000000, ("error summary", "serial link to transducer fault"), False, False),
        (AXIA, 0, (), True, False),
        (AXIA, 0x00010000, ("monitor condition latched",), True, False),
        (AXIA, 0x80010000, ("error summary", "monitor condition latched"), False, False),
        (AXIA, 0xC0000000, ("error summary", "force or torque out of range"), False, True),
        (AXIA, 0x88000000, ("error summary", "gage out of range"), False, True),
        (AXIA, 0x80000004, ("error summary", "broken gage"), False, False),
        (AXIA, 0x00000008, ("busy",), False, False),
        (SCHUNK_FTN, 0x10000000, ("simulated error",), False, False),
        (HEX, 0x0000, (), True, False),
        (HEX, 0x0002, (), True, False),
        (HEX, 0x0009, ("several sensors",), True, False),
        (HEX, 0x0010, ("overload on some axis",), False, True),
        (HEX, 0x03F0, ("overload on some axis",), False, True),
        (HEX, 0x0400, ("sensor not detected",), False, False),
        (HEX, 0x0800, ("sensor failed",), False, False),
        (HEX, 0x1000, ("sensor temperature",), False, False),
        (HEX, 0x6000, ("converter: communication error", "converter: DAQ error"), False, False),
        (HEX, 0xABCD0001, (), True, False),
        (HEX, 0x8000, ("converter: unknown error",), False, False),
    ],
)  # fmt: skip
def test_status(
    profile: RdtProfile, status: int, names: tuple[str, ...], valid: bool, overloaded: bool
) -> None:
    assert profile.status_names(status) == names
    assert profile.valid(status) is valid
    assert profile.overloaded(status) is overloaded


@settings(max_examples=100, deadline=None)
@given(u32)
def test_overload_is_never_valid(status: int) -> None:
    for profile in PROFILES.values():
        assert not (profile.overloaded(status) and profile.valid(status))


def test_profiles() -> None:
    assert set(PROFILES) == {"ati_net_ft", "ati_axia", "schunk_ftn", "onrobot_hex"}
    assert [profile.ft_rate_hz for profile in PROFILES.values()] == [7000.0, None, None, 1000.0]
    assert NET_FT.scale is AXIA.scale is None
    assert HEX.scale is not None
    np.testing.assert_allclose(
        HEX.scale.wrench((10_000, -5_000, 1, 100_000, 0, -1)), [1.0, -0.5, 1e-4, 1.0, 0.0, -1e-5]
    )
    assert hex_sensor_number(0x000D) == 5
