"""A features bundle whose contact location is where the skin is touched, not where a robot says.

A robot that stands a little wrong (its registration error) reports each place off by as much, and
a network learns that of every finger that it can tell from others: the errors of `features-twin` 12
had the mean of the registration errors of its robots. Presses whose locations are exact show what
was learned: the median error of each sensor on each side of the finger, since each side is an
arm's. A ridge regression finds what the inputs of the last layer tell of that error, and it is
subtracted from the layer's weights. All other outputs keep their bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import BundleError, DatasetError
from palpate.files.bundle import Bundle, read_bundle, write_bundle
from palpate.process import require
from palpate_training.datasets.container import refuse_repeated
from palpate_training.datasets.features import FloatArray, IndexArray, press_of
from palpate_training.learning.export import (
    refuse_existing,
    run_onnx,
    session_of,
    version_of,
)
from palpate_training.learning.metrics import join, location_errors, rms
from palpate_training.learning.ranges import holds_known
from palpate_training.learning.splits import by_group
from palpate_training.tasks.evaluate import (
    LOCATION_DATA,
    answers_of,
    learned_from,
    read_features,
)
from palpate_training.tasks.features import contact_report

Floats = npt.NDArray[np.float64]
Labels = npt.NDArray[np.integer]

LOCATION = "contact_location"
PRESSES_LEAST = 20
"""Presses of a sensor on one side, of fewer of which the mean error is not known."""

PENALTIES = (1.0, 10.0, 100.0, 1e3, 1e4)
"""Of the ridge regression; validation presses choose."""

_PART = 4096  # rows at a time: the last layer has some thousand inputs


@dataclass(frozen=True, slots=True)
class LocationReport:
    """What was done.

    Attributes:
        digest: The new bundle's, 32 bytes.
        before_m: Median error of the location on presses that nothing was learned from [m].
        after_m: The same, of the new bundle.
    """

    digest: bytes
    before_m: float
    after_m: float


@dataclass(frozen=True, slots=True)
class _Presses:
    """Rows in contact: tared counts (N, 19), true location (N, 3), press and group (N,)."""

    tared: FloatArray
    location: FloatArray
    press: IndexArray
    group: Labels


def correct_location(
    old: Path, exact: Sequence[Path], out: Path, *, seed: int = 0
) -> LocationReport:
    """Write a features bundle again without the registration errors of its training's robots.

    Args:
        old: Folder of the bundle.
        exact: Data sets of presses of its sensors, whose locations have no registration error
            (``palpate data generate --exact-labels``), and that its training has not seen.
        out: Folder to write; must not exist. A number is the version.
        seed: Deals the presses to those that are learned from, that choose, and that test.

    Raises:
        BundleError: It breaks its contract, has no contact location, was exported otherwise, or
            ``out`` exists.
        DatasetError: A data set breaks its schema, has no locations or too few presses, or was
            trained on; or the locations do not get better, so nothing is to be taken out.
    """
    refuse_existing(out)
    bundle = read_bundle(old)
    manifest = bundle.manifest
    if LOCATION not in {tensor.name for tensor in manifest.outputs}:
        raise BundleError(
            f"{old} gives no contact location", remedy="take a features bundle that does"
        )
    presses, sources, digests = _read(exact, manifest.contact_threshold_n)
    learned = learned_from(manifest)
    if not learned.isdisjoint(digests) or (
        bundle.known_inputs is not None and holds_known(bundle.known_inputs, presses.tared)
    ):
        raise DatasetError(
            f"{old} was trained on presses of {', '.join(map(str, exact))}",
            remedy="take presses that no training has seen",
        )
    split = by_group(presses.press, seed=seed)
    layer = _LastLayer(bundle.model)
    answer = _locations(bundle, presses.tared)
    wanted = _systematic(presses, answer, split.train)
    weights = layer.ridge(presses.tared[split.train], wanted[split.train], PENALTIES)

    def error_of(found: FloatArray, rows: Labels) -> float:
        distance = location_errors(found, presses.location[rows])["distance_m"]
        return float(np.median(distance))

    def found_without(one: Floats, rows: Labels) -> FloatArray:
        changed = replace(bundle, model=layer.without(one).model)
        return _locations(changed, presses.tared[rows])

    best = min(
        weights, key=lambda one: error_of(found_without(one, split.validation), split.validation)
    )
    found = found_without(best, split.test)
    before, after = (error_of(one, split.test) for one in (answer[split.test], found))
    if not after < before:
        raise DatasetError(
            f"{old}: its locations are not off by sensor and side: a median error of"
            f" {before * 1e3:.3f} mm would become {after * 1e3:.3f} mm",
            remedy="keep it as it is",
        )
    model = layer.without(best).with_spread(rms(found - presses.location[split.test]))
    given = manifest.inputs[0].name
    golden = dict(bundle.golden)
    (was, _), (now, _) = (run_onnx(one, given, golden[given]) for one in (bundle.model, model))
    for tensor, value_before, values in zip(manifest.outputs, was, now, strict=True):
        if tensor.name.startswith(LOCATION):
            golden[tensor.name] = values
        elif not np.array_equal(values, value_before):
            raise BundleError(
                f"{old}: {tensor.name} changes with the location",
                remedy="report this with the bundle: its graph is another one than palpate writes",
            )
    metrics = {
        name: value
        for name, value in manifest.metrics.items()
        if not name.removeprefix("constant_").removeprefix("linear_").startswith("location_")
    } | contact_report(
        LOCATION, presses.tared, presses.location, found, split.train, split.test, presses.press
    )
    bounds = manifest.intervals
    if bounds is not None:  # those of the location are of errors that it has no more
        kept = tuple(one for one in bounds.formulas if one.name != LOCATION)
        bounds = replace(bounds, formulas=kept)
    digest = write_bundle(
        out,
        model=model,
        golden=golden,
        manifest=replace(
            manifest,
            metrics=metrics,
            normalisation={
                **manifest.normalisation,
                LOCATION_DATA: " ".join(
                    sorted(learned - {manifest.training_data_sha256} | digests)
                ),
            },
            intervals=bounds,
            trained_on=f"{manifest.trained_on}; its location then freed of registration errors by"
            f" {len(np.unique(presses.press))} presses of {'; '.join(sources)}",
            version=version_of(out, manifest.version),
        ),
        mesh=bundle.mesh,
        known_inputs=bundle.known_inputs,
    )
    return LocationReport(digest, before, after)


def _read(exact: Sequence[Path], threshold_n: float) -> tuple[_Presses, list[str], set[str]]:
    """Rows in contact of all data sets, where they come from, and their digests."""
    parts, sensors, sources, first = [], [], [], 0
    digests: set[str] = set()
    for path in exact:
        data, about, digest = read_features(path)
        digests |= {digest, data.content_sha256()}  # of a mixed file, and of its features
        if data.contact_location is None:
            raise DatasetError(f"{path} has no contact locations", remedy="take one that has")
        rows = np.flatnonzero(
            data.touching(threshold_n) & np.isfinite(data.contact_location).all(axis=1)
        )
        press = press_of(data)[rows] + first
        first = int(press.max(initial=first)) + 1
        parts.append((data.tared_counts[rows], data.contact_location[rows], press))
        sensors.append(np.array(data.sensor_names)[data.sensor[rows]])
        sources.append(about.source)
    refuse_repeated(exact, [(tared, location) for tared, location, _ in parts])
    tared, location, press = (np.concatenate(one) for one in zip(*parts, strict=True))
    _, number = np.unique(press, return_inverse=True)
    lateral = np.bincount(number, location[:, 1]) / np.bincount(number)
    _, sensor = np.unique(np.concatenate(sensors), return_inverse=True)
    group = 2 * sensor + (lateral[number] >= 0.0)
    for one in np.unique(group):
        count = len(np.unique(press[group == one]))
        if count < PRESSES_LEAST:
            raise DatasetError(
                f"{', '.join(map(str, exact))}: {count} presses of a sensor on one side of the"
                f" finger, {PRESSES_LEAST} are needed",
                remedy="simulate more",
            )
    return _Presses(tared, location, press.astype(np.int32), group), sources, digests


def _locations(bundle: Bundle, tared: FloatArray) -> FloatArray:
    """Contact locations of rows of tared counts [m], (N, 3)."""
    return join(answers_of(bundle, lambda part: tared[part], np.arange(len(tared))))[LOCATION]


def _systematic(presses: _Presses, answer: FloatArray, train: Labels) -> Floats:
    """Error of the location of each row's sensor and side [m], (N, 3): of its presses the median.

    Their mean would follow the few presses that are far off.
    """
    both = np.stack([presses.group[train], presses.press[train]], axis=1)
    found, number = np.unique(both, axis=0, return_inverse=True)
    error = (answer[train] - presses.location[train]).astype(np.float64)
    rows = np.bincount(number)
    each = np.stack([np.bincount(number, error[:, axis]) / rows for axis in range(3)], axis=1)
    wanted = np.zeros((len(presses.press), 3))
    for group in np.unique(presses.group):
        wanted[presses.group == group] = np.median(each[found[:, 0] == group], axis=0)
    return wanted


class _LastLayer:
    """The last layer of each network of an exported features graph, as far as the location goes."""

    def __init__(self, model: bytes) -> None:
        onnx: Any = require("onnx", extra="training")
        self._onnx, self._model = onnx, onnx.load_from_string(model)
        graph = self._model.graph
        self._constants = {one.name: one for one in graph.initializer}
        made = {name: node for node in graph.node for name in node.output}
        used = {name: node for node in graph.node for name in node.input}
        heads, split = [], None
        for node in graph.node:
            if node.op_type == "Add" and any(name.endswith("head.bias") for name in node.input):
                (product,) = (made[name] for name in node.input if name in made)
                weights = product.input[1]
                weights = made[weights].input[0] if weights in made else weights
                (bias,) = (name for name in node.input if name in self._constants)
                scaled = used[node.output[0]]
                (spread,) = (name for name in scaled.input if name in self._constants)
                heads.append((product.input[0], weights, bias, spread))
            if node.op_type == "Split" and LOCATION in node.output:
                split = 3 * list(node.output).index(LOCATION)
        if not heads or split is None or f"{LOCATION}_spread" not in self._constants:
            raise BundleError(
                "the graph is not one that palpate train features writes",
                remedy="train the bundle anew",
            )
        self._heads, self._columns = heads, slice(split, split + 3)
        signs = self._constants.get("net.signs")
        # Of a row and of its mirror image (2, 3); of the row alone where they are not averaged.
        self._signs = (
            np.ones((1, 3)) if signs is None else self._values(signs)[:, self._columns]
        ).astype(np.float64)
        self._input = graph.input[0].name

    @property
    def model(self) -> bytes:
        """The whole graph."""
        return self._bytes(self._model)

    def ridge(self, tared: FloatArray, wanted: Floats, penalties: Sequence[float]) -> list[Floats]:
        """Weights (I + 1, 3) that make ``wanted`` (N, 3) of the I inputs of all last layers and 1.

        Where the estimate of the mirror image is subtracted, a constant cancels, so it gets zero.
        """
        squares: list[Any] = [0.0] * 3
        products: list[Any] = [0.0] * 3
        for rows, hidden in self._hidden(tared):
            for axis, signs in enumerate(self._signs.T):
                ones = np.full((len(hidden), 1), signs.sum())
                values = np.hstack([np.tensordot(hidden, signs, (1, 0)), ones])
                squares[axis] = squares[axis] + values.T @ values
                products[axis] = products[axis] + values.T @ wanted[rows, axis]
        free = np.append(np.ones(len(products[0]) - 1), 1e-9)  # the constant is not held back
        return [
            np.stack(
                [
                    np.linalg.solve(square + penalty * np.diag(free), product)
                    for square, product in zip(squares, products, strict=True)
                ],
                axis=1,
            )
            for penalty in penalties
        ]

    def without(self, weights: Floats) -> _LastLayer:
        """The same network, whose location has what these weights make subtracted."""
        new = _LastLayer(self.model)
        begin = 0
        for _, name, bias_name, spread_name in new._heads:
            spread = new._values(new._constants[spread_name])[new._columns].astype(np.float64)
            inputs = len(new._values(new._constants[name]))
            share = len(new._heads) * weights[begin : begin + inputs]  # the estimate is their mean
            new._subtract(name, share / spread)
            new._subtract(bias_name, weights[-1] / spread)
            begin += inputs
        return new

    def with_spread(self, spread: Floats) -> bytes:
        """The model with this standard deviation of the location [m], (3,)."""
        self._set(f"{LOCATION}_spread", np.asarray(spread, np.float32))
        self._onnx.checker.check_model(self._model, full_check=True)
        return self.model

    def _hidden(self, tared: FloatArray) -> Iterator[tuple[slice, Floats]]:
        """Inputs of all last layers, (rows, 1 or 2, I): of a row and of its mirror image."""
        names = [head[0] for head in self._heads]
        shown = self._onnx.load_from_string(self.model)
        for name in names:
            shown.graph.output.append(
                self._onnx.helper.make_tensor_value_info(name, self._onnx.TensorProto.FLOAT, None)
            )
        session = session_of(self._bytes(shown))
        for k in range(0, len(tared), _PART):
            rows = slice(k, k + _PART)
            found = np.concatenate(session.run(names, {self._input: tared[rows]}), axis=-1)
            yield rows, found.reshape(len(found), -1, found.shape[-1]).astype(np.float64)

    def _subtract(self, name: str, values: Floats) -> None:
        """From the columns of the location."""
        found = self._values(self._constants[name]).copy()
        exact = found[..., self._columns].astype(np.float64) - values
        found[..., self._columns] = exact.astype(found.dtype)
        self._set(name, found)

    def _values(self, constant: Any) -> npt.NDArray[Any]:
        values: npt.NDArray[Any] = self._onnx.numpy_helper.to_array(constant)
        return values

    def _set(self, name: str, values: npt.NDArray[Any]) -> None:
        constant = self._constants[name]
        constant.CopyFrom(self._onnx.numpy_helper.from_array(values, name))

    @staticmethod
    def _bytes(model: Any) -> bytes:
        return bytes(model.SerializeToString(deterministic=True))
