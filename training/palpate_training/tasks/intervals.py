"""A bundle with bounds of its errors, from presses that its training has not seen.

The weights stay what they are, so do its answers and its metrics. From the held-out presses, if
there are enough, it also learns how the values of an input go together: what is known is then what
it was trained on and what it was measured with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.errors import BundleError, DatasetError
from palpate.files.bundle import Bundle, read_bundle, write_bundle
from palpate.files.intervals import BoundFormula, Intervals
from palpate.files.training_range import KnownInputs
from palpate_training.datasets.container import refuse_repeated
from palpate_training.datasets.experiment import MixedDataset, content_sha256, read_mixed
from palpate_training.datasets.features import (
    FeatureDataset,
    FloatArray,
    of_sensor,
    open_dataset,
    press_of,
    refuse_same_presses,
)
from palpate_training.learning.export import refuse_existing, version_of
from palpate_training.learning.field_code import in_parts
from palpate_training.learning.intervals import LEVEL, fit_formulas, terms_of
from palpate_training.learning.metrics import field_errors, force_errors, join, location_errors
from palpate_training.learning.ranges import (
    PRESSES_OF_PATTERN,
    UNLIKE,
    holds_known,
    places_of,
    with_pattern,
)
from palpate_training.tasks.evaluate import answers_of, learned_from, read_features
from palpate_training.tasks.fields import tared_counts

Floats = npt.NDArray[np.float64]
Labels = npt.NDArray[np.integer]

PRESSES_LEAST = 20
"""Of fewer presses nine tenths are not known well enough to be shipped with a bundle."""

OF_OTHERS = (True, True, False, False, False)
"""Terms of bounds for sensors that a bundle was not made for: two fingers cannot teach more."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """What a bundle makes of presses that its training has not seen.

    Attributes:
        errors: Of every row by the name of its bound, shape ``(N,)``; NaN where there is none.
        size: Of the estimate, as ``bound_terms`` takes it, shape ``(N,)``.
        tared: The bundle's inputs [counts], shape ``(N, 19)``.
        force_n: Length of the true force [N], shape ``(N,)``.
        press: Press of every row, one number over all specimens, shape ``(N,)``.
    """

    errors: Mapping[str, Floats]
    size: Floats
    tared: FloatArray
    force_n: Floats
    press: Labels

    def terms(self, known: KnownInputs, distance: Floats | None = None) -> Floats:
        """Terms of the bounds, with distances from these inputs, or with those that are given."""
        found, common = places_of(known, self.tared)
        return terms_of(self.size, common, found if distance is None else distance)


def held_out_features(bundle: Bundle, data: FeatureDataset) -> HeldOut:
    """Errors of the rows in contact; if that is not known, of those above its threshold.

    Raises:
        DatasetError: There are none.
    """
    rows = np.flatnonzero(data.touching(bundle.manifest.contact_threshold_n))
    if not len(rows):
        raise DatasetError(
            f"{data.name}: no row is in contact", remedy="take a data set with presses"
        )
    tared, truth = data.tared_counts[rows], data.force[rows]
    answers = join(answers_of(bundle, lambda part: tared[part], np.arange(len(tared))))
    force = answers["force"]
    found = force_errors(force, truth)
    size = np.linalg.norm(force.astype(np.float64), axis=1)
    errors = {"force_magnitude": found["magnitude_n"], "force": found["vector_n"]}
    if data.contact_location is not None and "contact_location" in answers:
        wanted = data.contact_location[rows]
        distance = location_errors(answers["contact_location"], wanted)["distance_m"]
        # Below its threshold a bundle gives no location.
        given = size >= bundle.manifest.contact_threshold_n
        errors["contact_location"] = np.where(given, distance, np.nan)
    return HeldOut(
        errors, size, tared, np.linalg.norm(truth.astype(np.float64), axis=1), press_of(data)[rows]
    )


def held_out_fields(bundle: Bundle, data: MixedDataset) -> HeldOut:
    """Errors of the fields of all rows."""
    tared = tared_counts(data)
    parts, sizes = [], []
    whole = np.arange(len(tared))
    found = answers_of(bundle, lambda part: tared[part], whole)
    for rows, answers in zip(in_parts(whole), found, strict=True):
        field = answers["displacement"].reshape(-1, *data.mesh.nodes.shape)
        parts.append(field_errors(field, data.displacement(rows), data.mesh.subset)["all_m"])
        coefficients = answers.get("coefficients", np.zeros((len(field), 1)))
        sizes.append(1e3 * np.linalg.norm(coefficients.astype(np.float64), axis=1))
    return HeldOut(
        {"displacement": np.concatenate(parts)},
        np.concatenate(sizes),
        tared,
        np.linalg.norm(data.experiment.force.astype(np.float64), axis=1),
        data.experiment.row_trajectory,
    )


def add_intervals(
    old: Path,
    held_out: Sequence[Path],
    out: Path,
    *,
    others: Sequence[Path] = (),
    unlike: float = UNLIKE,
) -> bytes:
    """Write a bundle again with bounds of its errors; returns its digest.

    Args:
        old: Folder of the bundle, of the task ``features`` or ``field``.
        held_out: Data sets of presses that no training has seen: of features, or for fields mixed
            ones, of the sensors that the bundle was made for. A mixed one is good for both.
        out: Folder to write; must not exist. A number is the version.
        others: Data sets of features of sensors that the bundle was not made for. Recordings of one
            sensor, by its name, count once.
        unlike: Share of the rows held out that may be flagged by how their values go together. Of
            fewer presses than ``PRESSES_OF_PATTERN`` the known inputs stay as they are.

    Raises:
        BundleError: It breaks its contract, knows no training rows, or ``out`` exists.
        DatasetError: A data set breaks its schema, holds too few presses, those of another one
            (``others`` included), or was trained on.
    """
    refuse_existing(out)
    bundle = read_bundle(old)
    manifest = bundle.manifest
    if bundle.known_inputs is None or manifest.task not in ("features", "field"):
        raise BundleError(
            f"{old}: a bundle of task {manifest.task!r} "
            + ("has no bounds" if bundle.known_inputs else "that does not know its training rows"),
            remedy="take a features or field bundle; add its training rows first with palpate train"
            " upgrade",
        )
    sets = [read_held_out(bundle, path) for path in held_out]
    sensors = _read_others(bundle, others)
    refuse_repeated(held_out, [(one.rows.tared, one.rows.force_n[:, None]) for one in sets])
    of_features = {
        str(path): one.data
        for path, one in zip(held_out, sets, strict=True)
        if one.data is not None
    }
    refuse_same_presses(
        [*of_features, *(sensor.name for sensor, _ in sensors)],
        [*of_features.values(), *(sensor for sensor, _ in sensors)],
    )
    found = joined([one.rows for one in sets])
    presses = len(np.unique(found.press))
    for path, one in zip(held_out, sets, strict=True):
        if one.sha256 in learned_from(manifest) or holds_known(bundle.known_inputs, one.rows.tared):
            raise DatasetError(
                f"{old} was trained on presses of {path}",
                remedy="take presses that no training has seen",
            )
    if presses < PRESSES_LEAST:
        raise DatasetError(
            f"{', '.join(map(str, held_out))}: {presses} presses, {PRESSES_LEAST} are needed",
            remedy="record or simulate more",
        )
    known, strange = bundle.known_inputs, None
    if presses >= PRESSES_OF_PATTERN:
        known, strange = with_pattern(known, found.tared, found.press, unlike=unlike)
    formulas = fit_formulas(found.errors, found.terms(known, strange), found.press)
    other, other_source = _of_others(known, sensors)
    intervals = Intervals(
        LEVEL,
        f"{len(found.press)} rows of {presses} presses that no training saw: "
        + "; ".join(one.source for one in sets),
        " ".join(one.sha256 for one in sets),
        presses,
        formulas,
        other,
        other_source,
    )
    return write_bundle(
        out,
        model=bundle.model,
        golden=bundle.golden,
        manifest=replace(manifest, intervals=intervals, version=version_of(out, manifest.version)),
        mesh=bundle.mesh,
        known_inputs=known,
    )


class ReadRows(NamedTuple):
    """Rows of a data set as a bundle sees them, the set's digest (hex), and what it is.

    ``data`` are its features, for a bundle of features.
    """

    rows: HeldOut
    sha256: str
    source: str
    data: FeatureDataset | None = None


def read_held_out(bundle: Bundle, path: Path) -> ReadRows:
    """What a bundle makes of a data set of features, or of a mixed one."""
    if bundle.manifest.task == "features":
        data, about, digest = read_features(path)
        rows = held_out_features(bundle, data)
        return ReadRows(rows, digest, f"{about.source} ({about.command})", data)
    mixed = read_mixed(path)
    about, digest = mixed.experiment.provenance, content_sha256(mixed)
    return ReadRows(held_out_fields(bundle, mixed), digest, f"{about.source} ({about.command})")


def joined(parts: Sequence[HeldOut]) -> HeldOut:
    """The rows of all; presses of different ones stay apart."""
    first = np.cumsum([0, *(int(part.press.max()) + 1 for part in parts)])
    press = [part.press + start for part, start in zip(parts, first, strict=False)]
    names = set.intersection(*(set(part.errors) for part in parts))
    return HeldOut(
        {
            name: np.concatenate([part.errors[name] for part in parts])
            for name in parts[0].errors
            if name in names
        },
        np.concatenate([part.size for part in parts]),
        np.concatenate([part.tared for part in parts]),
        np.concatenate([part.force_n for part in parts]),
        np.concatenate(press),
    )


def _read_others(bundle: Bundle, others: Sequence[Path]) -> list[tuple[FeatureDataset, HeldOut]]:
    """Every sensor of data sets of features, and what a bundle makes of it."""
    if others and bundle.manifest.task != "features":
        raise DatasetError(
            "no other sensor's fields are known", remedy="give other sensors for features only"
        )
    sensors = [
        of_sensor(data, name)
        for data in (open_dataset(path) for path in others)
        for name in data.sensor_names
    ]
    return [(sensor, held_out_features(bundle, sensor)) for sensor in sensors]


def _of_others(
    known: KnownInputs, sensors: Sequence[tuple[FeatureDataset, HeldOut]]
) -> tuple[tuple[BoundFormula, ...], str]:
    """Formulas of sensors that the bundle was not made for, and where they come from.

    Each sensor counts once, so with fewer than ten the bounds hold for all of them: presses of one
    are alike, and tell nothing of the next sensor. Sensors of the same name are the same sensor.
    """
    if not sensors:
        return (), ""
    names = [sensor.sensor_names[0] for sensor, _ in sensors]
    different = list(dict.fromkeys(names))
    rows = joined([part for _, part in sensors])
    number = np.repeat(
        [different.index(name) for name in names], [len(part.press) for _, part in sensors]
    )
    errors = {name: rows.errors[name] for name in ("force_magnitude", "force")}
    return (
        fit_formulas(errors, rows.terms(known), number, use=OF_OTHERS),
        f"{len(number)} rows of {', '.join(different)}, for which it was not made; another may need"
        " more",
    )
