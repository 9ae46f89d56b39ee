"""Displacement field of the skin -> electrodes of one specimen: train, test, ship.

The bundle's contract takes a field and nothing else, and specimens differ, so there is one network
for each and none for all. The network sees the coefficients of the field's modes and the film under
the skin near each electrode, both linear in the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from palpate.anatomy import ELECTRODE_MIRROR
from palpate.messages import TrainingRange
from palpate_training.datasets.experiment import MixedDataset, content_sha256
from palpate_training.datasets.features import ELECTRODES
from palpate_training.learning.export import export_fields, refuse_existing
from palpate_training.learning.field_code import FieldCode, fit_code
from palpate_training.learning.film import (
    MIRRORED_FILM,
    SMALLEST_MODE,
    FilmNet,
    FilmPooling,
    pooling,
)
from palpate_training.learning.fit import OnEpoch
from palpate_training.learning.graphs import SynthesisGraph
from palpate_training.learning.metrics import (
    by_force,
    electrode_errors,
    electrode_summary,
    rms,
    root_mean,
)
from palpate_training.learning.networks import (
    device_of,
    predict,
    round_to_half,
    training_device,
)
from palpate_training.learning.ranges import ends_of, longest_of
from palpate_training.learning.splits import Rows, RowSplit, by_trajectory, of_units
from palpate_training.tasks.fields import (
    FieldFitConfig,
    fields_of,
    fit_on_norms,
    rest_counts,
    spread_rows,
    tared_counts,
    trained_on_line,
    truncation_metrics,
)

FloatArray = npt.NDArray[np.float32]

MODE_COUNTS = (8, 16, 24, 32, 48, 64)
"""Fewer than of a field that is estimated: what lies near an electrode is in the pooled film."""


@dataclass(frozen=True, slots=True)
class SynthesisModel:
    """Field -> electrodes.

    Attributes:
        net: Coefficients and pooled film (N, K + P) -> tared counts (N, 19).
        code: What they are coefficients of.
        pooling: How the film is pooled.
    """

    net: FilmNet
    code: FieldCode
    pooling: FilmPooling

    def counts(self, features: FloatArray) -> FloatArray:
        """Tared counts (N, 19) of features (N, K + P) from ``synthesis_features``."""
        return predict(self.net, features)


def synthesis_features(data: MixedDataset, code: FieldCode, film: FilmPooling) -> FloatArray:
    """What the shipped graph makes of every row's field [m], shape (N, K + P), without the field.

    Projection and pooling are linear in the field and the field is linear in the data set's
    coefficients, so two small matrices do.
    """
    modes, mean = data.basis.modes, data.basis.mean[None]
    lead = _features(np.concatenate([modes + mean, mean]), code, film)
    return np.asarray(data.coefficients @ (lead[:-1] - lead[-1]) + lead[-1], np.float32)


def _features(displacement: FloatArray, code: FieldCode, film: FilmPooling) -> FloatArray:
    flat = displacement.reshape(len(displacement), -1)
    return np.hstack([code.project(flat), film.pool(displacement)])


def fit_synthesis(
    data: MixedDataset,
    split: RowSplit,
    *,
    config: FieldFitConfig | None = None,
    seed: int = 0,
    on_epoch: OnEpoch | None = None,
) -> SynthesisModel:
    """Train field -> electrodes; the arguments are those of ``fit_field``."""
    config = config or FieldFitConfig()
    code = fit_code(data, split.train, split.validation, mode_counts=MODE_COUNTS)
    film = pooling(data.mesh)
    x, y = synthesis_features(data, code, film), tared_counts(data)
    rest = rest_counts(data, split.train)
    given, wanted = x[split.train], y[split.train]
    frame = FilmNet([], code.size, film.rest_m, rest)
    if code.signs is not None:
        signs = np.concatenate([code.signs, np.ones(len(film.rest_m), np.float32)])
        order = np.concatenate([np.arange(code.size), code.size + MIRRORED_FILM])
        falls = frame.fall_of(torch.from_numpy(wanted))[:, ELECTRODE_MIRROR]
        given = np.vstack([given, given[:, order] * signs])
        wanted = np.vstack([wanted, frame.counts_of(falls).numpy()])
    wide = frame.widen(torch.from_numpy(given)).numpy()
    falls = frame.fall_of(torch.from_numpy(wanted))
    zero = _features(np.zeros((1, *data.mesh.nodes.shape), np.float32), code, film)
    still = config.rest_rows(len(wanted))
    untouched = np.repeat(frame.widen(torch.from_numpy(zero)).numpy(), still, axis=0)
    members = []
    for member in range(config.members):
        torch.manual_seed(1000 * seed + member)
        layers = config.member(wide.shape[1], ELECTRODES)
        layers.normalise_from(wide, falls.numpy())
        modes = layers.input_sd[: code.size]
        modes.clamp_(min=SMALLEST_MODE * float(modes.max()))
        net = FilmNet([layers], code.size, film.rest_m, rest)
        fit_on_norms(
            net,
            layers,
            np.vstack([wide, untouched]),
            np.vstack([wanted, np.zeros((still, ELECTRODES), np.float32)]),
            (x[split.validation], y[split.validation]),
            scale=1.0 / math.sqrt(ELECTRODES),
            floor=1.0,
            config=config,
            estimate_of=net.counts_of,
            on_epoch=on_epoch,
        )
        members.append(layers)
    whole = FilmNet(members, code.size, film.rest_m, rest).to(device_of(members[0])).eval()
    return SynthesisModel(whole, code, film)


def synthesis_bundle(
    data: MixedDataset,
    folder: Path,
    *,
    unit: str,
    name: str = "synthesis",
    version: int = 1,
    config: FieldFitConfig | None = None,
    seed: int = 0,
    device: str = "cpu",
    on_epoch: OnEpoch | None = None,
) -> dict[str, float]:
    """Field -> electrodes of one unit, as a bundle; the arguments are those of ``field_bundle``."""
    refuse_existing(folder, name)
    where = training_device(device)
    split = of_units(data.experiment, by_trajectory(data.experiment, seed=seed), [unit])
    with torch.device(where):
        model = fit_synthesis(data, split, config=config, seed=seed, on_epoch=on_epoch)
    round_to_half(model.net.cpu())
    counts = tared_counts(data)
    features = synthesis_features(data, model.code, model.pooling)
    test, validation = split.test, split.validation
    zero = electrode_errors(np.zeros_like(counts[test]), counts[test])
    errors = electrode_errors(model.counts(features[test]), counts[test])
    metrics = electrode_summary(errors, zero)
    force_n = np.linalg.norm(data.experiment.force[test].astype(np.float64), axis=1)
    metrics |= by_force("electrode_rmse_counts", errors["mean_square"], force_n, root_mean)
    residual = model.counts(features[validation]) - counts[validation]
    sd = np.asarray(rms(residual), np.float32)
    graph = SynthesisGraph(model.net, model.code, model.pooling, sd)
    with torch.inference_mode():
        untouched = graph(torch.zeros(1, 3 * model.code.nodes))[0].numpy()
    metrics["untouched_max_counts"] = float(np.abs(untouched).max())
    metrics |= truncation_metrics(model.code)
    rows = spread_rows(test)
    export_fields(
        folder,
        graph,
        data.displacement(rows).reshape(len(rows), -1),
        data.mesh,
        name=name,
        version=version,
        training_data_sha256=content_sha256(data),
        trained_on=trained_on_line(data, [unit], split),
        metrics=metrics,
        normalisation={
            "displacement": f"projected on {model.code.size} modes and pooled near 23 electrodes,"
            " inside the graph",
            "tared_counts_sd": "constant per electrode: rms residual on validation rows",
        },
        training_range=synthesis_range(data, split.train),
    )
    return metrics


def synthesis_range(data: MixedDataset, rows: Rows) -> TrainingRange:
    """Range of a synthesis network that was trained on rows."""
    return TrainingRange(
        source=f"{len(rows)} training rows of {data.experiment.provenance.source}",
        data_sha256=content_sha256(data),
        rows=len(rows),
        inputs=(longest_of("displacement", "m", fields_of(data, rows)),),
        outputs=(ends_of("tared_counts", "tared counts", tared_counts(data)[rows]),),
    )
