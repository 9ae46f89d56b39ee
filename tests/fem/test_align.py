"""The paper's data processing on curves whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_fem.arrays import Floats
from palpate_fem.calibration.alignment import (
    INCREMENTS,
    AlignmentError,
    AlignmentProblem,
    CostWeights,
    ForceCurve,
    align,
    axis_rms_n,
    cost,
    curve,
    from_contact,
    peak_n,
    relative_rms,
    rms_n,
)

EXACT = 1e-12
"""Piecewise linear curves are interpolated exactly, up to rounding."""


def line(stiffness: tuple[float, float, float], touch_m: float, end_m: float = 6e-3) -> ForceCurve:
    """Force that rises linearly from a point of touch on [N/m], sampled every 0.1 mm."""
    travel = np.arange(0.0, end_m + 1e-9, 1e-4)
    return ForceCurve(travel, np.maximum(travel - touch_m, 0.0)[:, None] * np.array(stiffness))


def upwards(force: list[float]) -> Floats:
    """Forces along z [N], shape (K, 3)."""
    return np.array([[0.0, 0.0, value] for value in force], np.float64).reshape(-1, 3)


def hertz(scale: float, touch_m: float, end_m: float = 6e-3, step_m: float = 1e-4) -> ForceCurve:
    """A curve that bends [N], as a press does."""
    travel = np.arange(0.0, end_m + 1e-9, step_m)
    normal = scale * np.maximum((travel - touch_m) * 1e3, 0.0) ** 1.5
    return ForceCurve(travel, normal[:, None] * np.array([0.1, 0.05, 1.0]))


def test_curve_begins_at_exactly_the_threshold() -> None:
    part = from_contact(line((300.0, 0.0, 1000.0), 3e-3), side="simulation")
    assert np.linalg.norm(part.force_n[0]) == pytest.approx(0.5, abs=EXACT)
    assert part.travel_m[0] == pytest.approx(3e-3 + 0.5 / np.hypot(300, 1000), abs=EXACT)
    assert (np.linalg.norm(part.force_n, axis=1) >= 0.5 - EXACT).all()


def test_threshold_is_exact_where_the_direction_turns() -> None:
    """Interpolating the magnitude would give another point."""
    turning = ForceCurve(
        np.array([0.0, 1e-4, 2e-4]), np.array([[0.4, 0, 0], [0, 0, 0.9], [0, 0, 2.0]])
    )
    part = from_contact(turning, side="simulation")
    assert np.linalg.norm(part.force_n[0]) == pytest.approx(0.5, abs=EXACT)
    share = part.travel_m[0] / 1e-4
    np.testing.assert_allclose(part.force_n[0], [0.4 * (1 - share), 0, 0.9 * share], atol=EXACT)


def test_a_sample_at_the_threshold_is_the_start_and_not_a_second_one() -> None:
    travel: Floats = np.arange(4.0) * 1e-4
    part = from_contact(ForceCurve(travel, upwards([0.0, 0.5, 0.8, 1.2])), side="simulation")
    np.testing.assert_allclose(part.travel_m, travel[1:], atol=EXACT)


def test_noise_before_contact_is_no_contact_and_later_samples_below_are_left_out() -> None:
    force = upwards([0.0, 0.6, 0.1, 0.3, 0.7, 1.5, 2.0, 0.4, 0.9])
    part = from_contact(ForceCurve(np.linspace(0.0, 8e-4, 9), force), side="measurement")
    np.testing.assert_allclose(part.force_n[:, 2], [0.5, 0.7, 1.5, 2.0, 0.9], atol=EXACT)


@pytest.mark.parametrize(
    ("force", "reason"),
    [
        ([0.0, 0.1, 0.2], AlignmentProblem.NEVER_REACHES),
        ([0.8, 1.1, 2.0], AlignmentProblem.STARTS_ABOVE),
        ([0.1], AlignmentProblem.TOO_SHORT),
        ([], AlignmentProblem.TOO_SHORT),
    ],
)
def test_what_cannot_be_aligned_says_why(force: list[float], reason: AlignmentProblem) -> None:
    bad = ForceCurve(np.linspace(0.0, 3e-4, len(force)), upwards(force))
    good = line((0.0, 0.0, 1000.0), 3e-3)
    for side, pair in (("simulation", (bad, good)), ("measurement", (good, bad))):
        with pytest.raises(AlignmentError, match=str(reason)) as caught:
            align(*pair)
        assert (caught.value.side, caught.value.reason) == (side, reason)


def test_a_curve_that_ends_at_the_threshold_has_nothing_to_compare() -> None:
    ends = ForceCurve(np.array([0.0, 1e-4]), np.array([[0, 0, 0.2], [0, 0, 0.5]]))
    with pytest.raises(AlignmentError, match="ends where it reaches"):
        align(ends, line((0.0, 0.0, 1000.0), 3e-3))


def test_equal_curves_shifted_in_depth_have_no_error_but_an_offset() -> None:
    pair = align(line((0.0, 0.0, 800.0), 3.2e-3), line((0.0, 0.0, 800.0), 3e-3))
    assert rms_n(pair) == pytest.approx(0.0, abs=1e-9)
    assert pair.depth_offset_m == pytest.approx(0.2e-3, abs=EXACT)
    assert pair.coverage == pytest.approx((6 - 3.2 - 0.625) / (6 - 3 - 0.625))


def test_samples_are_the_ends_of_even_increments_up_to_the_common_end() -> None:
    simulated, measured = line((0, 0, 1000.0), 3e-3, end_m=5e-3), line((0, 0, 500.0), 3e-3)
    pair = align(simulated, measured)
    assert len(pair.displacement_m) == INCREMENTS
    np.testing.assert_allclose(np.diff(pair.displacement_m), 1.5e-3 / INCREMENTS, atol=EXACT)
    assert pair.displacement_m[-1] == pytest.approx(1.5e-3)
    assert pair.coverage == pytest.approx(1.5 / 2.0)
    np.testing.assert_allclose(pair.simulated_n[:, 2], 0.5 + 1000 * pair.displacement_m, atol=1e-9)
    np.testing.assert_allclose(pair.measured_n[:, 2], 0.5 + 500 * pair.displacement_m, atol=1e-9)


def test_of_samples_at_one_place_the_last_counts() -> None:
    path = np.zeros((4, 7))
    path[:, 2], path[:, 3] = [0.0, 1e-4, 1e-4, 2e-4], 1.0
    held = curve(path, np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, 1.2], [0, 0, 2.0]]))
    np.testing.assert_allclose(held.travel_m, [0.0, 1e-4, 2e-4])
    np.testing.assert_allclose(held.force_n[:, 2], [0.0, 1.2, 2.0])


def test_a_trajectory_that_stopped_early_has_the_travel_of_its_steps() -> None:
    path = np.zeros((5, 7))
    path[:, 2] = np.arange(5) * 1e-4
    assert curve(path, np.zeros((3, 3))).travel_m == pytest.approx([0.0, 1e-4, 2e-4])
    assert len(curve(path, np.zeros((0, 3))).travel_m) == 0


@settings(max_examples=40)
@given(
    shift_um=st.floats(-150, 150), scale=st.floats(0.5, 3.0), step_um=st.sampled_from([50, 70, 100])
)
def test_fitted_offset_finds_a_shift_in_depth(
    shift_um: float, scale: float, step_um: float
) -> None:
    simulated = hertz(scale, 3e-3 + shift_um * 1e-6, step_m=10e-6)
    measured = hertz(scale, 3e-3, step_m=step_um * 1e-6)
    pair = align(simulated, measured, fit_offset=True)
    # chords of a curve sampled every 0.1 mm lie 0.1 to 1 um off
    assert pair.depth_offset_m == pytest.approx(shift_um * 1e-6, abs=2e-6)
    assert rms_n(pair) < 5e-3


def test_fitted_offset_takes_back_what_noise_does_to_the_crossing() -> None:
    """Errors of the curves' samples: with the crossing's noise, and without."""
    random = np.random.default_rng(3)
    truth, errors = hertz(1.0, 3e-3), []
    for _ in range(20):
        noisy = ForceCurve(
            truth.travel_m, truth.force_n + random.normal(0, 0.05, truth.force_n.shape)
        )
        errors.append([rms_n(align(truth, noisy)), rms_n(align(truth, noisy, fit_offset=True))])
    crossing, fitted = np.mean(errors, axis=0)
    assert fitted < 3 * 0.05 < crossing


def test_cost_is_the_papers() -> None:
    """By hand: errors of 3 and 4 mN on z over two pairs, 1 mN on x; 0.1 mm of thickness."""
    simulated = np.zeros((INCREMENTS, 3))
    measured = np.array([[0.001, 0.0, 0.003], [0.001, 0.0, 0.004]])
    base = align(line((0, 0, 1000.0), 3e-3), line((0, 0, 1000.0), 3e-3))
    pairs = [
        type(base)(base.displacement_m, simulated, simulated + offset, 0.0, 1.0)
        for offset in measured
    ]
    np.testing.assert_allclose(axis_rms_n(pairs), [1e-3, 0.0, np.sqrt(12.5) * 1e-3], rtol=1e-12)
    weights = CostWeights(force=2.0, thickness=1e4)
    expected = 2.0 * (1 + np.sqrt(12.5)) * 1e-3
    assert cost(pairs, 0.0151, weights=weights) == pytest.approx(expected)
    for thickness in (0.0150, 0.0152):  # the paper's sign would pay for one of them
        assert cost(pairs, thickness, weights=weights) == pytest.approx(expected + 1.0)
    assert rms_n(pairs[0]) == pytest.approx(4e-3)
    assert peak_n(pairs[0]) == pytest.approx(np.sqrt(10) * 1e-3)
    assert relative_rms(pairs[0]) == pytest.approx(4 / np.sqrt(10))
