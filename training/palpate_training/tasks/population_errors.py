"""Errors of a population's network: in a cell of its split, and after a few presses of a specimen.

Presses that a specimen is calibrated with are of the same cell as those that are tested: where
specimens and presses are in no training, neither is what tells the specimen. They are at points of
the skin where nothing is tested, and the same rows are tested with none, one, five and ten of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.metrics import (
    FORCE_BINS_N,
    angles,
    drawn_medians,
    force_errors,
    interval,
    location_errors,
)
from palpate_training.learning.networks import predict
from palpate_training.learning.population_fit import PopulationRows
from palpate_training.learning.population_net import PopulationNet
from palpate_training.tasks.population_bounds import held_bounds, told_errors

FloatArray = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.integer]
Estimate = Callable[[FloatArray], npt.NDArray[np.floating]]

COMMON_OFFSETS = (0.05, -0.05)
"""Logarithms of the impedance by which all electrodes are off in the stressed cells."""

ROWS_MOST = 60_000
"""Rows of a cell, evenly over it; more would only cost time."""

SHOTS = (0, 1, 5, 10)
"""Presses of a specimen that are known."""

SHOT_DRAWS = 4
"""How often they are drawn."""

SHOT_ROWS_MOST = 400
"""Tested rows of a specimen in a draw, evenly over it."""

FACTOR_PRIOR = 1.0
"""Presses that a factor of one counts as, where one factor is fitted to presses."""

DRAWS = 1000


@dataclass(frozen=True, slots=True)
class ShotDraw:
    """Presses of a specimen to know, and rows of other presses of it.

    Attributes:
        presses: Rows of each press, in the order in which they become known.
        tested: Rows that are tested, whatever is known.
    """

    presses: tuple[Rows, ...]
    tested: Rows

    def known(self, shots: int) -> Rows:
        """Rows of the first presses."""
        return np.concatenate([np.zeros(0, np.int64), *self.presses[:shots]])


def draw_shots(
    rows: PopulationRows, chosen: Mask, *, most: int, draws: int, seed: int
) -> list[ShotDraw]:
    """Draw presses of every specimen that has more than so many points among the chosen rows."""
    rng = np.random.default_rng(seed)
    point = rows.press if rows.point is None else rows.point
    usable = np.flatnonzero(chosen & rows.touched)
    found: list[ShotDraw] = []
    for specimen in np.unique(rows.specimen[usable]):
        own = usable[rows.specimen[usable] == specimen]
        points = np.unique(point[own])
        if len(points) <= most:
            continue
        for _ in range(draws):
            known = rng.permutation(points)[:most]
            presses = []
            for one in known:
                there = own[point[own] == one]
                press = rng.choice(np.unique(rows.press[there]))
                presses.append(there[rows.press[there] == press])
            others = own[~np.isin(point[own], known)]
            some = np.unique(np.linspace(0, len(others) - 1, SHOT_ROWS_MOST).astype(int))
            found.append(ShotDraw(tuple(presses), others[some]))
    return found


def cell(
    rows: PopulationRows, chosen: Mask, net: PopulationNet, rivals: dict[str, Estimate]
) -> dict[str, Any]:
    """Errors of network and rivals in one cell, and of the network with all electrodes off.

    Returns:
        By name of the rival, medians.
    """
    some = np.flatnonzero(chosen & rows.touched)
    some = some[np.unique(np.linspace(0, len(some) - 1, ROWS_MOST).astype(int))]
    x, truth, press = rows.inputs[some], rows.targets[some], rows.press[some]
    names = net.quantities
    found: dict[str, Any] = {"rows": len(some), "presses": len(np.unique(press))}
    found["network"] = figures(names, predict(net, x), truth, press, ends=True)
    for name, rival in rivals.items():
        found[name] = figures(names, rival(x), truth, press)
    for offset in COMMON_OFFSETS:
        moved = x.copy()
        moved[:, :ELECTRODES] += np.float32(offset)
        found[f"network, all {offset:+g}"] = figures(names, predict(net, moved), truth, press)
    still = chosen & (np.linalg.norm(rows.targets[:, :3], axis=1) == 0.0)
    if still.any():
        lengths = np.linalg.norm(predict(net, rows.inputs[still][:ROWS_MOST])[:, :3], axis=1)
        found["untouched_median_n"] = float(np.median(lengths))
    return found


def shots_table(
    rows: PopulationRows,
    chosen: Mask,
    net: PopulationNet,
    fingertip: Rows | None = None,
    *,
    seed: int,
) -> dict[str, Any]:
    """Errors by number of known presses of the network, and of its estimate times one factor.

    Args:
        rows: All rows.
        chosen: Those of the cell.
        net: The network.
        fingertip: Of each row, where bounds are wanted, too.
        seed: Of the drawn presses.

    Returns:
        By number of presses the medians by name of the rival, and ``held_bounds``, all on the same
        rows, and ``told_errors`` with the most presses; empty where no specimen has presses enough
        for one.
    """
    for most in sorted(SHOTS, reverse=True):
        drawn = draw_shots(rows, chosen, most=most, draws=SHOT_DRAWS, seed=seed) if most else []
        if drawn:
            break
    else:
        return {}
    tested = np.concatenate([draw.tested for draw in drawn])
    truth, specimen = rows.targets[tested], rows.specimen[tested]
    found: dict[str, Any] = {
        "rows": len(tested),
        "specimens": len(np.unique(specimen)),
        "draws": SHOT_DRAWS,
    }
    moved = rows.inputs.copy()
    for shots in (number for number in SHOTS if number <= most):
        table = {
            "network": np.vstack([_told(net, rows, draw, shots) for draw in drawn]),
            "one factor": np.vstack([_scaled(net, rows, draw, shots) for draw in drawn]),
        }
        if shots:
            for offset in COMMON_OFFSETS:
                moved[:, :ELECTRODES] = rows.inputs[:, :ELECTRODES] + np.float32(offset)
                table[f"network, all {offset:+g}"] = np.vstack(
                    [_told(net, rows, draw, shots, moved) for draw in drawn]
                )
        found[str(shots)] = {
            name: figures(net.quantities, estimate, truth, specimen, ends=name == "network")
            for name, estimate in table.items()
        }
        if fingertip is not None:
            known = (net.quantities, table["network"], rows, tested)
            found[str(shots)]["bounds"] = held_bounds(*known, fingertip)
            if shots == most:
                found["told"] = {"shots": shots} | told_errors(*known)
    return found


def _told(
    net: PopulationNet,
    rows: PopulationRows,
    draw: ShotDraw,
    shots: int,
    inputs: FloatArray | None = None,
) -> FloatArray:
    """Estimates of the tested rows after so many presses; other inputs than theirs may be given."""
    tested = (rows.inputs if inputs is None else inputs)[draw.tested]
    return predict(net, net.told(tested, rows.calibration(draw.known(shots))))


def _scaled(net: PopulationNet, rows: PopulationRows, draw: ShotDraw, shots: int) -> FloatArray:
    """What the network estimates without a press, forces times the factor that fits the presses."""
    logs = [
        np.mean(
            np.log(np.linalg.norm(rows.targets[press, :3], axis=1))
            - np.log(np.linalg.norm(predict(net, rows.inputs[press])[:, :3], axis=1) + 1e-3)
        )
        for press in draw.presses[:shots]
    ]
    estimate = predict(net, rows.inputs[draw.tested])
    estimate[:, :3] *= np.float32(np.exp(sum(logs) / (shots + FACTOR_PRIOR)))
    return estimate


def figures(
    names: tuple[str, ...],
    estimate: npt.NDArray[np.floating],
    truth: FloatArray,
    press: npt.NDArray[np.integer],
    *,
    ends: bool = False,
) -> dict[str, Any]:
    """Medians of the errors, and with ``ends`` their 95 % intervals by press."""
    errors: dict[str, npt.NDArray[np.float64]] = {}
    for number, name in enumerate(names):
        guess, right = (values[:, 3 * number : 3 * number + 3] for values in (estimate, truth))
        if name == "force":
            of_force = force_errors(guess, right)
            hard = np.linalg.norm(right, axis=1) >= FORCE_BINS_N["2_to_8n"][0]
            errors["force_magnitude_n"] = of_force["magnitude_n"]
            relative = 100.0 * of_force["magnitude_over_norm"]
            errors["force_from_2n_percent"] = np.where(hard, relative, np.nan)
            errors["force_angle_rad"] = of_force["angle_rad"]
        elif name == "contact_normal":
            unknown = np.isnan(right).any(axis=1)
            angle = angles(guess, np.nan_to_num(right))
            errors["normal_angle_rad"] = np.where(unknown, np.nan, angle)
        else:
            errors[f"{name}_mm"] = 1e3 * location_errors(guess, right)["distance_m"]
    known = {key: values for key, values in errors.items() if np.isfinite(values).any()}
    figures: dict[str, Any] = {key: float(np.nanmedian(one)) for key, one in known.items()}
    if ends:
        figures["ci95"] = {
            key: interval(drawn_medians([one], press, draws=DRAWS)) for key, one in known.items()
        }
    return figures
