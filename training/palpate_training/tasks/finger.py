"""A finger's own ``features`` bundle, from presses against a force/torque sensor.

The bundle estimates the force of this one finger. Which estimator it holds is chosen on presses
that are held out, and what is said of it is measured on others, held out from that choice, too. A
finger that the network of a simulated population knows best, once it is told these presses, gets
that network's contact location, centre of pressure and contact normal as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from palpate.errors import DatasetError
from palpate.files.intervals import BoundFormula, Intervals
from palpate.messages import TrainingRange
from palpate_training.datasets.features import FeatureDataset
from palpate_training.learning.export import export_features, refuse_existing
from palpate_training.learning.force_process import (
    LOCALITIES,
    ForceLine,
    ForceProcesses,
    KnownRows,
)
from palpate_training.learning.graphs import FeaturesGraph
from palpate_training.learning.intervals import LEVEL, bounds, fit_formulas, terms_of, widened
from palpate_training.learning.metrics import force_errors, force_metrics
from palpate_training.learning.ranges import ends_of, known_inputs
from palpate_training.learning.told_finger import ToldFinger
from palpate_training.tasks.features import threshold_above

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.integer]

PRESSES_LEAST = 6
"""Fewer presses cannot be held out and chosen on at once."""

PRESS_N = 0.5
"""What does not reach this force is no press [N]."""

ROWS_MOST = 600
"""Rows that are fitted to; neighbours say nearly the same, and an estimate costs time for each."""

UNTOUCHED_SHARE = 0.2
"""Share of them that is untouched, where the data has such rows."""

FOLDS = 6
"""Presses are held out in so many parts to be measured on."""

CHOICES = 3
"""Those that are left, in so many parts to choose on."""

_DEVIATIONS = 1.6449
"""``LEVEL`` of the errors shall lie within so many standard deviations, as of a normal
distribution."""

_THRESHOLD_UNKNOWN_N = 0.2
"""Where no row is untouched: above the noise of a six-axis sensor [N]."""

_GOLDEN_ROWS = 64

Estimator = Callable[[KnownRows, Floats], nn.Module]

TOLD = "network of a simulated population, told by the presses"

LIKE_SIMULATED = 0.25
"""A finger is like simulated ones if this network is off by no more than so much of 0.5 N and the
force, median over rows of presses held out: 0.06 to 0.21 of it on specimens of the twin, 0.34 and
more on others (docs/results/calibrate.md)."""

ESTIMATORS: dict[str, Estimator] = {
    "line": lambda rows, _: ForceLine(rows),
    **{
        f"Gaussian processes, locality {local:g}": partial(ForceProcesses, local=local)
        for local in LOCALITIES
    },
    TOLD: ToldFinger,
}
"""What is chosen from."""


@dataclass(frozen=True, slots=True)
class FingerReport:
    """A finger's own bundle.

    Attributes:
        digest: The bundle's digest, 32 bytes.
        estimator: Which one was chosen.
        metrics: On presses held out, as in the manifest.
        presses: How many presses it learned from.
        rows: Rows that it was fitted to.
    """

    digest: bytes
    estimator: str
    metrics: dict[str, float]
    presses: int
    rows: int


def train_finger(
    data: FeatureDataset,
    folder: Path,
    *,
    name: str,
    version: int = 1,
    serials: Sequence[str] = (),
    on_step: Callable[[], None] = lambda: None,
) -> FingerReport:
    """Fit to the presses of one finger, measure on presses held out, and write the bundle.

    Args:
        data: Presses of a single finger; a press is a group, or a block where there are few groups.
        folder: Of the bundle; must not exist.
        name: Of the bundle.
        version: Of the bundle.
        serials: Serial numbers of the finger, so that no other one is taken for calibrated.
        on_step: Called ``STEPS`` times, for a progress bar.

    Raises:
        DatasetError: The data holds several fingers, or too few presses.
        BundleError: The folder exists, or parity fails; nothing is left on disk.
    """
    refuse_existing(folder)
    known, touched = known_rows(data)
    rest = data.baseline.mean(axis=0, dtype=np.float64)
    held_out = np.zeros_like(known.force)
    lines, constants = np.zeros_like(known.force), np.zeros_like(known.force)
    for out in _folds(known.press, FOLDS):
        fitted = known.where(~out)
        held_out[out] = estimate_of(fit_finger(fitted, rest)[1], known.tared[out])
        lines[out] = estimate_of(ForceLine(fitted), known.tared[out])
        constants[out] = fitted.force[touched[~out]].mean(axis=0)
        on_step()
    estimator, net = fit_finger(known, rest)
    force_sd = _force_sd(held_out - known.force, known.press)
    on_step()
    untouched_n = np.linalg.norm(held_out[~touched], axis=1)
    threshold = threshold_above(untouched_n) if len(untouched_n) else _THRESHOLD_UNKNOWN_N
    metrics = force_metrics(held_out[touched], known.force[touched])
    errors = force_errors(held_out[touched], known.force[touched])
    metrics["force_magnitude_p95_n"] = float(np.percentile(errors["magnitude_n"], 95.0))
    metrics["coverage_90"] = float(
        np.mean(np.abs(held_out - known.force)[touched] <= _DEVIATIONS * force_sd)
    )
    for other, estimate in (("constant", constants), ("linear", lines)):
        found = force_metrics(estimate[touched], known.force[touched])
        for key in ("force_magnitude_median_n", "force_angle_median_rad"):
            metrics[f"{other}_{key}"] = found[key]
    presses = len(np.unique(known.press[touched]))
    source = f"{len(known)} rows of {data.provenance.source}"
    # A finger that the network knows is like simulated ones, so more is known of it.
    told = net.told if isinstance(net, ToldFinger) else None
    formulas = finger_formulas(
        held_out[touched],
        known.force[touched],
        known.press[touched],
        follow=told.bounds["force_magnitude"] if told else None,
    )
    described: dict[str, str] = {}
    if told:
        formulas = (*formulas, told.bounds["contact_location"])
        described["of a contact"] = f"of the network; errors are those on {told.source}"
    digest = export_features(
        folder,
        FeaturesGraph(net, force_sd.astype(np.float32), told.contact_sd if told else None),
        known.tared[np.linspace(0, len(known) - 1, _GOLDEN_ROWS).astype(int)].astype(np.float32),
        name=name,
        version=version,
        contact_threshold_n=threshold,
        training_data_sha256=data.content_sha256(),
        trained_on=f"{data.provenance.source}: {presses} presses; measured on presses held out",
        metrics=metrics,
        normalisation={
            "estimator": estimator,
            "force_sd": f"{LEVEL:.0%} of the errors on presses held out, axis by axis, are within"
            f" {_DEVIATIONS:.3f} of it",
            **described,
        },
        training_range=TrainingRange(
            source=source,
            data_sha256=data.content_sha256(),
            rows=len(known),
            inputs=(ends_of("electrodes", "tared counts", known.tared),),
            outputs=(ends_of("force", "N", known.force),),
            combinations=True,
        ),
        known_inputs=known_inputs(known.tared.astype(np.float32), known.press),
        sensor_serials=tuple(serials),
        intervals=Intervals(
            LEVEL,
            f"{source}, each press held out in its turn",
            data.content_sha256(),
            presses,
            formulas,
        )
        if formulas
        else None,
    )
    return FingerReport(digest, estimator, metrics, presses, len(known))


STEPS = FOLDS + 1
"""How often ``train_finger`` calls ``on_step``."""


def finger_formulas(
    held_out: Floats, force: Floats, press: Rows, *, follow: BoundFormula | None = None
) -> tuple[BoundFormula, ...]:
    """Bounds of the errors of the next press; none that lies beyond every force of the presses.

    Args:
        held_out: Forces estimated without the press that is estimated [N], shape ``(N, 3)``.
        force: The true ones.
        press: Press of each row, shape ``(N,)``.
        follow: How bounds follow a frame; None = as these presses say.
    """
    found = force_errors(held_out, force)
    size = np.linalg.norm(held_out, axis=1)
    # Its own rows are its training range: they say nothing of how errors grow away from it.
    nothing = np.zeros(len(size))
    terms = terms_of(size, nothing, nothing)
    errors = {"force_magnitude": found["magnitude_n"], "force": found["vector_n"]}
    if follow is not None:
        formulas = tuple(
            widened(follow, name, error, terms, press, level=LEVEL)
            for name, error in errors.items()
        )
    else:
        formulas = fit_formulas(
            errors,
            terms,
            press,
            level=LEVEL,
            use=OF_FINGER if len(np.unique(press)) >= PRESSES_SLOPE else OF_FEW,
        )
    # Of a few presses that are unlike one another it comes out as hundreds of newtons: unknown.
    strongest_n = np.linalg.norm(force, axis=1).max()
    return tuple(one for one in formulas if np.median(bounds(one, terms)) <= strongest_n)


OF_FINGER = (True, True, False, False, False)
OF_FEW = (True, False, False, False, False)
"""Terms of a finger's bounds, and those of a few presses."""

PRESSES_SLOPE = 15
"""From so many presses on errors may grow with the force."""


def known_rows(data: FeatureDataset) -> tuple[KnownRows, npt.NDArray[np.bool_]]:
    """Rows to fit to, evenly over the presses, and which of them are touched.

    Raises:
        DatasetError: The data holds several fingers, or too few presses.
    """
    if len(data.sensor_names) > 1:
        raise DatasetError(
            f"{data.name} holds {len(data.sensor_names)} fingers: {', '.join(data.sensor_names)}",
            remedy="calibrate one finger at a time",
        )
    magnitude = np.linalg.norm(data.force, axis=1)
    touched = magnitude > 0.0 if data.in_contact is None else data.in_contact
    press = data.group if len(np.unique(data.group)) >= PRESSES_LEAST else data.block
    pieces: list[Rows] = [
        piece
        for number in np.unique(press)
        if len(piece := np.flatnonzero((press == number) & touched))
        and magnitude[piece].max() >= PRESS_N
    ]
    if len(pieces) < PRESSES_LEAST:
        raise DatasetError(
            f"{data.name} holds {len(pieces)} presses of at least {PRESS_N:g} N;"
            f" {PRESSES_LEAST} are needed",
            remedy="press the finger more often, in other places and directions; 20 are good",
        )
    untouched = np.flatnonzero(~touched & np.isin(press, [press[piece[0]] for piece in pieces]))
    free = min(len(untouched), int(UNTOUCHED_SHARE * ROWS_MOST))
    each = (ROWS_MOST - free) // len(pieces)
    kept = np.sort(np.concatenate([_evenly(untouched, free), *(_evenly(p, each) for p in pieces)]))
    rows = KnownRows(
        data.tared_counts[kept].astype(np.float64), data.force[kept].astype(np.float64), press[kept]
    )
    return rows, touched[kept]


def _evenly(rows: Rows, count: int) -> Rows:
    count = max(1, count) if len(rows) else 0
    kept: Rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int))]
    return kept


def _folds(press: Rows, count: int) -> list[npt.NDArray[np.bool_]]:
    """Rows of the presses of each part: neighbours in time, so that what drifts shows."""
    return [np.isin(press, part) for part in np.array_split(np.unique(press), count)]


def fit_finger(rows: KnownRows, rest: Floats) -> tuple[str, nn.Module]:
    """The estimator that is the best on presses held out; its name, and it itself.

    Args:
        rows: Of at least three presses.
        rest: Untouched counts, shape (19,).
    """
    errors = {name: held_out_errors(one, rows, rest) for name, one in ESTIMATORS.items()}
    best = chosen(errors, rows.force)
    return best, ESTIMATORS[best](rows, rest)


def held_out_errors(estimator: Estimator, rows: KnownRows, rest: Floats) -> Floats:
    """Errors of the forces of rows [N], each estimated without its press, shape ``(N,)``."""
    errors = np.empty(len(rows))
    for out in _folds(rows.press, CHOICES):
        estimate = estimate_of(estimator(rows.where(~out), rest), rows.tared[out])
        errors[out] = np.linalg.norm(estimate - rows.force[out], axis=1)
    return errors


def chosen(errors: Mapping[str, Floats], force: Floats) -> str:
    """The estimator with the smallest mean error; the network only where it knows the finger.

    Means are of the hardest presses, of which line and processes know nothing; there a network that
    knows nothing of the finger may still be the best.

    Args:
        errors: By estimator, as ``held_out_errors`` gives them.
        force: Of the same rows [N], shape ``(N, 3)``.
    """
    known = unlike(errors[TOLD], force) <= LIKE_SIMULATED
    return min(
        (name for name in errors if known or name != TOLD), key=lambda name: errors[name].mean()
    )


def unlike(errors: Floats, force: Floats) -> float:
    """Median of errors over 0.5 N and the force, of touched rows; see ``LIKE_SIMULATED``."""
    size = np.linalg.norm(force, axis=1)
    touched = size >= PRESS_N
    return float(np.median(errors[touched] / (PRESS_N + size[touched])))


def estimate_of(net: nn.Module, tared: Floats) -> Floats:
    """Forces [N], shape (N, 3), of tared counts (N, 19)."""
    return full_estimate_of(net, tared)[:, :3]


def full_estimate_of(net: nn.Module, tared: Floats) -> Floats:
    """All that an estimator gives, force first, of tared counts (N, 19)."""
    with torch.inference_mode():
        return np.asarray(net(torch.from_numpy(tared)).numpy())


def _force_sd(errors: Floats, press: Rows) -> Floats:
    """Per axis, so that ``LEVEL`` of the errors of the next press lie within 1.645 of it [N].

    Of few presses a larger share is taken: the next one is one more (conformal prediction).
    """
    presses = len(np.unique(press))
    level = min(1.0, LEVEL * (presses + 1) / presses)
    return np.asarray(np.quantile(np.abs(errors), level, axis=0) / _DEVIATIONS)
