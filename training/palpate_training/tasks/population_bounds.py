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
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.intervals import bounds, covered, fit_formula, terms_of
from palpate_training.learning.metrics import force_errors, interval, location_errors
from palpate_training.learning.population_fit import PopulationRows

Floats = npt.NDArray[np.float64]
Labels = npt.NDArray[np.integer]

FOLLOWED = tuple(term != "distance" for term in TERMS)
"""A bound follows all but the distance from known inputs, of which this network has none."""

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
        number of ``specimens``. Empty where there are not two.
    """
    truth, specimen = rows.targets[tested], rows.specimen[tested]
    press = np.unique(np.stack([specimen, rows.press[tested]]), axis=1, return_inverse=True)[1]
    size = np.linalg.norm(estimate[:, :3].astype(np.float64), axis=1)
    common = rows.inputs[tested, :ELECTRODES].mean(axis=1, dtype=np.float64)
    terms = terms_of(size, common, np.zeros(len(size)))
    errors = {"force_magnitude": force_errors(estimate[:, :3], truth[:, :3])["magnitude_n"]}
    if "contact_location" in quantities:
        at = 3 * quantities.index("contact_location")
        part = slice(at, at + 3)
        errors["contact_location"] = location_errors(estimate[:, part], truth[:, part])[
            "distance_m"
        ]
    found: dict[str, Any] = {}
    for name, error in errors.items():
        bound = np.full(len(error), np.nan)
        for learned, other in _halves(specimen, fingertip[tested]):
            formula = fit_formula(
                name, error[learned], terms[learned], press[learned], use=FOLLOWED
            )
            bound[other] = bounds(formula, terms[other])
        if np.isnan(bound).any():
            return {}
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
