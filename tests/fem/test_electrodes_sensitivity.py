"""Derivatives of counts by a specimen's parameters, against differences."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.sensitivity import (
    AXES,
    SCALARS,
    counts_by_log_sigma,
    counts_by_parameters,
)
from palpate_fem.electrodes.specimen import SENSING, SpecimenParameters
from palpate_fem.mesh.parametric import biotac

SPECIMEN = SpecimenParameters(
    sigma_s_m=0.31,
    clamp_closing=0.7,
    side_closing_m=0.2e-3,
    core_offset_m=(0.3e-3, -0.05e-3, -0.2e-3),
    floor_m=8e-6,
    squeeze_exponent=0.8,
    contact_ohm_m2=2e-4,
    series_ohm=150.0,
    asymmetry=tuple(1 + 0.01 * (k - 9) for k in range(SENSING)),
    gain=(0.002,) * SENSING,
)


@pytest.fixture(scope="module")
def model() -> ElectrodeModel:
    return ElectrodeModel(biotac(edge_m=0.8e-3), SPECIMEN, edge_m=0.9e-3)


def pressed(model: ElectrodeModel) -> Any:
    """A state with open, touching and pressed film."""
    rest = model.finder.measure(model.geometry.mesh.nodes)
    away = np.linalg.norm(model.film.nodes - ELECTRODE_POSITIONS[16], axis=1)
    inside = np.exp(-((away / 3e-3) ** 2))
    return replace(rest, gap=rest.gap * (1 - inside), pressure=8e4 * inside**4)


def changed(name: str, by: float) -> SpecimenParameters:
    if name in AXES:
        core = list(SPECIMEN.core_offset_m)
        core[AXES.index(name)] += by
        return replace(SPECIMEN, core_offset_m=tuple(core))
    return replace(SPECIMEN, **{name: getattr(SPECIMEN, name) + by})


@pytest.mark.parametrize("name", SCALARS)
def test_slopes_are_those_of_differences(model: ElectrodeModel, name: str) -> None:
    gap = pressed(model)
    found = counts_by_parameters(model, model.of_gap(gap))[name]
    size = 1e-3 if name in AXES else abs(getattr(SPECIMEN, name))
    step = 1e-4 * size
    up, down = (model.with_specimen(changed(name, s * step)).of_gap(gap).counts for s in (1, -1))
    expected = (up - down) / (2 * step)
    assert np.abs(expected).max() * size > 1.0  # the state feels this parameter
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_slopes_by_asymmetry_and_warmth_are_those_of_differences(model: ElectrodeModel) -> None:
    gap = pressed(model)
    response = model.of_gap(gap)
    step = 1e-5
    more = replace(SPECIMEN, asymmetry=tuple(one + step for one in SPECIMEN.asymmetry))
    expected = (model.with_specimen(more).of_gap(gap).counts - response.counts) / step
    found = counts_by_parameters(model, response)["asymmetry"]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    warmer = model.of_gap(gap, log_sigma=step).counts
    expected = (warmer - response.counts) / step
    np.testing.assert_allclose(counts_by_log_sigma(model, response), expected, rtol=1e-4)
