"""The bundle of the ``features`` task: force and what only a contact has, held out by press.

Force is learned from all rows, untouched ones included, so that nothing reads as nothing; contact
location, centre of pressure and contact normal only from rows in contact. What is reported was
measured with exactly the weights that are shipped: nothing is refitted on the held-out presses
afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from palpate.errors import DatasetError
from palpate.files.intervals import Intervals
from palpate.files.training_range import KnownInputs
from palpate.messages import TrainingRange
from palpate_training.datasets.features import (
    OF_CONTACT,
    BoolArray,
    FeatureDataset,
    IndexArray,
    check_learnable,
    open_dataset,
    period_of,
    press_of,
    recording_of,
)
from palpate_training.learning import baselines
from palpate_training.learning.export import export_features, refuse_existing
from palpate_training.learning.features_net import (
    FeaturesNet,
    FeaturesNetConfig,
    FeaturesRows,
    fit_features_net,
    score_of,
)
from palpate_training.learning.graphs import FeaturesGraph
from palpate_training.learning.intervals import LEVEL, fit_formulas, terms_of
from palpate_training.learning.metrics import (
    angles,
    cluster_bootstrap,
    force_errors,
    force_metrics,
    location_errors,
    location_metrics,
    rms,
)
from palpate_training.learning.networks import predict, round_to_half, training_device
from palpate_training.learning.ranges import ends_of, known_inputs, places_of
from palpate_training.learning.splits import GUARD_S, Rows, RowSplit, by_group

FloatArray = npt.NDArray[np.float32]
OnEpoch = Callable[[str, int, int], None]
"""Called with what is trained, the epoch and the number of epochs at most."""

FEATURES_CONFIG = FeaturesNetConfig()

FALSE_CONTACT_SHARE = 0.001
"""One untouched frame in a thousand may read as contact."""

MIN_CONTACT_THRESHOLD_N = 0.05
"""No lower threshold than this, however quiet the training data [N]."""

_GOLDEN_ROWS = 64


@dataclass(frozen=True, slots=True)
class FeaturesReport:
    """What was trained.

    Attributes:
        digest: The bundle's digest, 32 bytes.
        metrics: Held-out results, as in the manifest.
        rows: Rows of train, validation and test.
        bound_presses: How many presses the bounds of its errors are of.
    """

    digest: bytes
    metrics: dict[str, float]
    rows: tuple[int, int, int]
    bound_presses: int


def train_features(
    dataset_path: Path,
    bundle_dir: Path,
    *,
    name: str = "features",
    version: int = 1,
    config: FeaturesNetConfig = FEATURES_CONFIG,
    seed: int = 0,
    serials: Sequence[str] = (),
    device: str = "cpu",
    on_epoch: OnEpoch | None = None,
) -> FeaturesReport:
    """Train, evaluate on presses that were never seen, and write the bundle.

    The seed decides the split, the weights and the order of rows; ``serials`` are those of the
    manifest, ``device`` is where it is trained: cpu, cuda, or auto = on a GPU if there is one.

    Raises:
        ConfigError: There is no GPU, but one is wanted.
        DatasetError: The data set breaks its schema, has too few presses, or never changes.
        BundleError: The folder exists, or parity fails; nothing is left on disk.
    """
    refuse_existing(bundle_dir, name)
    where = training_device(device)
    data = open_dataset(dataset_path)
    check_learnable(data)
    press = press_of(data)
    split = by_group(press, seed=seed, recording=recording_of(data), guard_rows=guard_rows(data))
    x = data.tared_counts
    of_contact = _of_contact(data)
    touched = data.touching(MIN_CONTACT_THRESHOLD_N)
    for side in (split.train, split.validation, split.test):
        if not touched[side].any():
            raise DatasetError(
                f"{dataset_path}: a side of the split has no row in contact",
                remedy="record more presses",
            )
    targets = np.hstack([data.force, *(values for _, values, _ in of_contact)])
    train, validation = (
        FeaturesRows(x[rows], targets[rows]) for rows in (split.train, split.validation)
    )
    rest = data.baseline.mean(axis=0, dtype=np.float64).astype(np.float32)

    def fit(label: str, members: int, begun: FeaturesNet | None, *, symmetric: bool) -> FeaturesNet:
        at_most = (members - (0 if begun is None else len(begun.nets))) * config.epochs
        done = 0

        def tick() -> None:
            nonlocal done
            done += 1
            if on_epoch is not None:
                on_epoch(label, done, at_most)

        return fit_features_net(
            train,
            validation,
            rest,
            symmetric=symmetric,
            begun=() if begun is None else tuple(begun.nets),  # type: ignore[arg-type]
            config=replace(config, members=members),
            seed=seed,
            on_epoch=tick,
        )

    with torch.device(where):
        # A finger may be too uneven for its mirror image to teach anything.
        plain = fit("features", 1, None, symmetric=False)
        mirrored = fit("features, mirror images", 1, None, symmetric=True)
        best = min((plain, mirrored), key=lambda one: score_of(one, validation))
        net = best
        if config.members > 1:
            net = fit("features, other members", config.members, best, symmetric=best.symmetric)
    net.cpu()
    round_to_half(net)

    validated, tested = (predict(net, x[rows]) for rows in (split.validation, split.test))
    threshold = _contact_threshold(data, validated[:, :3], split)
    metrics = _force_report(data, x, tested[:, :3], split, threshold)
    metrics["symmetric"] = float(net.symmetric)
    contact_sd: dict[str, FloatArray] = {}
    for number, (quantity, wanted, touching) in enumerate(of_contact, start=1):
        part = slice(3 * number, 3 * number + 3)
        seen, stopped, test = (
            touching[rows] for rows in (split.train, split.validation, split.test)
        )
        truth = wanted[split.validation][stopped]
        if quantity == NORMAL:
            spread = rms(angles(validated[stopped, part], truth)[:, None])
        else:
            spread = rms(validated[stopped, part] - truth)
        contact_sd[quantity] = np.asarray(spread, np.float32)
        metrics |= contact_report(
            quantity,
            x,
            wanted,
            tested[test, part],
            split.train[seen],
            split.test[test],
            press,
        )

    trained = known_inputs(x[split.train], press[split.train])
    intervals = _intervals(data, tested, split.test, threshold, trained)
    force_sd = _residual_sd(validated[:, :3], data.force[split.validation])
    graph = FeaturesGraph(net, force_sd, contact_sd)
    digest = export_features(
        bundle_dir,
        graph,
        x[split.test][np.linspace(0, len(split.test) - 1, _GOLDEN_ROWS).astype(int)],
        name=name,
        version=version,
        contact_threshold_n=threshold,
        training_data_sha256=data.content_sha256(),
        trained_on=(
            f"{data.provenance.source}: {len(split.train)} rows of"
            f" {len(np.unique(press[split.train]))} presses; tested on"
            f" {len(np.unique(press[split.test]))} other presses"
        ),
        metrics=metrics,
        normalisation={
            "inputs": "tared counts and logarithms of impedances for an assumed rest, standardised"
            " by mean and sd of the training rows, inside the graph",
            "force_sd": "constant per axis: rms residual on the validation presses",
            "of a contact": "standard deviations likewise, from rows in contact; of a normal that"
            " of its angle",
            "contact_threshold_n": f"{1 - FALSE_CONTACT_SHARE:.1%} of the untouched validation rows"
            f" are estimated below it; at least {MIN_CONTACT_THRESHOLD_N} N",
        },
        seed=seed,
        training_range=features_range(data, split.train),
        known_inputs=trained,
        sensor_serials=tuple(serials),
        intervals=intervals,
    )
    rows = (len(split.train), len(split.validation), len(split.test))
    return FeaturesReport(digest, metrics, rows, intervals.presses)


def features_range(data: FeatureDataset, rows: Rows) -> TrainingRange:
    """Range of networks that were trained on rows; contact locations of those in contact only."""
    outputs = [ends_of("force", "N", data.force[rows])]
    for quantity, values, touching in _of_contact(data):
        if quantity != NORMAL:  # a unit vector has no range that a press could leave
            where = values[rows[touching[rows]]]
            outputs.append(replace(ends_of(quantity, "m", where), length_max=0.0))
    return TrainingRange(
        source=f"{len(rows)} training rows of {data.provenance.source}",
        data_sha256=data.content_sha256(),
        rows=len(rows),
        inputs=(ends_of("electrodes", "tared counts", data.tared_counts[rows]),),
        outputs=tuple(outputs),
        combinations=True,
    )


def _intervals(
    data: FeatureDataset, estimate: FloatArray, rows: Rows, threshold: float, seen: KnownInputs
) -> Intervals:
    """Bounds of the errors, of the tested presses.

    Args:
        data: All rows.
        estimate: Of the tested rows: force, then what only a contact has, as it is trained.
        rows: The tested rows.
        threshold: Force from which there is contact [N].
        seen: Representatives of the training rows.
    """
    touching = data.touching(threshold)[rows]
    kept, estimate = rows[touching], estimate[touching]
    size = np.linalg.norm(estimate[:, :3].astype(np.float64), axis=1)
    found = force_errors(estimate[:, :3], data.force[kept])
    errors = {"force_magnitude": found["magnitude_n"], "force": found["vector_n"]}
    for number, (quantity, wanted, _) in enumerate(_of_contact(data), start=1):
        if quantity == "contact_location":
            part = estimate[:, 3 * number : 3 * number + 3]
            distance = location_errors(part, wanted[kept])["distance_m"]
            errors[quantity] = np.where(size >= threshold, distance, np.nan)
    distance, common = places_of(seen, data.tared_counts[kept])
    press = press_of(data)[kept]
    return Intervals(
        LEVEL,
        f"{len(kept)} rows of {len(np.unique(press))} presses that training has not seen, of"
        f" {data.provenance.source}",
        data.content_sha256(),
        len(np.unique(press)),
        fit_formulas(errors, terms_of(size, common, distance), press),
    )


def guard_rows(data: FeatureDataset) -> int:
    """Rows of ``GUARD_S``, of the sensor that has the most."""
    times = data.time_ns
    periods_s = (
        period_of(None if times is None else times[data.sensor == sensor])
        for sensor in np.unique(data.sensor)
    )
    return round(GUARD_S / min(periods_s))


NORMAL = "contact_normal"


def _of_contact(data: FeatureDataset) -> list[tuple[str, FloatArray, BoolArray]]:
    """Quantities that only a contact has, as far as they are known: name, values, contact."""
    # Without in_contact a data set has them in every row: it has been checked.
    touching = np.ones(len(data), np.bool_) if data.in_contact is None else data.in_contact
    known = data.arrays()
    return [(name, getattr(data, name), touching) for name in OF_CONTACT if name in known]


def _residual_sd(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    return np.asarray(rms(estimate - truth), dtype=np.float32)


def _contact_threshold(data: FeatureDataset, estimate: FloatArray, split: RowSplit) -> float:
    if data.in_contact is None or data.in_contact[split.validation].all():
        return MIN_CONTACT_THRESHOLD_N
    return threshold_above(np.linalg.norm(estimate[~data.in_contact[split.validation]], axis=1))


def threshold_above(untouched_n: npt.NDArray[np.floating]) -> float:
    """Force from which there is contact [N], by the estimated magnitudes of untouched rows [N]."""
    quantile = float(np.quantile(untouched_n, 1.0 - FALSE_CONTACT_SHARE))
    return round(max(MIN_CONTACT_THRESHOLD_N, quantile), 4)


def _force_report(
    data: FeatureDataset, x: FloatArray, estimate: FloatArray, split: RowSplit, threshold: float
) -> dict[str, float]:
    """Force metrics of the rows in contact, and how often contact itself is recognised."""
    truth = data.force[split.test]
    touching = data.touching(threshold)[split.test]
    metrics = force_metrics(estimate[touching], truth[touching])
    for model, fitted in (
        ("constant", baselines.constant(x[split.train], data.force[split.train])),
        ("linear", baselines.linear(x[split.train], data.force[split.train])),
    ):
        baseline = force_metrics(fitted.predict(x[split.test])[touching], truth[touching])
        for key in ("force_magnitude_median_n", "force_angle_median_rad"):
            metrics[f"{model}_{key}"] = baseline[key]
    errors = force_errors(estimate[touching], truth[touching])
    wanted = {key: errors[key] for key in ("magnitude_n", "angle_rad")}
    presses = press_of(data)[split.test][touching]
    ends = cluster_bootstrap(wanted, presses) if several(presses) else {}
    for key, (low, high) in ends.items():
        quantity, unit = key.split("_")
        metrics[f"force_{quantity}_median_ci95_low_{unit}"] = low
        metrics[f"force_{quantity}_median_ci95_high_{unit}"] = high
    found = np.linalg.norm(estimate, axis=1) >= threshold
    metrics["contact_found_share"] = float(np.mean(found[touching]))
    if not touching.all():
        metrics["contact_false_share"] = float(np.mean(found[~touching]))
        untouched = np.linalg.norm(estimate[~touching], axis=1)
        metrics["force_untouched_median_n"] = float(np.median(untouched))
    return metrics


def contact_report(
    quantity: str,
    x: FloatArray,
    wanted: FloatArray,
    estimate: FloatArray,
    fit_on: Rows,
    test_on: Rows,
    group: IndexArray,
) -> dict[str, float]:
    """Metrics of a location or a normal; its median beside those of the constant and the line."""
    truth = wanted[test_on]
    if quantity == NORMAL:
        headline = "normal_angle_median_rad"
        errors = angles(estimate, truth)
        metrics = {
            headline: float(np.median(errors)),
            "normal_angle_mean_rad": float(errors.mean()),
        }
    else:
        prefix = quantity.removeprefix("contact_")
        headline = f"{prefix}_distance_median_m"
        errors = location_errors(estimate, truth)["distance_m"]
        metrics = {
            name.replace("location", prefix, 1): value
            for name, value in location_metrics(estimate, truth).items()
        }
    for model, fitted in (
        ("constant", baselines.constant(x[fit_on], wanted[fit_on])),
        ("linear", baselines.linear(x[fit_on], wanted[fit_on])),
    ):
        other = fitted.predict(x[test_on])
        others = (
            angles(other, truth)
            if quantity == NORMAL
            else location_errors(other, truth)["distance_m"]
        )
        metrics[f"{model}_{headline}"] = float(np.median(others))
    if several(group[test_on]):
        ends = cluster_bootstrap({"error": errors}, group[test_on])
        stem, _, unit = headline.rpartition("_")
        metrics[f"{stem}_ci95_low_{unit}"], metrics[f"{stem}_ci95_high_{unit}"] = ends["error"]
    return metrics


def several(press: npt.NDArray[np.integer]) -> bool:
    """Whether there is more than one press, without which nothing tells how sure an error is."""
    return len(np.unique(press)) > 1
