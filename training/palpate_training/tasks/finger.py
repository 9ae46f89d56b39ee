"""A finger's own ``features`` bundle, from presses against a force/torque sensor.

The bundle estimates the force of this one finger. Which estimator it holds is chosen on presses
that are held out, and what is said of it is measured on others, held out from that choice, too. A
finger that the network of a simulated population knows best, once it is told these presses, gets
that network's contact location, centre of pressure and contact normal as well. Where other fingers
are given that were pressed before, a finger like them is estimated by them and by its own presses
together; or by them alone, before it is pressed at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from palpate.errors import DatasetError
from palpate.files.intervals import BoundFormula, Intervals
from palpate.messages import TrainingRange
from palpate_training.datasets.features import FeatureDataset, check_learnable
from palpate_training.datasets.ingest import PRESS_N, TOUCH_N
from palpate_training.learning.export import export_features, refuse_existing
from palpate_training.learning.force_process import (
    LOCALITIES,
    ForceLine,
    ForceProcesses,
    KnownRows,
)
from palpate_training.learning.graphs import FeaturesGraph
from palpate_training.learning.intervals import (
    LEVEL,
    bounds,
    fit_formulas,
    staggered,
    terms_of,
    widened,
)
from palpate_training.learning.metrics import force_errors, force_metrics
from palpate_training.learning.other_fingers import OtherFinger, OtherFingers, SharedForce
from palpate_training.learning.ranges import ends_of, known_inputs
from palpate_training.learning.told_finger import ToldFinger
from palpate_training.tasks.features import threshold_above

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.integer]

PRESSES_LEAST = 6
"""Fewer presses cannot be held out and chosen on at once."""

ROWS_MOST = 600
"""Rows that are fitted to; neighbours say nearly the same, and an estimate costs time for each."""

ROWS_OF_PRESS_LEAST = 8
"""Of so many of each press the first and the last are kept; of fewer these would be too large a
share: they are the lightest touches."""

UNTOUCHED_SHARE = 0.2
"""Share of them that is untouched, where the data has such rows."""

FOLDS = 6
"""Presses are held out in so many parts to be measured on."""

CHOICES = 3
"""Those that are left, in so many parts to choose on."""

_DEVIATIONS = 1.6449
"""``LEVEL`` of the errors shall lie within so many standard deviations, as of a normal
distribution."""

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
"""What is chosen from, where no other fingers are given."""

SHARED = "other fingers and its own presses"

LIKE_OTHERS = 0.35
"""A finger is like other ones if these alone, without a press of it, are off by no more than so
much of 0.5 N and the force, median over the rows of its presses: 0.06 to 0.24 from one LASA finger
to the other, 0.51 and more from these to simulated specimens (docs/results/calibrate.md)."""


@dataclass(frozen=True, slots=True)
class FingerReport:
    """A finger's own bundle.

    Attributes:
        digest: The bundle's digest, 32 bytes.
        estimator: Which one was chosen.
        metrics: On presses held out, as in the manifest.
        presses: How many presses it learned from.
        rows: Rows that it was fitted to.
        others: How unlike other fingers it is, as ``LIKE_OTHERS`` counts; None = none were given.
    """

    digest: bytes
    estimator: str
    metrics: dict[str, float]
    presses: int
    rows: int
    others: float | None = None


def train_finger(
    data: FeatureDataset,
    folder: Path,
    *,
    name: str,
    version: int = 1,
    serials: Sequence[str] = (),
    others: Sequence[OtherFinger] = (),
    on_step: Callable[[], None] = lambda: None,
) -> FingerReport:
    """Fit to the presses of one finger, measure on presses held out, and write the bundle.

    Args:
        data: Presses of a single finger; a press is a group, or a block where there are few groups.
        folder: Of the bundle; must not exist.
        name: Of the bundle.
        version: Of the bundle.
        serials: Serial numbers of the finger, so that no other one is taken for calibrated.
        others: Fingers that were pressed before; they count only if this finger is like them.
        on_step: Called ``STEPS`` times, for a progress bar.

    Raises:
        DatasetError: The data holds several fingers, or too few presses.
        BundleError: The folder exists, or parity fails; nothing is left on disk.
    """
    refuse_existing(folder)
    known, touched = known_rows(data)
    rest = data.baseline.mean(axis=0, dtype=np.float64)
    met = OtherFingers(others, rest) if others else None
    foreign = None if met is None else unlike_others(met, known)
    held_out = np.zeros_like(known.force)
    lines, constants = np.zeros_like(known.force), np.zeros_like(known.force)
    for out in _folds(known.press, FOLDS):
        fitted = known.where(~out)
        held_out[out] = estimate_of(fit_finger(fitted, rest, met)[1], known.tared[out])
        lines[out] = estimate_of(ForceLine(fitted), known.tared[out])
        constants[out] = fitted.force[touched[~out]].mean(axis=0)
        on_step()
    estimator, net = fit_finger(known, rest, met)
    on_step()
    rivals = {"constant": constants, "linear": lines}
    if met is not None:
        rivals["others"] = estimate_of(met, known.tared)
    presses = len(np.unique(known.press[touched]))
    source = f"{len(known)} rows of {data.provenance.source}"
    # A finger that the network knows is like simulated ones, so more is known of it.
    told = net.told if isinstance(net, ToldFinger) else None
    follow = told.bounds["force_magnitude"] if told else None
    said = HeldOutPresses.of(held_out, known, touched, rivals, follow=follow)
    if told:
        said = replace(said, formulas=(*said.formulas, told.bounds["contact_location"]))
    digest = write_finger(
        folder,
        net,
        known,
        said,
        estimator=estimator,
        source=source,
        held_out_as=f"presses held out in {FOLDS} parts",
        data_sha256=data.content_sha256(),
        contact_sd=told.contact_sd if told else None,
        normalisation={"of a contact": f"of the network; errors are those on {told.source}"}
        if told
        else {},
        name=name,
        version=version,
        sensor_serials=tuple(serials),
        trained_on=f"{data.provenance.source}: {presses} presses; measured on presses held out",
    )
    return FingerReport(digest, estimator, said.metrics, presses, len(known), foreign)


@dataclass(frozen=True, slots=True)
class HeldOutPresses:
    """What is said of a bundle, from presses that were held out.

    Attributes:
        metrics: As in the manifest.
        force_sd: Per axis, so that ``LEVEL`` of the errors of touched rows of the next press lie
            within 1.645 of it [N].
        threshold_n: Below this estimated force there is no contact [N].
        formulas: Bounds of errors.
        presses: How many presses.
    """

    metrics: dict[str, float]
    force_sd: Floats
    threshold_n: float
    formulas: tuple[BoundFormula, ...]
    presses: int

    @classmethod
    def of(
        cls,
        estimate: Floats,
        known: KnownRows,
        touched: npt.NDArray[np.bool_],
        rivals: Mapping[str, Floats],
        *,
        follow: BoundFormula | None = None,
        finger: Rows | None = None,
    ) -> HeldOutPresses:
        """From estimates of presses, each made without that press.

        Where whole fingers were left out, what is said holds on the worst of them: presses of one
        are alike, and tell nothing of the next finger.

        Args:
            estimate: Forces [N], shape ``(N, 3)``.
            known: The same rows.
            touched: Which of them are touched, shape ``(N,)``.
            rivals: What other estimators say of these rows, by name.
            follow: How bounds follow a frame; None = as these presses say.
            finger: Finger of each row, shape ``(N,)``, where whole fingers were left out.
        """
        untouched_n = np.linalg.norm(estimate[~touched], axis=1)
        truth, press = known.force[touched], known.press[touched]
        finger = np.zeros_like(press) if finger is None else finger[touched]
        off = estimate[touched] - truth
        metrics = force_metrics(estimate[touched], truth)
        errors = force_errors(estimate[touched], truth)
        metrics["force_magnitude_p95_n"] = float(np.percentile(errors["magnitude_n"], 95.0))
        metrics["coverage_90"] = _coverage(off, press, finger)
        for name, other in rivals.items():
            found = force_metrics(other[touched], truth)
            for key in ("force_magnitude_median_n", "force_angle_median_rad"):
                metrics[f"{name}_{key}"] = found[key]
        return cls(
            metrics,
            _force_sd(off, press, finger),
            threshold_above(untouched_n) if len(untouched_n) else TOUCH_N,
            finger_formulas(estimate[touched], truth, press, follow=follow, finger=finger),
            len(np.unique(press)),
        )


def write_finger(
    folder: Path,
    net: nn.Module,
    rows: KnownRows,
    said: HeldOutPresses,
    *,
    estimator: str,
    source: str,
    held_out_as: str,
    data_sha256: str,
    foreign: bool = False,
    contact_sd: Mapping[str, npt.NDArray[np.float32]] | None = None,
    normalisation: Mapping[str, str] | None = None,
    **described: Any,
) -> bytes:
    """Write the bundle of one finger, or nothing; its digest, 32 bytes.

    Args:
        folder: Of the bundle; must not exist.
        net: Tared counts ``(N, 19)`` -> force [N], and of a contact what ``contact_sd`` names.
        rows: The training range.
        said: What is said of it.
        estimator: Which kind it is, for people.
        source: Of the rows, for people.
        held_out_as: How presses were held out, for people.
        data_sha256: Content of what was learned from.
        foreign: The rows are of other fingers than the one that it is for. What is said is then
            said of sensors that it was not made for, too.
        contact_sd: As ``FeaturesGraph`` takes it.
        normalisation: More words for the manifest.
        described: Name, version and so on for the manifest, as ``export_features`` takes them.

    Raises:
        BundleError: The folder exists, or parity fails; nothing is left on disk.
    """
    golden = np.linspace(0, len(rows) - 1, _GOLDEN_ROWS).astype(int)
    bounds_of = f"{source}, {held_out_as}"
    return export_features(
        folder,
        FeaturesGraph(net, said.force_sd.astype(np.float32), contact_sd),
        rows.tared[golden].astype(np.float32),
        contact_threshold_n=said.threshold_n,
        training_data_sha256=data_sha256,
        metrics=said.metrics,
        normalisation={
            "estimator": estimator,
            "force_sd": f"{LEVEL:.0%} of the errors of touched rows of presses held out, axis by"
            f" axis, are within {_DEVIATIONS:.3f} of it",
            **(normalisation or {}),
        },
        training_range=TrainingRange(
            source=source,
            data_sha256=data_sha256,
            rows=len(rows),
            inputs=(ends_of("electrodes", "tared counts", rows.tared),),
            outputs=(ends_of("force", "N", rows.force),),
            combinations=True,
        ),
        known_inputs=known_inputs(rows.tared.astype(np.float32), rows.press),
        intervals=Intervals(
            LEVEL,
            bounds_of,
            data_sha256,
            said.presses,
            said.formulas,
            said.formulas if foreign else (),
            bounds_of if foreign else "",
        )
        if said.formulas
        else None,
        **described,
    )


STEPS = FOLDS + 1
"""How often ``train_finger`` calls ``on_step``."""


def finger_formulas(
    held_out: Floats,
    force: Floats,
    press: Rows,
    *,
    follow: BoundFormula | None = None,
    finger: Rows | None = None,
) -> tuple[BoundFormula, ...]:
    """Bounds of the errors of the next press; none that lies beyond every force of the presses.

    Args:
        held_out: Forces estimated without the press that is estimated [N], shape ``(N, 3)``.
        force: The true ones.
        press: Press of each row, shape ``(N,)``.
        follow: How bounds follow a frame; None = as these presses say.
        finger: Finger of each row, shape ``(N,)``: bounds hold on each; None = there is one.
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
    if finger is not None and len(names := np.unique(finger)) > 1:
        formulas = tuple(
            max(
                (
                    widened(one, one.name, errors[one.name][own], terms[own], press[own])
                    for own in (finger == name for name in names)
                ),
                key=lambda wide: wide.weights[0],
            )
            for one in formulas
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
        DatasetError: The data holds several fingers, too few presses, or never changes.
    """
    check_learnable(data)
    if len(data.sensor_names) > 1:
        raise DatasetError(
            f"{data.name} holds {len(data.sensor_names)} fingers: {', '.join(data.sensor_names)}",
            remedy="calibrate one finger at a time",
        )
    magnitude = np.linalg.norm(data.force, axis=1)
    touched = data.touching(TOUCH_N)
    press = data.group if len(np.unique(data.group)) >= PRESSES_LEAST else data.block
    pieces: list[Rows] = [
        piece
        for number in np.unique(press)
        if len(piece := np.flatnonzero((press == number) & touched))
        and magnitude[piece].max() >= PRESS_N
    ]
    if len(pieces) < PRESSES_LEAST:
        more = "press the finger more often, in other places and directions; 20 are good"
        never = (least := magnitude.min()) > TOUCH_N
        raise DatasetError(
            f"{data.name} holds {len(pieces)} presses of at least {PRESS_N:g} N;"
            f" {PRESSES_LEAST} are needed"
            + (f"; the force is never below {least:.2f} N" if never else ""),
            remedy="zero the force/torque sensor while nothing touches the finger, press again, and"
            " let go between presses"
            if never
            else more,
        )
    untouched = np.flatnonzero(~touched & np.isin(press, [press[piece[0]] for piece in pieces]))
    free = min(len(untouched), int(UNTOUCHED_SHARE * ROWS_MOST))
    each = (ROWS_MOST - free) // len(pieces)
    dealt = (
        [_evenly(piece, each) for piece in pieces]
        if each >= ROWS_OF_PRESS_LEAST
        else [staggered(pieces, ROWS_MOST - free)]
    )
    kept = np.sort(np.concatenate([_evenly(untouched, free), *dealt]))
    rows = KnownRows(
        data.tared_counts[kept].astype(np.float64), data.force[kept].astype(np.float64), press[kept]
    )
    return rows, touched[kept]


def _evenly(rows: Rows, count: int) -> Rows:
    kept: Rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int))]
    return kept


def _folds(press: Rows, count: int) -> list[npt.NDArray[np.bool_]]:
    """Rows of the presses of each part: neighbours in time, so that what drifts shows."""
    return [np.isin(press, part) for part in np.array_split(np.unique(press), count)]


def fit_finger(
    rows: KnownRows, rest: Floats, others: OtherFingers | None = None
) -> tuple[str, nn.Module]:
    """The estimator that is the best on presses held out; its name, and it itself.

    Other fingers that the finger is like come first, whatever presses held out say: these are
    neighbours in time of those that were learned from, and so flatter what learned from no others.

    Args:
        rows: Of at least three presses.
        rest: Untouched counts, shape (19,).
        others: What other fingers taught, for this one.
    """
    errors = {name: held_out_errors(one, rows, rest) for name, one in ESTIMATORS.items()}
    best = chosen(errors, rows.force)
    if others is not None and unlike_others(others, rows) <= LIKE_OTHERS:
        shared = partial(SharedForce, others)
        if best != TOLD or held_out_errors(shared, rows, rest).mean() < errors[TOLD].mean():
            return SHARED, shared(rows, rest)
    return best, ESTIMATORS[best](rows, rest)


def unlike_others(others: OtherFingers, rows: KnownRows) -> float:
    """How unlike other fingers a finger is, of whose presses they know nothing: ``LIKE_OTHERS``."""
    estimate = estimate_of(others, rows.tared)
    return unlike(np.linalg.norm(estimate - rows.force, axis=1), rows.force)


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


def _coverage(errors: Floats, press: Rows, finger: Rows) -> float:
    """Share of the errors within intervals that errors of other fingers, or presses, gave."""
    within = np.zeros(errors.shape, np.bool_)
    fingers = len(np.unique(finger))
    for out in _folds(press, FOLDS) if fingers == 1 else _folds(finger, fingers):
        force_sd = _force_sd(errors[~out], press[~out], finger[~out])
        within[out] = np.abs(errors[out]) <= _DEVIATIONS * force_sd
    return float(within.mean())


def _force_sd(errors: Floats, press: Rows, finger: Rows) -> Floats:
    """Per axis, so that ``LEVEL`` of the errors of the next press lie within 1.645 of it [N].

    Of few presses a larger share is taken: the next one is one more (conformal prediction). Of
    several fingers it is that of the worst.
    """
    found = []
    for own in (finger == name for name in np.unique(finger)):
        presses = len(np.unique(press[own]))
        level = min(1.0, LEVEL * (presses + 1) / presses)
        found.append(np.quantile(np.abs(errors[own]), level, axis=0))
    return np.asarray(np.max(found, axis=0) / _DEVIATIONS)
