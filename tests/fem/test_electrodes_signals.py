"""Divider and converter, parameters of a specimen, and what time does to the signals."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from palpate.anatomy import spatial_modes
from palpate.errors import ConfigError
from palpate_fem.electrodes.electronics import (
    Counts,
    ElectrodeSignals,
    convert,
    core_temperature_c,
    counts_slope,
    ideal_counts,
    impedance_of,
    log_sigma,
    skewed,
    slot_offsets_s,
)
from palpate_fem.electrodes.specimen import LIMITS, SpecimenParameters

Floats = NDArray[np.float64]
UNIT = SpecimenParameters()
# Section 4.3: a real sensor at rest, counts and the impedances that follow from 10 kOhm.
REST = {"E1": (2987, 3.71e3), "E2": (3449, 1.87e3), "E17": (3403, 2.03e3), "E19": (3108, 3.18e3)}


def drawn(seed: int) -> SpecimenParameters:
    return UNIT.drawn(np.random.default_rng(seed))


def read(signals: ElectrodeSignals, ideal: Floats, elapsed_s: float) -> Counts:
    """Counts of one reading, shape (19,)."""
    counts: Counts = signals.stream(ideal[None], np.array([elapsed_s]))[0]
    return counts


@pytest.mark.parametrize("electrode", REST)
def test_divider_is_that_of_the_notes(electrode: str) -> None:
    counts, impedance = REST[electrode]
    assert ideal_counts(np.full(19, impedance), UNIT)[0] == pytest.approx(counts, abs=2.5)


@settings(max_examples=50)
@given(seed=st.integers(0, 10**6), size=st.floats(1e2, 1e6))
def test_counts_and_impedances_are_inverse(seed: int, size: float) -> None:
    specimen = drawn(seed)
    impedance = size * np.linspace(0.5, 2, 19)
    ideal = ideal_counts(impedance, specimen)
    good = (ideal > 1) & (ideal < 4090)
    np.testing.assert_allclose(impedance_of(ideal, specimen)[good], impedance[good], rtol=1e-9)
    step = 1e-5 * impedance
    difference = ideal_counts(impedance + step, specimen) - ideal_counts(impedance - step, specimen)
    np.testing.assert_allclose(
        difference / (2 * step), counts_slope(impedance, specimen), rtol=1e-5
    )


def test_converter_rounds_and_ends() -> None:
    assert convert(np.array([-3.0, 0.4, 0.6, 2000.5, 4095.4, 5000.0])).tolist() == [
        0,
        0,
        1,
        2000,
        4095,
        4095,
    ]
    assert np.isnan(impedance_of(np.array([0.0] * 18 + [4095.0]), UNIT)).all()


@pytest.mark.parametrize("seed", range(5))
def test_unit_survives_json(seed: int) -> None:
    specimen = replace(drawn(seed), name="finger")
    assert SpecimenParameters.from_json(specimen.to_json()) == specimen


@pytest.mark.parametrize("key", LIMITS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e9, 1e9, "much", True, None])
def test_unit_refuses_what_is_out_of_range(key: str, bad: object) -> None:
    values = json.loads(UNIT.to_json())
    values[key] = [bad] * 19 if isinstance(values[key], list) else bad
    with pytest.raises(ConfigError, match=key):
        SpecimenParameters.from_json(json.dumps(values))


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{", "not JSON"),
        ("[]", "not a JSON object"),
        ('{"sigma": 0.2}', "sigma"),
        ('{"gain": [0.0]}', "gain"),
        ('{"gain": 0.0}', "gain"),
        ('{"floor_m": 5e-5, "asperity_m": 4e-5}', "floor_m"),
        ('{"name": 3}', "name"),
    ],
)
def test_parameters_out_of_range_are_refused(text: str, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        SpecimenParameters.from_json(text)


def test_priors_have_the_sheets_spread() -> None:
    specimens = [drawn(seed) for seed in range(400)]
    logs = np.log([specimen.sigma_s_m for specimen in specimens])
    assert logs.std() == pytest.approx(0.25, rel=0.1)
    assert np.log([specimen.asymmetry for specimen in specimens]).std() == pytest.approx(
        0.03, rel=0.05
    )
    assert max(specimen.series_ohm for specimen in specimens) <= 300
    assert drawn(7) == drawn(7)


def test_core_warms_up_with_one_time_constant() -> None:
    at = [core_temperature_c(t, 25.0, UNIT) for t in (0.0, UNIT.heating_tau_s, 1e6)]
    np.testing.assert_allclose(at, [25.0, 25 + 10 * (1 - 1 / math.e), 35.0])
    assert log_sigma(UNIT.reference_c, UNIT) == 0
    # Section 4.4: 5 K are 78..96 counts at an impedance of the nominal sensor.
    warm = ideal_counts(np.full(19, 2.7e3) * math.exp(-log_sigma(45.0, UNIT)), UNIT)[0]
    assert 60 < warm - ideal_counts(np.full(19, 2.7e3), UNIT)[0] < 100


def test_signals_of_a_seed_repeat_and_have_the_units_noise() -> None:
    rest = np.linspace(2500, 3300, 19)
    one, two = (ElectrodeSignals(UNIT, rest, seed=5) for _ in range(2))
    a = np.array([read(one, rest, 0.01) for _ in range(400)])
    np.testing.assert_array_equal(a, [read(two, rest, 0.01) for _ in range(400)])
    assert a.dtype == np.uint16
    # Rounding adds 1/12.
    wanted = math.sqrt(UNIT.noise_counts**2 + 1 / 12)
    assert a.std(axis=0).mean() == pytest.approx(wanted, rel=0.08)


def test_spatial_modes_drift_by_their_share() -> None:
    modes = spatial_modes()
    np.testing.assert_allclose(modes.mean(axis=1), 0, atol=1e-12)
    specimen = replace(UNIT, noise_counts=0.0, gradient_sd=0.05)
    rest = np.full(19, 3200.0)
    impedance = impedance_of(rest, specimen)
    drifts = []
    for seed in range(200):
        warm = read(ElectrodeSignals(specimen, rest, seed=seed), rest, 0.01)
        drifts.append(np.log(impedance / impedance_of(warm, specimen)))
    # Two independent modes of unit mean square share the variance over the electrodes.
    assert np.sqrt(np.mean(np.square(drifts))) == pytest.approx(0.05, rel=0.15)


def test_creep_comes_late_and_goes_late() -> None:
    specimen = replace(UNIT, noise_counts=0.0, gradient_sd=0.0, creep_share=0.02, creep_tau_s=15.0)
    rest, pressed = np.full(19, 3200.0), np.full(19, 1700.0)
    finger = ElectrodeSignals(specimen, rest)
    assert (read(finger, rest, 1.0) == 3200).all()
    assert (read(finger, pressed, 1e-6) == 1730).all()
    assert (read(finger, pressed, 500.0) == 1700).all()
    assert (read(finger, rest, 1e-6) == 3170).all()  # section 4.5: -30..+10 counts
    assert read(finger, rest, 15.0)[0] == round(3200 - 30 / math.e)
    # The same time in many steps.
    coarse, fine = ElectrodeSignals(specimen, rest), ElectrodeSignals(specimen, rest)
    for _ in range(100):
        last = read(fine, pressed, 0.1)
    np.testing.assert_array_equal(read(coarse, pressed, 10.0), last)


def test_a_stream_is_the_readings_one_by_one() -> None:
    rng = np.random.default_rng(3)
    ideal = 2000.0 + np.cumsum(rng.normal(scale=20.0, size=(700, 19)), axis=0)
    elapsed = rng.uniform(0.005, 0.5, 700)
    elapsed[300] = 500.0  # a long pause
    together = ElectrodeSignals(UNIT, ideal[0], 5).stream(ideal, elapsed)
    single = ElectrodeSignals(UNIT, ideal[0], 5)
    noiseless = replace(UNIT, noise_counts=0.0)
    one_by_one = np.array([read(single, row, dt) for row, dt in zip(ideal, elapsed, strict=True)])
    np.testing.assert_array_equal(together, one_by_one)
    parts = ElectrodeSignals(noiseless, ideal[0], 5)
    split = np.concatenate(
        [parts.stream(ideal[:13], elapsed[:13]), parts.stream(ideal[13:], elapsed[13:])]
    )
    whole = ElectrodeSignals(noiseless, ideal[0], 5).stream(ideal, elapsed)
    np.testing.assert_array_equal(split, whole)


def test_a_drift_of_conductivity_moves_counts_as_a_warmer_film_does() -> None:
    still = replace(UNIT, noise_counts=0.0, gradient_sd=0.0, creep_share=0.0)
    impedance = np.linspace(1.5e3, 5e3, 19)
    ideal = ideal_counts(impedance, still)
    drift = np.array([0.0, 0.01, -0.01])
    read = ElectrodeSignals(still, ideal, 0).stream(
        np.repeat(ideal[None], 3, axis=0), np.ones(3), log_sigma=drift
    )
    warm = [ideal_counts(impedance * math.exp(-d), still) for d in drift]
    np.testing.assert_allclose(read, warm, atol=0.6)


def test_electrodes_of_a_frame_are_read_one_after_the_other() -> None:
    offsets = slot_offsets_s()
    assert offsets[0] == pytest.approx(10e-3 / 44)
    assert offsets[-1] < 10e-3
    time_s: Floats = np.linspace(0.0, 0.99, 100)
    ramp = 1000.0 + 300.0 * time_s[:, None] * np.ones(19)
    seen = skewed(ramp, time_s)
    np.testing.assert_allclose(seen[:-1], ramp[:-1] + 300.0 * offsets)
    np.testing.assert_array_equal(seen[-1], ramp[-1])
