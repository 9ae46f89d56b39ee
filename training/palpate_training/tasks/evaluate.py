"""Errors of a bundle on a data set: of any bundle, on any rows whose truth is known.

What a manifest reports was measured once, on presses that were drawn from those of the training.
Here the same weights answer rows of another experiment, or of another sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.files.bundle import Bundle, read_bundle
from palpate.files.hdf5 import schema_of
from palpate.files.manifest import Manifest
from palpate_training.datasets.container import Provenance, refuse_repeated
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    MixedDataset,
    content_sha256,
    read_mixed,
)
from palpate_training.datasets.export import features
from palpate_training.datasets.features import (
    FEATURES_SCHEMA,
    OF_CONTACT,
    FeatureDataset,
    FloatArray,
    open_dataset,
    press_of,
    refuse_same_presses,
)
from palpate_training.learning.contact_code import spread_forces_in_parts
from palpate_training.learning.export import session_of
from palpate_training.learning.field_code import in_parts
from palpate_training.learning.metrics import (
    FORCE_BINS_N,
    Labels,
    Statistic,
    angles,
    cluster_bootstrap,
    contact_errors,
    electrode_errors,
    field_errors,
    force_errors,
    join,
    root_mean,
)
from palpate_training.learning.ranges import holds_known
from palpate_training.learning.splits import Rows
from palpate_training.tasks.features import NORMAL, several
from palpate_training.tasks.fields import tared_counts

Floats = npt.NDArray[np.float64]

BINS_N = {"all": (0.0, np.inf), **FORCE_BINS_N, "from_2n": (2.0, np.inf)}
"""The force [N] of the rows that a figure is of."""

DRAWS = 500
"""Of whole presses, for a confidence interval."""


class _Kind(NamedTuple):
    """Unit of an error, and the number that is made of those of many rows."""

    unit: str
    statistic: str
    of: Statistic


def _median(values: Floats) -> float:
    return float(np.nanmedian(values)) if np.isfinite(values).any() else float("nan")


def _mean(values: Floats) -> float:
    return float(np.mean(values))


KINDS = {
    "force_magnitude": _Kind("N", "median", _median),
    "force_magnitude_over_norm": _Kind("1", "median", _median),
    "force_angle": _Kind("rad", "median", _median),
    "contact_location": _Kind("m", "median", _median),
    "centre_of_pressure": _Kind("m", "median", _median),
    NORMAL: _Kind("rad", "median", _median),
    "displacement_128_nodes": _Kind("m", "mean", _mean),
    "displacement": _Kind("m", "mean", _mean),
    "contact_force_misplaced": _Kind("1", "median", _median),
    "electrodes": _Kind("counts", "root mean square", root_mean),
}
"""By the name of the error; ``learning.metrics`` defines them. ``displacement`` is the mean over
all nodes, ``contact_force_misplaced`` the share of the force that is on other nodes or turned."""

SHOWN = {"m": ("mm", 1e3), "1": ("%", 100.0)}
"""What people read instead of an SI unit, and the factor to it."""


class Figure(NamedTuple):
    """One error of a bundle.

    Attributes:
        name: What of, in ``KINDS``.
        where: Force of the rows, in ``BINS_N``.
        rows: How many.
        presses: Of how many presses.
        value: The error; NaN if no row has it.
        low: Lower end of its 95 % confidence interval, presses drawn with replacement; NaN of a
            single press.
        high: Upper end.
        constant: The same of a constant, the mean of the true values of these very rows; NaN for
            fields and electrodes.
        zero: The same of no force, no displacement and unchanged electrodes; NaN for what cannot be
            zero: angles and places.
    """

    name: str
    where: str
    rows: int
    presses: int
    value: float
    low: float
    high: float
    constant: float
    zero: float


@dataclass(frozen=True, slots=True)
class BundleErrors:
    """What a bundle makes of data sets.

    Attributes:
        bundle: Name and version.
        sha256: Digest of the bundle, hex.
        task: Of the bundle.
        data: Source and digest (hex) of each data set.
        rows: Of all data sets, those that are not in contact left out.
        presses: Which these rows are of.
        figures: By name and force.
        trained_on: Whether a data set holds presses that the bundle was trained on.
        training: What it was trained on, one line for people.
        assumed_contact_n: Force above which rows of a data set without ``in_contact`` count as in
            contact [N]; None where every data set has it, or where all rows count.
    """

    bundle: str
    sha256: str
    task: str
    data: tuple[tuple[str, str], ...]
    rows: int
    presses: int
    figures: tuple[Figure, ...]
    trained_on: bool
    training: str
    assumed_contact_n: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """For a JSON file: SI units, None where a number is not known."""

        def number(value: float) -> float | None:
            return float(f"{value:.5g}") if np.isfinite(value) else None

        return {
            "schema": "palpate.evaluation 1",
            "bundle": self.bundle,
            "sha256": self.sha256,
            "task": self.task,
            "data": [{"source": source, "sha256": digest} for source, digest in self.data],
            "trained_on": self.trained_on,
            "assumed_contact_n": self.assumed_contact_n,
            "rows": self.rows,
            "presses": self.presses,
            "figures": [
                {
                    "name": one.name,
                    "unit": KINDS[one.name].unit,
                    "statistic": KINDS[one.name].statistic,
                    "where": one.where,
                    "rows": one.rows,
                    "presses": one.presses,
                    "value": number(one.value),
                    "ci95": [number(one.low), number(one.high)],
                    "constant": number(one.constant),
                    "zero": number(one.zero),
                }
                for one in self.figures
            ],
        }


@dataclass(frozen=True, slots=True)
class _Errors:
    """Errors of every row by name, of the bundle and of nothing; force [N] and press of each.

    ``truth`` holds what a constant is made of, by the name of the output: empty for fields and
    electrodes.
    """

    found: Mapping[str, Floats]
    zero: Mapping[str, Floats]
    truth: Mapping[str, FloatArray]
    force_n: Floats
    press: Labels


def evaluate(folder: Path, paths: Sequence[Path], *, unit: str | None = None) -> BundleErrors:
    """Errors of a bundle on the rows in contact of data sets, by the force of the row.

    Args:
        folder: Of the bundle.
        paths: Data sets: of features or mixed for the task ``features``, mixed for the others.
        unit: Rows of this specimen or sensor alone; for the task ``synthesis`` it must be given.

    Raises:
        BundleError: The bundle breaks its contract.
        DatasetError: A data set breaks its schema, has no such rows, or the same as another one;
            or no unit is given.
    """
    bundle = read_bundle(folder)
    manifest = bundle.manifest
    if manifest.task == "synthesis" and unit is None:
        raise DatasetError(
            f"{folder} synthesises the electrodes of one specimen",
            remedy="say which with --unit; its model card does",
        )
    about: list[tuple[str, str]] = []
    digests: set[str] = set()
    parts: list[_Errors] = []
    sets: list[FeatureDataset] = []
    given: list[tuple[FloatArray, FloatArray]] = []
    inputs: list[FloatArray] = []
    assumed_n = None
    for path in paths:
        if manifest.task == "features":
            data, provenance, digest = read_features(path)
            if data.in_contact is None:
                assumed_n = manifest.contact_threshold_n
            sets.append(data)
            digests.add(data.content_sha256())  # of a mixed file, whose features were learned from
            rows = _rows_of_sensor(bundle, data, unit, path)
            inputs.append(data.tared_counts[rows])
            parts.append(_of_features(bundle, data, rows))
        else:
            mixed = read_mixed(path)
            _check_mesh(bundle, mixed, path)
            experiment = mixed.experiment
            given.append((experiment.tared, experiment.force))
            provenance, digest = experiment.provenance, content_sha256(mixed)
            rows = _rows_of_unit(experiment, unit, path)
            inputs.append(tared_counts(mixed)[rows])
            of = _of_field if manifest.task == "field" else _of_synthesis
            parts.append(of(bundle, mixed, rows))
        about.append((provenance.source, digest))
        digests.add(digest)
    refuse_same_presses(paths, sets)
    refuse_repeated(paths, given)
    errors = _joined(parts)
    known = bundle.known_inputs
    return BundleErrors(
        bundle=f"{manifest.name} {manifest.version}",
        sha256=bundle.sha256.hex(),
        task=manifest.task,
        data=tuple(about),
        rows=len(errors.press),
        presses=len(np.unique(errors.press)),
        figures=tuple(_figures(errors)),
        trained_on=not digests.isdisjoint(learned_from(manifest))
        # A part of the training, or a copy of it, has another digest.
        or (known is not None and any(holds_known(known, tared) for tared in inputs)),
        training=manifest.trained_on,
        assumed_contact_n=assumed_n,
    )


def _check_mesh(bundle: Bundle, data: MixedDataset, path: Path) -> None:
    if bundle.manifest.mesh_sha256 != data.mesh.sha256:
        raise DatasetError(
            f"{path} has the mesh {data.mesh.sha256[:12]}, {bundle.manifest.name} is for "
            f"{bundle.manifest.mesh_sha256[:12]}",
            remedy="take a data set of the mesh that the bundle was trained on",
        )


LOCATION_DATA = "location_data_sha256"
"""Key of ``normalisation``: digests of the data sets that the location was freed of errors by."""


def learned_from(manifest: Manifest) -> set[str]:
    """Digests of the data sets that a bundle learned from, hex."""
    more = str(manifest.normalisation.get(LOCATION_DATA, "")).split()
    return {manifest.training_data_sha256, *more}


def read_features(path: Path) -> tuple[FeatureDataset, Provenance, str]:
    """Rows of features of a file of features or of a mixed one; the file's origin and digest (hex).

    Raises:
        DatasetError: It breaks its schema.
    """
    if schema_of(path, extra="training") == FEATURES_SCHEMA.name:
        data = open_dataset(path)
        return data, data.provenance, data.content_sha256()
    mixed = read_mixed(path)
    return features(mixed), mixed.experiment.provenance, content_sha256(mixed)


def _rows_of_sensor(bundle: Bundle, data: FeatureDataset, unit: str | None, path: Path) -> Rows:
    kept = data.touching(bundle.manifest.contact_threshold_n)
    if unit is not None:
        kept = kept & np.isin(data.sensor, _number(unit, data.sensor_names, path))
    return _some(np.flatnonzero(kept), path)


def _rows_of_unit(data: ExperimentDataset, unit: str | None, path: Path) -> Rows:
    if unit is None:
        return np.arange(len(data.trial))
    number = _number(unit, data.unit_names, path)
    return _some(np.flatnonzero(np.isin(data.trial_unit[data.trial], number)), path)


def _number(unit: str, names: Sequence[str], path: Path) -> int:
    if unit not in names:
        raise DatasetError(
            f"{path}: no {unit!r} in it", remedy=f"it holds {', '.join(names)}: take one of these"
        )
    return list(names).index(unit)


def _some(rows: Rows, path: Path) -> Rows:
    if not len(rows):
        raise DatasetError(f"{path}: no row is in contact", remedy="take a data set with presses")
    return rows


def _of_features(bundle: Bundle, data: FeatureDataset, rows: Rows) -> _Errors:
    tared = data.tared_counts[rows]
    answers = join(answers_of(bundle, lambda part: tared[part], np.arange(len(rows))))
    truth = {"force": data.force[rows]}
    for name in OF_CONTACT:
        wanted = getattr(data, name)
        if wanted is not None and name in answers:
            truth[name] = wanted[rows]
    force_n = np.linalg.norm(truth["force"].astype(np.float64), axis=1)
    return _Errors(
        _feature_errors(answers, truth),
        {"force_magnitude": force_n},
        truth,
        force_n,
        press_of(data)[rows],
    )


def _feature_errors(
    estimate: Mapping[str, FloatArray], truth: Mapping[str, FloatArray]
) -> dict[str, Floats]:
    """Errors of every row by name; arrays by the name of the output, ``(N, 3)`` each."""
    force = force_errors(estimate["force"], truth["force"])
    found = {
        "force_magnitude": force["magnitude_n"],
        "force_magnitude_over_norm": force["magnitude_over_norm"],
        "force_angle": force["angle_rad"],
    }
    for name in OF_CONTACT:
        if name in truth:
            found[name] = (
                angles(estimate[name], truth[name])
                if name == NORMAL
                else np.linalg.norm(estimate[name].astype(np.float64) - truth[name], axis=1)
            )
    return found


def _mean_of_rows(wanted: FloatArray) -> FloatArray:
    """The mean of the rows that are known, in every row; NaN if none is."""
    known = wanted[np.isfinite(wanted).all(axis=1)]
    mean = known.mean(axis=0, dtype=np.float64) if len(known) else np.full(3, np.nan)
    return np.broadcast_to(mean.astype(wanted.dtype), wanted.shape)


def _of_field(bundle: Bundle, data: MixedDataset, rows: Rows) -> _Errors:
    tared = tared_counts(data)
    found: list[dict[str, Floats]] = []
    zero: list[dict[str, Floats]] = []
    subset, nodes = data.mesh.subset, data.mesh.nodes
    outputs = [tensor.name for tensor in bundle.manifest.outputs]
    known = "contact_force" in outputs and data.contact is not None
    forces = spread_forces_in_parts(data, rows) if known else None
    for part, answers in zip(
        in_parts(rows), answers_of(bundle, lambda part: tared[part], rows), strict=True
    ):
        truth = data.displacement(part)
        each = {
            "net": answers["displacement"].reshape(-1, *nodes.shape),
            "none": np.zeros_like(truth),
        }
        for name, into in (("net", found), ("none", zero)):
            errors = field_errors(each[name], truth, subset)
            into.append(
                {"displacement_128_nodes": errors["subset_m"], "displacement": errors["all_m"]}
            )
        if forces is not None:
            wanted = next(forces)
            estimate = answers["contact_force"].reshape(len(part), -1, 3)[:, data.mesh.outer_nodes]
            for force, into in ((estimate, found), (np.zeros_like(wanted), zero)):
                into[-1]["contact_force_misplaced"] = contact_errors(force, wanted)["misplaced"]
    return _Errors(join(found), join(zero), {}, *_force_and_press(data.experiment, rows))


def _of_synthesis(bundle: Bundle, data: MixedDataset, rows: Rows) -> _Errors:
    truth = tared_counts(data)[rows]
    answers = join(
        answers_of(bundle, lambda part: data.displacement(part).reshape(len(part), -1), rows)
    )
    found, zero = (
        {"electrodes": electrode_errors(estimate, truth)["mean_square"]}
        for estimate in (answers["tared_counts"], np.zeros_like(truth))
    )
    return _Errors(found, zero, {}, *_force_and_press(data.experiment, rows))


def _force_and_press(data: ExperimentDataset, rows: Rows) -> tuple[Floats, Labels]:
    return np.linalg.norm(data.force[rows].astype(np.float64), axis=1), data.row_trajectory[rows]


def answers_of(
    bundle: Bundle, inputs: Callable[[Rows], FloatArray], rows: Rows
) -> Iterator[dict[str, FloatArray]]:
    """Outputs of a bundle's model by name, for each part of the rows."""
    session = session_of(bundle.model)
    names = [tensor.name for tensor in bundle.manifest.outputs]
    (given,) = bundle.manifest.inputs
    for part in in_parts(rows):
        found = session.run(names, {given.name: np.asarray(inputs(part), np.float32)})
        yield dict(zip(names, found, strict=True))


def _joined(parts: Sequence[_Errors]) -> _Errors:
    """Rows of all data sets; a quantity that one of them does not know is left out."""
    first = np.cumsum([0, *(int(part.press.max()) + 1 for part in parts)])

    def whole(of: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        names = [name for name in of[0] if all(name in part for part in of)]
        return {name: np.concatenate([part[name] for part in of]) for name in names}

    return _Errors(
        whole([part.found for part in parts]),
        whole([part.zero for part in parts]),
        whole([part.truth for part in parts]),
        np.concatenate([part.force_n for part in parts]),
        np.concatenate([part.press + start for part, start in zip(parts, first, strict=False)]),
    )


def _figures(errors: _Errors) -> Iterator[Figure]:
    for where, (low, high) in BINS_N.items():
        rows = np.flatnonzero((errors.force_n >= low) & (errors.force_n < high))
        if not len(rows):
            continue
        press = errors.press[rows]
        truth = {name: of_all[rows] for name, of_all in errors.truth.items()}
        mean = {name: _mean_of_rows(wanted) for name, wanted in truth.items()}
        constant = _feature_errors(mean, truth) if truth else {}
        for name, found in errors.found.items():
            statistic = KINDS[name].of
            # Of a single press nobody knows how far the next one is off.
            ends = (
                cluster_bootstrap({name: found[rows]}, press, statistic=statistic, draws=DRAWS)
                if several(press)
                else {name: (float("nan"), float("nan"))}
            )
            yield Figure(
                name,
                where,
                len(rows),
                len(np.unique(press)),
                statistic(found[rows]),
                *ends[name],
                statistic(constant[name]) if name in constant else float("nan"),
                statistic(errors.zero[name][rows]) if name in errors.zero else float("nan"),
            )
