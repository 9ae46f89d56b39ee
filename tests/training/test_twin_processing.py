"""The paper's processing, step by step, on streams made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from palpate.errors import DatasetError
from palpate_training.datasets.processing import (
    Floats,
    crossing,
    filter_force,
    from_half_newton,
    from_threshold,
    last_of_increments,
    onset,
    process,
    process_all,
    tare,
)
from palpate_training.datasets.trials import RawTrial, TrialHeader, TrialRows

HEADER = TrialHeader("biotac-1", "sphere/03/normal", "sphere", "left")
DWELL = 50
"""Samples of an increment; the real dwell has 500."""


def rows_of(force: Floats) -> TrialRows:
    """Rows whose other quantities count the rows, so that what was kept can be read off."""
    n = len(force)
    count = np.arange(n, dtype=float)
    return TrialRows(
        HEADER,
        np.full(19, 3000.0),
        1e-4 * count,
        np.tile(-0.01 * count[:, None], (1, 19)),
        force,
        np.stack([count, 2 * count, -count], axis=1),
    )


def along_z(*magnitudes: float) -> Floats:
    return np.array([[0.0, 0.0, magnitude] for magnitude in magnitudes])


@pytest.fixture
def raw() -> RawTrial:
    """Eight increments of steps in force, on an offset, with noise at 40 Hz."""
    levels = np.array([0, 0, 0.2, 0.8, 1.4, 2.0, 3.0, 4.0])
    n = len(levels) * DWELL
    time_s = np.arange(n, dtype=np.float64) * 0.01
    clean = np.repeat(levels, DWELL)
    force = np.outer(clean, [0.6, 0.0, 0.8]) + np.array([1.0, -2.0, 5.0])
    counts = np.repeat(3000 - 100 * np.arange(len(levels)), DWELL)
    return RawTrial(
        HEADER,
        time_s,
        np.tile(counts[:, None], (1, 19)).astype(np.uint16),
        force + 0.05 * np.sin(2 * np.pi * 40 * time_s)[:, None],
        np.repeat(1e-4 * np.arange(len(levels)), DWELL)[:, None] * [0.0, 0.0, 1.0],
        np.repeat(1e-4 * np.arange(len(levels)), DWELL),
        np.arange(1, len(levels) + 1, dtype=np.int64) * DWELL - 1,
    )


def test_last_of_increments_keeps_the_last_sample_of_each(raw: RawTrial) -> None:
    kept = last_of_increments(raw)
    np.testing.assert_array_equal(kept.time_s, raw.time_s[DWELL - 1 :: DWELL])
    np.testing.assert_array_equal(kept.electrodes[:, 3], 3000 - 100 * np.arange(8))
    np.testing.assert_array_equal(kept.force, raw.force[DWELL - 1 :: DWELL])
    assert kept.tip.shape == (8, 3)
    np.testing.assert_array_equal(kept.increment_end, np.arange(8))


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ([], "increment_end"),
        ([-1, 5], "increment_end"),
        ([49, 49], "increment_end"),
        ([49, 400], "increment_end"),
        ([40, 49], "travel does not grow at increment 1"),
        ([49, 99, 140, 149], "travel does not grow at increment 3"),
    ],
)
def test_increments_that_make_no_sense_are_refused(
    raw: RawTrial, ends: list[int], words: str
) -> None:
    with pytest.raises(DatasetError, match=words) as caught:
        last_of_increments(replace(raw, increment_end=np.array(ends, np.int64)))
    assert "biotac-1 sphere/03/normal" in str(caught.value)


def test_an_increment_may_end_with_the_first_sample(raw: RawTrial) -> None:
    kept = last_of_increments(replace(raw, increment_end=np.array([0, 60])))
    np.testing.assert_array_equal(kept.time_s, raw.time_s[[0, 60]])


def test_travel_counts_from_the_first_time_step(raw: RawTrial) -> None:
    rows = tare(last_of_increments(replace(raw, travel_m=raw.travel_m + 2e-3)))
    np.testing.assert_allclose(rows.travel_m, 1e-4 * np.arange(8), atol=1e-15)


@pytest.mark.parametrize("stream", ["force", "tip", "travel_m"])
def test_tare_names_the_row_that_is_not_finite(raw: RawTrial, stream: str) -> None:
    trial = last_of_increments(raw)
    values = getattr(trial, stream).copy()
    values[3] = np.nan
    with pytest.raises(DatasetError, match=f"{stream} is not finite in row 3"):
        tare(replace(trial, **{stream: values}))


def test_tare_subtracts_the_first_time_step(raw: RawTrial) -> None:
    rows = tare(last_of_increments(raw))
    np.testing.assert_array_equal(rows.rest, np.full(19, 3000.0))
    np.testing.assert_array_equal(rows.force[0], 0.0)
    # Falling counts are negative, over the full scale of 12 bits.
    np.testing.assert_allclose(rows.tared[5], -500 / 4095)
    np.testing.assert_allclose(rows.force[7] - rows.force[1], [2.4, 0.0, 3.2], atol=0.01)


def test_filter_is_first_order_forward_and_backward() -> None:
    """At the cutoff each pass leaves 1/sqrt(2), so both leave a half, without delay."""
    time_s = np.arange(2000, dtype=np.float64) * 0.01
    wave = np.stack([np.sin(2 * np.pi * f * time_s) for f in (5.0, 0.5, 20.0)], axis=1)
    trial = RawTrial(
        HEADER, time_s, np.zeros((2000, 19), np.uint16), wave, wave, time_s, np.array([1999])
    )
    middle = slice(500, 1500)
    found = filter_force(trial).force[middle]
    np.testing.assert_allclose(found[:, 0], 0.5 * wave[middle, 0], atol=2e-3)
    np.testing.assert_allclose(found[:, 1], wave[middle, 1] / (1 + 0.1**2), atol=2e-3)
    # First order by the bilinear rule, which knows its frequencies as tangents.
    ratio = np.tan(np.pi * 20 / 100) / np.tan(np.pi * 5 / 100)
    np.testing.assert_allclose(found[:, 2], wave[middle, 2] / (1 + ratio**2), atol=2e-3)


def test_filter_is_at_5_hz_whatever_the_rate() -> None:
    time_s = np.arange(8000, dtype=np.float64) * 0.0025
    wave = np.tile(np.sin(2 * np.pi * 5 * time_s)[:, None], (1, 3))
    trial = RawTrial(
        HEADER, time_s, np.zeros((8000, 19), np.uint16), wave, wave, time_s, np.array([7999])
    )
    found = filter_force(trial).force[2000:6000]
    np.testing.assert_allclose(found, 0.5 * wave[2000:6000], atol=2e-3)


@pytest.mark.parametrize(("dwell", "padding"), [(50, 16), (10, 9), (2, 1)])
def test_dwells_are_mirrored_for_five_time_constants(dwell: int, padding: int) -> None:
    """0.159 s are 16 samples at 100 Hz; a dwell that is shorter is mirrored as far as it goes."""
    time_s = np.arange(3 * dwell, dtype=np.float64) * 0.01
    force = np.random.default_rng(3).normal(size=(3 * dwell, 3))
    counts = np.zeros((3 * dwell, 19), np.uint16)
    ends = dwell * np.arange(1, 4) - 1
    found = filter_force(RawTrial(HEADER, time_s, counts, force, force, time_s, ends)).force
    sections = scipy.signal.butter(1, 5.0, fs=100.0, output="sos")
    for number in range(3):
        rows = slice(number * dwell, (number + 1) * dwell)
        wanted = scipy.signal.sosfiltfilt(
            sections, force[rows], axis=0, padtype="even", padlen=padding
        )
        np.testing.assert_allclose(found[rows], wanted, rtol=1e-9, atol=1e-12)


def test_filter_takes_gaps_up_to_half_a_second(raw: RawTrial) -> None:
    number = np.arange(len(raw.time_s))

    def gap(seconds: float) -> RawTrial:
        return replace(raw, time_s=(number + (number > 100) * (64 * seconds - 1)) / 64)

    assert filter_force(gap(0.5)).force.shape == raw.force.shape
    for seconds in (0.6, 0.0):
        with pytest.raises(DatasetError, match=r"without a gap over 0\.5 s"):
            filter_force(gap(seconds))


def test_one_sample_has_no_rate(raw: RawTrial) -> None:
    one = replace(
        raw, time_s=raw.time_s[:1], electrodes=raw.electrodes[:1], force=raw.force[:1],
        tip=raw.tip[:1], travel_m=raw.travel_m[:1], increment_end=np.array([0]),
    )  # fmt: skip
    with pytest.raises(DatasetError, match=r"its steps are inf\.\.-inf s"):
        filter_force(one)


def test_filter_refuses_what_it_cannot_filter(raw: RawTrial) -> None:
    with pytest.raises(DatasetError, match="too slow"):
        filter_force(replace(raw, time_s=raw.time_s * 20))
    late = raw.time_s + np.where(np.arange(len(raw.time_s)) > 100, 2.0, 0.0)
    with pytest.raises(DatasetError, match="without a gap"):
        filter_force(replace(raw, time_s=late))
    with pytest.raises(DatasetError, match="without a gap"):
        filter_force(replace(raw, time_s=raw.time_s[::-1]))
    force = raw.force.copy()
    force[17, 1] = np.nan
    with pytest.raises(DatasetError, match="not finite in sample 17"):
        filter_force(replace(raw, force=force))
    with pytest.raises(DatasetError, match="increment_end"):
        filter_force(replace(raw, increment_end=np.array([3, 3])))


def test_the_filter_does_not_look_into_the_next_increment(raw: RawTrial) -> None:
    """Nor does it keep the noise of the very sample that is kept."""
    levels = np.repeat([0, 0, 0.2, 0.8, 1.4, 2.0, 3.0, 4.0], DWELL)
    clean = np.outer(levels, [0.6, 0.0, 0.8]) + np.array([1.0, -2.0, 5.0])
    noise = np.random.default_rng(1).normal(0, 0.1, clean.shape)
    ends = raw.increment_end
    found = filter_force(replace(raw, force=clean)).force[ends]
    np.testing.assert_allclose(found, clean[ends], atol=1e-9)
    noisy = filter_force(replace(raw, force=clean + noise)).force[ends]
    assert np.std(noisy - clean[ends]) < 0.06


def test_what_follows_the_last_increment_is_left_alone_by_it(raw: RawTrial) -> None:
    early = replace(raw, increment_end=raw.increment_end[:-1])
    found = filter_force(early)
    assert found.force.shape == raw.force.shape
    np.testing.assert_allclose(found.force[-1], filter_force(raw).force[-1])


def test_contact_is_the_first_crossing_that_stays() -> None:
    assert onset(along_z(0, 0.2, 0.6, 0.9, 1.2)) == 2
    assert onset(along_z(0, 0.6, 0.4, 0.6, 0.9, 1.2)) == 3, "a noisy row is no contact"
    assert onset(along_z(0, 0.6, 0.7, 0.8, 0.4, 0.9)) == 1, "a late dip moves nothing"
    assert onset(along_z(0, 0.2, 0.4, 0.6)) == 3, "it stays as far as the trial has rows"
    assert onset(along_z(0, 0.5, 0.6, 0.7)) == 1, "exactly at the threshold counts"
    assert onset(along_z(0, 0.2, 0.4)) is None


def test_rows_below_half_a_newton_go_wherever_they_are() -> None:
    kept = from_half_newton(rows_of(along_z(0, 0.6, 0.3, 0.7, 0.8, 0.9, 0.45, 2.0)))
    np.testing.assert_array_equal(kept.location[1:, 0], [3, 4, 5, 7])
    np.testing.assert_array_equal(kept.force[1:, 2], [0.7, 0.8, 0.9, 2.0])
    np.testing.assert_allclose(kept.travel_m, [0, 0.5e-4, 1.5e-4, 2.5e-4, 4.5e-4])


def test_threshold_row_has_all_quantities_where_the_force_is_half_a_newton() -> None:
    rows = rows_of(along_z(0, 0.1, 0.9, 1.2, 1.5))
    found = from_half_newton(rows)
    assert len(found.force) == 4
    np.testing.assert_allclose(found.force[:, 2], [0.5, 0.9, 1.2, 1.5])
    np.testing.assert_allclose(found.location[0], [1.5, 3.0, -1.5])
    np.testing.assert_allclose(found.tared[0], -0.015)
    np.testing.assert_allclose(found.travel_m, [0, 0.5e-4, 1.5e-4, 2.5e-4])


def test_a_row_at_exactly_half_a_newton_is_not_doubled() -> None:
    found = from_half_newton(rows_of(along_z(0, 0.1, 0.5, 1.2, 1.5)))
    np.testing.assert_allclose(found.force[:, 2], [0.5, 1.2, 1.5])
    np.testing.assert_allclose(found.travel_m, [0, 1e-4, 2e-4])


def test_the_magnitude_is_met_where_the_direction_turns() -> None:
    """Linear in the magnitude, the row would be at 0.47 N."""
    before, after = np.array([0.4, 0.0, 0.0]), np.array([0.0, 0.0, 0.8])
    share = crossing(before, after)
    assert np.linalg.norm(before + share * (after - before)) == pytest.approx(0.5, abs=1e-12)
    linear = 0.25
    assert np.linalg.norm(before + linear * (after - before)) < 0.4


@given(
    sizes=st.tuples(st.floats(0, 0.4999), st.floats(0.5, 40)),
    directions=st.lists(st.integers(-9, 9), min_size=6, max_size=6),
)
def test_crossing_is_exact_for_any_two_forces(
    sizes: tuple[float, float], directions: list[int]
) -> None:
    ways = np.array(directions, float).reshape(2, 3) + np.array([0, 0, 0.5])
    before, after = np.array(sizes)[:, None] * ways / np.linalg.norm(ways, axis=1)[:, None]
    share = crossing(before, after)
    assert 0 < share <= 1
    assert np.linalg.norm(before + share * (after - before)) == pytest.approx(0.5, abs=1e-9)


def test_crossing_keeps_its_digits_in_a_long_segment() -> None:
    """A difference of like numbers would leave ten of them."""
    before, after = along_z(0.5 - 2.0**-20, 2.0**20)
    share = crossing(before, after)
    assert share == pytest.approx(2.0**-20 / (2.0**20 - 0.5 + 2.0**-20), rel=1e-13)


def test_crossing_where_the_force_starts_at_the_threshold() -> None:
    before, after = np.array([0.5, 0.0, 0.0]), np.array([0.4, 0.0, 3.0])
    assert crossing(before, after) == pytest.approx(0.1 / 9.01), "it falls below before it rises"
    rounded = before + np.array([5e-10, 0.0, 0.0])
    assert crossing(rounded, np.array([0.5, 0.6, 0.0])) == pytest.approx(0, abs=1e-8)


def test_a_segment_that_does_not_cross_is_a_mistake() -> None:
    for before, after in (along_z(0.6, 0.9), along_z(0.1, 0.4), along_z(0.9, 0.1)):
        with pytest.raises(ValueError, match="does not cross"):
            crossing(before, after)


@given(st.lists(st.floats(0, 3), min_size=2, max_size=30))
def test_what_is_left_is_at_half_a_newton_or_more(magnitudes: list[float]) -> None:
    rows = rows_of(along_z(0.0, *magnitudes))
    if from_threshold(rows.force) is None:
        with pytest.raises(DatasetError, match="never stays"):
            from_half_newton(rows)
        return
    found = from_half_newton(rows)
    size = np.linalg.norm(found.force, axis=1)
    assert size[0] == pytest.approx(0.5, abs=1e-9)
    assert (size >= 0.5 - 1e-9).all()
    assert found.travel_m[0] == 0
    assert (np.diff(found.travel_m) > 0).all()


def test_process_chains_the_steps(raw: RawTrial) -> None:
    rows = process(raw)
    magnitude = np.linalg.norm(rows.force, axis=1)
    # The filter has settled at the end of each increment; 40 Hz noise is gone.
    np.testing.assert_allclose(magnitude, [0.5, 0.8, 1.4, 2.0, 3.0, 4.0], atol=0.02)
    assert magnitude[0] == pytest.approx(0.5, abs=1e-12)
    np.testing.assert_allclose(rows.travel_m[1:], 0.5e-4 + 1e-4 * np.arange(5), atol=2e-6)
    np.testing.assert_allclose(rows.tared[1], -300 / 4095)
    np.testing.assert_allclose(rows.tared[0], -250 / 4095, atol=2 / 4095)
    np.testing.assert_allclose(rows.location[1:, 2], 1e-4 * np.arange(3, 8))
    assert rows.header == HEADER


def test_processing_changes_nothing_it_is_given(raw: RawTrial) -> None:
    before = {name: getattr(raw, name).copy() for name in ("electrodes", "force", "travel_m")}
    process(raw)
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(raw, name), array)


def test_every_dropped_trial_is_listed_with_its_reason(raw: RawTrial) -> None:
    missed = replace(raw, force=np.zeros_like(raw.force), header=replace(HEADER, unit="biotac-2"))
    kept, dropped = process_all([raw, missed])
    assert [rows.header for rows in kept] == [HEADER]
    assert [name for name, _ in dropped] == [f"biotac-2 {HEADER.trajectory}"]
    assert dropped[0][1].startswith("the force never stays at 0.5 N")
    assert "too lightly" in dropped[0][1]


def test_a_trial_that_begins_in_contact_is_refused() -> None:
    with pytest.raises(DatasetError, match=r"first row is at 0\.7 N already"):
        from_half_newton(rows_of(along_z(0.7, 0.8, 0.9)))
