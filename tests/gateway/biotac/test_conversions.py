from __future__ import annotations

import numpy as np
import pytest

from palpate_gateway.biotac import conversions as conv

# Hardware reference 1.9: counts and degrees Celsius.
CHECKED_C = {1000: 29.8, 1500: 40.3, 2000: 48.6, 2500: 55.6, 3100: 63.0}


@pytest.mark.parametrize(("counts", "degrees_c"), CHECKED_C.items())
def test_checked_temperatures(counts: int, degrees_c: float) -> None:
    assert conv.celsius(conv.tdc_temperature(counts)) == pytest.approx(degrees_c, abs=0.05)


def test_temperatures_of_the_public_data() -> None:
    ends = conv.celsius(conv.tdc_temperature([840, 1243]))
    assert ends == pytest.approx([25.7, 35.3], abs=0.15)  # 840 counts are 25.60
    assert conv.celsius(conv.tdc_temperature([1912, 1917])) == pytest.approx([47, 47], abs=0.5)
    assert np.diff(conv.tdc_temperature([2500, 2501])) == pytest.approx(0.013, abs=5e-4)


def test_temperature_rises_over_the_whole_range_and_is_none_at_zero() -> None:
    kelvin = conv.tdc_temperature(np.arange(4096, dtype=np.uint16))
    assert np.isnan(kelvin[0])
    assert np.isfinite(kelvin[1:]).all()
    assert (np.diff(kelvin[1:]) > 0).all()


def test_impedance() -> None:
    ohm = conv.electrode_impedance(np.array([4095, 2048, 819, 1, 0], np.uint16))
    assert ohm == pytest.approx([0.0, 9995.1, 40e3, 40.94e6, np.inf], abs=0.1)
    # Pressing lowers the counts and raises the impedance.
    assert (np.diff(conv.electrode_impedance(np.arange(1, 4096))) < 0).all()


@pytest.mark.parametrize(
    ("model", "pdc_pa", "pac_pa"),
    [("biotac", 36.5, 0.37), ("biotac_sp", 36.5, 0.37), ("numatac", 12.94, 0.13)],
)
def test_pressures(model: str, pdc_pa: float, pac_pa: float) -> None:
    scale = conv.PRESSURE_SCALES[model]
    counts = np.array([2600, 2610, 2590], np.uint16)
    pdc = conv.pdc_pressure(counts, 2600.0, scale)
    pac = conv.pac_pressure(counts, np.uint16(2600), scale)
    np.testing.assert_allclose(pdc, [0, 10 * pdc_pa, -10 * pdc_pa])
    np.testing.assert_allclose(pac, [0, 10 * pac_pa, -10 * pac_pa])


def test_tared_counts_do_not_wrap_around() -> None:
    assert conv.tared(np.uint16(2000), np.uint16(2050)) == -50.0


def test_shapes_are_kept() -> None:
    counts = np.full((3, 22), 2000, np.uint16)
    for convert in (conv.electrode_impedance, conv.tdc_temperature):
        assert convert(counts).shape == (3, 22)
        assert convert(counts).dtype == np.float64
    assert conv.pac_pressure(counts, 2040.0).shape == (3, 22)
    assert conv.pdc_pressure(counts, np.zeros(22)).shape == (3, 22)
