"""Train one field or synthesis network, test it on held-out trajectories, write its bundle.

What is reported was measured with exactly the weights that are shipped. The field network that
ships is by default one for all units of the data set, since a finger that asks is none of them; the
synthesis network speaks for one named unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from palpate.errors import BundleError
from palpate_training.datasets.experiment import MixedDataset, content_sha256
from palpate_training.learning.export import export_bundle
from palpate_training.learning.field_code import FieldCode
from palpate_training.learning.metrics import (
    electrode_errors,
    electrode_summary,
    field_summary,
    rms,
)
from palpate_training.learning.networks import FieldGraph, SynthesisGraph
from palpate_training.learning.splits import Held, Rows, by_trajectory, of_units, unit_sets
from palpate_training.tasks.field_fit import (
    FitConfig,
    fit_field,
    fit_synthesis,
    synthesis_features,
    tared_counts,
)
from palpate_training.tasks.fields import field_row_errors

FloatArray = npt.NDArray[np.float32]
OnEpoch = Callable[[], None]

PARITY_ROWS = 24
"""Held-out rows of the parity check, spread over the test trajectories."""

_CHUNK_ROWS = 256


def field_bundle(
    data: MixedDataset,
    folder: Path,
    *,
    units: Sequence[str] = (),
    name: str = "field",
    version: int = 1,
    config: FitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> dict[str, float]:
    """Electrodes -> field, as a bundle.

    Args:
        data: The mixed data set.
        folder: Folder of the bundle; must not exist.
        units: Units to train and to test on; empty = all.
        name: Name of the bundle.
        version: Its version, from 1.
        config: Settings of the training.
        seed: Seed of split and weights.
        on_epoch: Called after each epoch.

    Returns:
        The held-out metrics in the manifest.

    Raises:
        DatasetError: A unit is not known, or too few trajectories are left.
        BundleError: The folder exists, or parity fails; nothing is left on disk.
    """
    _refuse_existing(folder)
    split = by_trajectory(data.experiment, seed=seed)
    held = of_units(data.experiment, split, units or unit_sets(data.experiment)[-1])
    model = fit_field(data, held, config=config, seed=seed, on_epoch=on_epoch)
    code, counts = model.code, tared_counts(data)

    def estimate(rows: Rows) -> FloatArray:
        return code.decode(model.coefficients(counts[rows]))

    errors = field_row_errors(
        data,
        held.split.test,
        {
            "zero": [lambda rows: np.zeros((len(rows), *data.mesh.nodes.shape), np.float32)],
            "net": [estimate],
        },
    )
    metrics = field_summary(errors["net"][0], errors["zero"][0])
    metrics["zero_nodal_subset_m"] = float(errors["zero"][0]["subset_m"].mean())
    untouched = code.decode(model.coefficients(np.zeros((1, counts.shape[1]), np.float32)))
    metrics["untouched_nodal_all_m"] = float(np.linalg.norm(untouched, axis=2).mean())
    metrics |= _truncation(code)
    export_bundle(
        folder,
        FieldGraph(model.net, code, _node_sd(data, held.split.validation, estimate)),
        counts[_spread(held.split.test)],
        data.mesh,
        name=name,
        version=version,
        training_data_sha256=content_sha256(data),
        trained_on=_trained_on(data, held),
        metrics=metrics,
        normalisation={
            "electrodes": "standardised by the training rows, inside the graph",
            "displacement": f"{code.size} modes of the training rows, half precision in the graph",
            "displacement_sd": "constant per node: rms length of the error on validation rows",
        },
    )
    return metrics


def synthesis_bundle(
    data: MixedDataset,
    folder: Path,
    *,
    unit: str,
    name: str = "synthesis",
    version: int = 1,
    config: FitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> dict[str, float]:
    """Field -> electrodes of one unit, as a bundle; the arguments are those of ``field_bundle``."""
    _refuse_existing(folder)
    held = of_units(data.experiment, by_trajectory(data.experiment, seed=seed), [unit])
    model = fit_synthesis(data, held, config=config, seed=seed, on_epoch=on_epoch)
    counts = tared_counts(data)
    features = synthesis_features(data, model.code, model.pooling)
    test, validation = held.split.test, held.split.validation
    zero = electrode_errors(np.zeros_like(counts[test]), counts[test])
    metrics = electrode_summary(electrode_errors(model.counts(features[test]), counts[test]), zero)
    residual = model.counts(features[validation]) - counts[validation]
    sd = np.asarray(rms(residual), np.float32)
    graph = SynthesisGraph(model.net, model.code, model.pooling, sd)
    with torch.inference_mode():
        untouched = graph(torch.zeros(1, 3 * model.code.nodes))[0].numpy()
    metrics["untouched_max_counts"] = float(np.abs(untouched).max())
    metrics |= _truncation(model.code)
    rows = _spread(test)
    export_bundle(
        folder,
        graph,
        data.displacement(rows).reshape(len(rows), -1),
        data.mesh,
        name=name,
        version=version,
        training_data_sha256=content_sha256(data),
        trained_on=_trained_on(data, held),
        metrics=metrics,
        normalisation={
            "displacement": f"projected on {model.code.size} modes and pooled near 23 electrodes,"
            " inside the graph",
            "tared_counts_sd": "constant per electrode: rms residual on validation rows",
        },
    )
    return metrics


def _refuse_existing(folder: Path) -> None:
    if folder.exists():  # say so before minutes of training, not after
        raise BundleError(
            f"{folder} exists and bundles are immutable", remedy="write the next version"
        )


def _truncation(code: FieldCode) -> dict[str, float]:
    return {"modes": float(code.size), "truncation_nodal_all_m": code.truncation_m[code.size]}


def _spread(rows: Rows) -> Rows:
    """Rows over the whole test set; at most as many as the parity check takes."""
    chosen: Rows = rows[np.unique(np.linspace(0, len(rows) - 1, PARITY_ROWS).astype(int))]
    return chosen


def _node_sd(data: MixedDataset, rows: Rows, estimate: Callable[[Rows], FloatArray]) -> FloatArray:
    total = np.zeros(len(data.mesh.nodes))
    for start in range(0, len(rows), _CHUNK_ROWS):
        part = rows[start : start + _CHUNK_ROWS]
        total += np.square(estimate(part) - data.displacement(part)).sum(axis=(0, 2))
    return np.asarray(np.sqrt(total / len(rows)), np.float32)


def _trained_on(data: MixedDataset, held: Held) -> str:
    def presses(rows: Rows) -> int:
        return len(np.unique(data.experiment.row_trajectory[rows]))

    split = held.split
    return (
        f"{data.experiment.provenance.source}: {', '.join(held.units)}; {len(split.train)} rows of"
        f" {presses(split.train)} trajectories, tested on {presses(split.test)} others"
    )
