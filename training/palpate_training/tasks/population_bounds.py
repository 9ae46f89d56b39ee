"""Whether bounds of a population's network hold on specimens that it has not met (ADR 31).

Bounds are learned on presses of one half of the specimens that no training has met, and tested on
the other half, and the other way round. Where fingertips were not met either, the halves have no
fingertip in common, so a tested specimen has a skin that neither network nor bound has met.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.files.intervals import TERMS
from palpate_training.learning.intervals import bounds, covered, fit_formula, fit_formulas, terms_of
from palpate_training.learning.metrics import (
    angles,
    force_errors,
    interval,
    location_errors,
    rms,
)
from palpate_training.learning.population_fit import PopulationRows

Floats = npt.NDArray[np.float64]
Labels = npt.NDArray[np.integer]

FOLLOWED = tuple(term in ("one", "size", "large size") for term in TERMS)
"""A bound follows the estimated force: this network knows no inputs to be far from, and what the
electrodes have in common changes no bound (training/LOG.md)."""

DRAWS = 1000


def held_bounds(
    quantities: tuple[str, ...],
    estimate: npt.NDArray[np.floating],
    rows: PopulationRows,
    tested: Labels,
    fingertip: Labels,
) -> dict[str, Any]:
    """How often bounds of 90 % hold, each specimen and each of its presses counting the same.

    Args:
        quantities: Of the network, force first.
        estimate: Of the tested rows, shape ``(T, 3 Q)``.
        rows: All rows.
        tested: Numbers of the tested rows, shape ``(T,)``.
        fingertip: Of each of all rows.

    Returns:
        By name of the bound: ``held``, share of the errors within it; ``ci95`` of that, by
        specimen; ``worst``, of a specimen; ``bound`` and ``error``, medians [N or m], and the
        number of ``specimens``. Rows without a known error do not count; a bound is left out where
        there are not two specimens.
    """
    errors, all_terms, all_presses = _bounded(quantities, estimate, rows, tested)
    found: dict[str, Any] = {}
    for name, values in errors.items():
        known = ~np.isnan(values)
        error = values[known]
        terms, press = all_terms[known], all_presses[known]
        specimen, tip = rows.specimen[tested][known], fingertip[tested][known]
        bound = np.full(len(error), np.nan)
        for learned, other in _halves(specimen, tip):
            formula = fit_formula(
                name, error[learned], terms[learned], press[learned], use=FOLLOWED
            )
            bound[other] = bounds(formula, terms[other])
        if not known.any() or np.isnan(bound).any():
            continue
        own = [specimen == one for one in np.unique(specimen)]
        share = np.array([covered(error[one], bound[one], press[one]) for one in own])
        drawn = np.random.default_rng(0).choice(share, (DRAWS, len(share))).mean(axis=1)
        found[name] = {
            "held": float(share.mean()),
            "ci95": interval(drawn),
            "worst": float(share.min()),
            "bound": float(np.median(bound)),
            "error": float(np.median(error)),
            "specimens": len(share),
        }
    return found


def told_errors(
    quantities: tuple[str, ...],
    estimate: npt.NDArray[np.floating],
    rows: PopulationRows,
    tested: Labels,
) -> dict[str, Any]:
    """What a finger that is told by presses needs to know of the network's errors.

    Args:
        quantities: Of the network, force first.
        estimate: Of rows that it has not met, with presses known, shape ``(T, 3 Q)``.
        rows: All rows.
        tested: Numbers of these rows, shape ``(T,)``.

    Returns:
        ``sd`` by quantity: root mean square errors per axis, of a normal that of its angle;
        ``bounds``: weights of ``TERMS`` by name. Rows without a known error do not count.
    """
    truth = rows.targets[tested]
    spread = {}
    for number, name in enumerate(quantities):
        part = slice(3 * number, 3 * number + 3)
        known = np.isfinite(truth[:, part]).all(axis=1)
        guess, right = (values[known, part] for values in (estimate, truth))
        error = angles(guess, right)[:, None] if name == "contact_normal" else guess - right
        spread[name] = [float(f"{one:.6g}") for one in rms(error)]
    errors, terms, press = _bounded(quantities, estimate, rows, tested)
    formulas = fit_formulas(errors, terms, press, use=FOLLOWED)
    return {"sd": spread, "bounds": {one.name: one.weights for one in formulas}}


def _bounded(
    quantities: tuple[str, ...],
    estimate: npt.NDArray[np.floating],
    rows: PopulationRows,
    tested: Labels,
) -> tuple[dict[str, Floats], Floats, Labels]:
    """Errors that have a bound, by name, the terms of each row, and its press of its specimen.

    Where a row has no contact, its error of the location is NaN.
    """
    truth = rows.targets[tested]
    both = np.stack([rows.specimen[tested], rows.press[tested]])
    press = np.unique(both, axis=1, return_inverse=True)[1]
    nothing = np.zeros(len(tested))
    size = np.linalg.norm(estimate[:, :3].astype(np.float64), axis=1)
    errors = {"force_magnitude": force_errors(estimate[:, :3], truth[:, :3])["magnitude_n"]}
    if "contact_location" in quantities:
        at = 3 * quantities.index("contact_location")
        found = location_errors(estimate[:, at : at + 3], truth[:, at : at + 3])
        errors["contact_location"] = found["distance_m"]
    return errors, terms_of(size, nothing, nothing), press


def _halves(
    specimen: Labels, fingertip: Labels
) -> Iterator[tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]]:
    """Rows to learn from and rows to test on, twice; nothing if there is one specimen only."""
    label = fingertip if len(np.unique(fingertip)) > 1 else specimen
    names = np.unique(label)
    if len(names) > 1:
        first = np.isin(label, names[: len(names) // 2])
        yield first, ~first
        yield ~first, first
