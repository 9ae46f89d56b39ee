"""The cost near a simulated point: the modulus exactly, the other parameters to first order."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from palpate_fem.calibration.align import Curve, Floats
from palpate_fem.calibration.model import Case, State, compare, force_and_thickness_cost
from palpate_fem.calibration.settings import CalibrationSettings

_LOG_STEP = 1e-3
"""Difference step of a logarithm; the model is linear, only the alignment is not."""
_LEAST_RMS_N = 1e-4
"""An axis that fits better than this is not weighted up further [N]; no instrument sees it."""


class LocalModel:
    """Curves around a base point, linear in the logarithm of the simulated parameters.

    Args:
        base: Runs at the base point.
        moved: Runs with one parameter moved each, in the order of ``settings.simulated``.
        cases: What they are compared with.
        settings: How.
    """

    def __init__(
        self,
        base: State,
        moved: Sequence[State],
        cases: Sequence[Case],
        settings: CalibrationSettings,
    ) -> None:
        self.base, self.cases, self.settings = base, cases, settings
        steps = [float(np.log(state.point[i] / base.point[i])) for i, state in enumerate(moved)]
        self._travel, self._force, self._slopes = [], [], []
        for j, line in enumerate(base.curves):
            # runs that stopped early: what all of them have
            length = min(len(state.curves[j].travel_m) for state in (base, *moved))
            self._travel.append(line.travel_m[:length])
            self._force.append(line.force_n[:length])
            self._slopes.append(
                np.stack(
                    [
                        (state.curves[j].force_n[:length] - line.force_n[:length]) / step
                        for state, step in zip(moved, steps, strict=True)
                    ]
                )
            )
        self.thickness_slopes = self._scalar_slopes("thickness_m", moved, steps)
        self.volume_slopes = self._scalar_slopes("fluid_volume_m3", moved, steps)

    def _scalar_slopes(self, name: str, moved: Sequence[State], steps: list[float]) -> Floats:
        start = getattr(self.base, name)
        return np.array([(getattr(s, name) - start) / d for s, d in zip(moved, steps, strict=True)])

    def curves(self, shift: Floats) -> list[Curve]:
        """Curves at the base point times exp(shift), at the modulus of the runs."""
        return [
            Curve(travel, force + np.tensordot(shift, slopes, axes=1))
            for travel, force, slopes in zip(self._travel, self._force, self._slopes, strict=True)
        ]

    def thickness_m(self, shift: Floats) -> float:
        """Total thickness at the base point times exp(shift) [m]."""
        return float(self.base.thickness_m + self.thickness_slopes @ shift)

    def cost(self, shift: Floats, log_modulus: float) -> float:
        """Cost there [N]; infinite if a case cannot be compared."""
        return self._cost(shift, log_modulus, self.thickness_m(shift))

    def force_cost(self, shift: Floats, log_modulus: float) -> float:
        """Cost there without the thickness term [N]; infinite if a case cannot be compared."""
        return self._cost(shift, log_modulus, self.settings.target_thickness_m)

    def _cost(self, shift: Floats, log_modulus: float, thickness_m: float) -> float:
        factor = math.exp(log_modulus) / self.settings.reference_shear_modulus_pa
        return force_and_thickness_cost(
            self.curves(shift), self.cases, factor, thickness_m, self.settings
        )

    def simulated(self, shift: Floats, log_modulus: float) -> list[Curve]:
        """Curves there, at that modulus."""
        factor = math.exp(log_modulus) / self.settings.reference_shear_modulus_pa
        return [line.scaled(factor) for line in self.curves(shift)]

    def residuals(self, shift: Floats, log_modulus: float) -> Floats:
        """Simulation minus measurement of all samples of all cases [N], shape (N, 3).

        Raises:
            Unalignable: One does not reach the threshold force.
        """
        parts = []
        for line, case in zip(self.simulated(shift, log_modulus), self.cases, strict=True):
            pair = compare(line, case, 1.0, self.settings)
            parts.append(pair.simulated_n - pair.measured_n)
        return np.concatenate(parts)

    def slopes(self, shift: Floats, log_modulus: float) -> Floats:
        """Slopes of the residuals in all logarithms, the modulus last [N], shape (N, 3, P).

        Raises:
            Unalignable: One does not reach the threshold force.
        """
        columns = []
        for i in range(len(shift) + 1):
            step = np.zeros(len(shift) + 1)
            step[i] = _LOG_STEP
            ahead = self.residuals(shift + step[:-1], log_modulus + step[-1])
            behind = self.residuals(shift - step[:-1], log_modulus - step[-1])
            columns.append((ahead - behind) / (2 * _LOG_STEP))
        return np.stack(columns, axis=-1)


def curvature(slopes: Floats, residuals: Floats) -> tuple[Floats, Floats]:
    """Gauss-Newton curvature (P, P) of the force cost, and the weight of each axis (3,).

    The weight is the derivative of an axis' RMS by its summed squares, times two.
    """
    rms = np.maximum(np.sqrt((residuals**2).mean(axis=0)), _LEAST_RMS_N)
    weight = 1.0 / (len(residuals) * rms)
    return np.einsum("nai,naj,a->ij", slopes, slopes, weight), weight
