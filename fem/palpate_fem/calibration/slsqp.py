"""Lowest cost within reach of a local model, by SLSQP."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.optimize import minimize

from palpate_fem.calibration.align import Floats, Unalignable
from palpate_fem.calibration.local import LocalModel, curvature
from palpate_fem.calibration.settings import MODULUS

_ROUNDS = 6
_ENOUGH = 1e-6
"""A round that gains less than this part of the cost was the last."""
_FLATTEST = 1e-8
"""Directions flatter than this part of the steepest are not stretched further."""


def minimise(model: LocalModel, log_modulus: float, reach: Floats) -> tuple[Floats, float]:
    """Minimise the cost over the logarithms of all parameters together.

    Thickness and modulus nearly replace one another, so the cost is a long valley, and SLSQP, which
    begins with a curvature of one in every direction, stalls in it. It works in coordinates in
    which the Gauss-Newton curvature is one; where it ends, it begins anew with the curvature there.

    Args:
        model: Built at the point to start from.
        log_modulus: Logarithm of the modulus to start from.
        reach: Largest change of the logarithm of each simulated parameter.

    Returns:
        Change of the logarithms of the simulated parameters, and the cost there [N].
    """
    at = np.append(np.zeros(len(reach)), log_modulus)
    cost = model.cost(at[:-1], at[-1])
    for _ in range(_ROUNDS):
        try:
            new = _round(model, at, reach)
        except Unalignable:  # at the edge of what can be compared there are no slopes
            break
        new_cost = model.cost(new[:-1], new[-1])
        if new_cost >= cost * (1.0 - _ENOUGH):
            break
        at, cost = new, new_cost
    return at[:-1], cost


def _round(model: LocalModel, start: Floats, reach: Floats) -> Floats:
    """One run of SLSQP from logarithms ``start``, the modulus last; returns where it ends."""
    settings, count = model.settings, len(start)
    hessian, _ = curvature(
        model.slopes(start[:-1], start[-1]), model.residuals(start[:-1], start[-1])
    )
    bend, directions = np.linalg.eigh(hessian)
    stretch = directions / np.sqrt(np.maximum(bend, max(_FLATTEST * bend[-1], 1e-300)))
    low, high = _limits(model, reach)
    worst = 10.0 * model.force_cost(start[:-1], start[-1]) + 1.0

    def logs(w: Floats) -> Floats:
        return np.asarray(np.clip(start + stretch @ w[:count], low, high))

    def force_cost(w: Floats) -> float:
        v = logs(w)
        # SLSQP's line search turns back from a cost that is worse, but not from infinity
        return min(model.force_cost(v[:-1], v[-1]), worst)

    constraints: list[dict[str, Any]] = [
        {
            "type": "ineq",
            "fun": lambda w: np.concatenate(
                [start + stretch @ w[:count] - low, high - start - stretch @ w[:count]]
            ),
        }
    ]
    begin = np.zeros(count)
    objective = force_cost
    if settings.volume_is_free:
        # |thickness error| has its kink where the optimum lies: one more unknown bounds it instead
        weight = settings.weights.thickness

        def error(w: Floats) -> float:
            v = start + stretch @ w[:count]
            return weight * (model.thickness_m(v[:-1]) - settings.target_thickness_m)

        constraints.append({"type": "ineq", "fun": lambda w: w[-1] - error(w)})
        constraints.append({"type": "ineq", "fun": lambda w: w[-1] + error(w)})
        begin = np.append(begin, abs(error(begin)))

        def objective(w: Floats) -> float:
            return force_cost(w) + float(w[-1])

    found = minimize(
        objective,
        begin,
        method="SLSQP",
        jac="3-point",
        constraints=constraints,
        options={"ftol": 1e-9, "maxiter": 100},
    )
    return logs(found.x) if math.isfinite(found.fun) else start


def _limits(model: LocalModel, reach: Floats) -> tuple[Floats, Floats]:
    """Bounds of the logarithms: the parameters' own, and the reach of the model."""
    settings = model.settings
    low, high = np.transpose(
        [settings.log_bounds(name) for name in (*settings.simulated, MODULUS)]
    ).copy()
    base = np.log(model.base.point)
    low[:-1] = np.maximum(low[:-1] - base, -reach)
    high[:-1] = np.minimum(high[:-1] - base, reach)
    return low, high
