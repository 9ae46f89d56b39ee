"""The benchmark of the electrodes measures every part; how fast they are is not tested."""

from __future__ import annotations

import math

import numpy as np
import pytest

from palpate_fem.bench import of_electrodes
from palpate_fem.mesh.parametric import biotac
from palpate_fem.result import Convergence, IndentationStep


@pytest.mark.slow
def test_the_electrodes_parts_are_measured() -> None:
    geometry = biotac(edge_m=0.9e-3, layers=1)
    nodes = geometry.mesh.nodes
    still = np.zeros_like(nodes)
    step = IndentationStep(
        pose=np.zeros(7),
        displacement=still,
        fluid_pressure_pa=0.0,
        force=np.zeros(3),
        torque=np.zeros(3),
        indenter_force=still,
        core_force=still,
        contact_area_m2=0.0,
        centre_of_pressure=np.full(3, np.nan),
        stress=np.zeros((len(geometry.mesh.elements), 6)),
        convergence=Convergence(1, 1, 1, 0.0, 0.0, 0.0, 0.0),
    )
    metrics = of_electrodes(geometry, nodes, step, repeats=1)
    for name, value in metrics.items():
        assert isinstance(value, float), name
        assert 0 < value < math.inf, name
    share = metrics["film.state_and_unit_over_scipy_factorisation"]
    unit, floor = metrics["film.state_and_unit_ms"], metrics["film.scipy_factorisation_ms"]
    assert math.isclose(float(share) * float(floor), float(unit))
