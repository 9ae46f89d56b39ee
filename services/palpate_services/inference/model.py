"""A bundle's model, loaded and checked: ONNX Runtime behind the contract of its task.

The model comes as bytes whose digest ``read_bundle`` has checked. It serves only if it holds all
its weights, its signature agrees with manifest and task, and it reproduces its golden vectors.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection, Mapping, Sequence
from math import asinh, hypot, isfinite, sqrt
from operator import gt, lt
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.errors import BundleError
from palpate.files.bundle import Bundle
from palpate.files.intervals import bound_terms, bounds_of
from palpate.files.manifest import Manifest
from palpate.files.training_range import InputPattern, KnownInputs, pattern_terms
from palpate.messages import (
    ErrorBounds,
    FloatArray,
    ModelMetadata,
    QualityFlag,
    SensorType,
    TrainingRange,
    ValueRange,
)
from palpate.messages.estimates import UNIT_TOLERANCE
from palpate.process import require
from palpate_services.inference.basis import basis_of
from palpate_services.inference.onnx_file import has_external_data

MARGIN = 0.05
"""A value may lie this share of its range beyond the ends: training rows do not reach the very ends
of what the model can do."""


class RangeCheck:
    """Compares inputs and outputs of a bundle with its training range.

    Some 10 microseconds for 19 electrodes (docs/results/quality.md).
    """

    def __init__(self, known: TrainingRange | None, inputs: KnownInputs | None) -> None:
        self._known = known
        self._inputs = [] if known is None else [_Ends(one) for one in known.inputs]
        self._outputs = [] if known is None else [(one.name, _Ends(one)) for one in known.outputs]
        self._combinations: _Combinations | _Pattern | None = None
        if inputs is not None:
            pattern = inputs.pattern
            self._combinations = _Combinations(inputs) if pattern is None else _Pattern(pattern)

    @classmethod
    def of(cls, bundle: Bundle) -> RangeCheck:
        """The check of a bundle; of one that does not know its range, one that says so."""
        return cls(bundle.manifest.training_range, bundle.known_inputs)

    def place(self, sample: FloatArray) -> Place | None:
        """Where an input lies among those of the training; None where these are not known."""
        return None if self._combinations is None else self._combinations.place(sample)

    def flags(
        self,
        sample: FloatArray,
        outputs: Mapping[str, FloatArray],
        *,
        without: Collection[str],
        place: Place | None = None,
    ) -> tuple[QualityFlag, ...]:
        """What is to be said of an estimate.

        Args:
            sample: What the model got, flat.
            outputs: What it made of it, by name.
            without: Outputs that are not part of the estimate.
            place: Of the sample, where it was asked for already.
        """
        if self._known is None:
            return (QualityFlag.RANGE_UNKNOWN,)
        place = place or self.place(sample)
        unlike = place is not None and place.distance > 1.0
        beyond = False
        for ends in self._inputs:
            unlike = unlike or ends.exceeded(sample)
        for name, ends in self._outputs:
            beyond = beyond or (name not in without and ends.exceeded(outputs[name]))
        return _FLAGS[unlike, beyond]


_FLAGS: dict[tuple[bool, bool], tuple[QualityFlag, ...]] = {
    (False, False): (),
    (True, False): (QualityFlag.OUT_OF_RANGE,),
    (False, True): (QualityFlag.EXTRAPOLATING,),
    (True, True): (QualityFlag.OUT_OF_RANGE, QualityFlag.EXTRAPOLATING),
}

_FEW = 64  # up to so many values plain Python is faster than NumPy's reductions


class _Ends:
    """The ends of one tensor's values, widened by ``MARGIN``."""

    def __init__(self, known: ValueRange) -> None:
        low, high = (np.array(side, np.float32) for side in (known.low, known.high))
        widened = np.float32(MARGIN) * (high - low)
        self._low, self._high = low - widened, high + widened
        self._lows, self._highs = self._low.tolist(), self._high.tolist()
        self._squared_max = (known.length_max * (1.0 + MARGIN)) ** 2

    def exceeded(self, values: FloatArray) -> bool:
        """Whether any value, or the length of any vector, lies beyond them."""
        if values.size > _FEW:
            return self._exceeded_by_many(values)
        numbers = values.tolist()
        if self._lows and (any(map(lt, numbers, self._lows)) or any(map(gt, numbers, self._highs))):
            return True
        if not self._squared_max:
            return False
        each = iter(numbers)
        return any(
            x * x + y * y + z * z > self._squared_max
            for x, y, z in zip(each, each, each, strict=True)
        )

    def _exceeded_by_many(self, values: FloatArray) -> bool:
        if self._lows and bool(((values < self._low) | (values > self._high)).any()):
            return True
        if not self._squared_max:
            return False
        vectors = values.reshape(-1, 3)
        return bool(np.einsum("ij,ij->i", vectors, vectors).max() > self._squared_max)


class Place(NamedTuple):
    """Where an input lies among those of the training.

    Attributes:
        distance: How far it is from them, over the limit: above one it is unlike all of them.
        common: Common mode: mean of the compressed values.
    """

    distance: float
    common: float


class _Combinations:
    """Which values occur together: the distance from the nearest representative."""

    def __init__(self, known: KnownInputs) -> None:
        self._scale = float(known.scale)
        prototypes = known.prototypes.astype(np.float64)
        # |q - p|^2 = |q|^2 + (|p|^2 - 2 q.p): what does not depend on q is computed once.
        self._squared = np.einsum("ij,ij->i", prototypes, prototypes)
        self._minus_twice = -2.0 * prototypes
        self._limit = float(known.distance_max)

    def place(self, sample: FloatArray) -> Place:
        compressed = [asinh(value / self._scale) for value in sample.tolist()]
        where = np.array(compressed)
        nearest = float((self._minus_twice @ where + self._squared).min()) + float(where @ where)
        return Place(sqrt(max(nearest, 0.0)) / self._limit, sum(compressed) / len(compressed))


class _Pattern:
    """Which values occur together: how strange their combinations are."""

    def __init__(self, known: InputPattern) -> None:
        self._scale = float(known.scale)
        terms = len(known.centre)
        # The root of a mean over the limit is the length of a vector, scaled so.
        weights = known.weights / np.float32(known.most * sqrt(terms))
        self._weights = np.ascontiguousarray(weights.T)
        self._centre = known.centre

    def place(self, sample: FloatArray) -> Place:
        compressed = [asinh(value / self._scale) for value in sample.tolist()]
        odd = self._weights @ (pattern_terms(np.array(compressed, np.float32)) - self._centre)
        return Place(sqrt(float(odd @ odd)), sum(compressed) / len(compressed))


_log = logging.getLogger(__name__)

GOLDEN_TOLERANCE = 1e-4
"""Allowed deviation from the golden outputs, relative to their largest magnitude. Float32 is up to
5e-5 from float64 (`features-twin` 9, contact location: 0.6 um), and another processor's kernels may
round in another way; on the one that exported it two runtimes differ by 7e-6."""

BATCH_MOST = 8
"""Most samples in one run: a row of eight costs a quarter to a half of a single run, and the gain
beyond that is small against what the first of the batch would wait."""

WARM_UP_RUNS = 50
"""Runs before a model counts as warm: the first takes 5-10 times as long as the later ones."""

_ALIGN = 16  # float32 values to a 64-byte cache line, the alignment ONNX Runtime's own buffers have

_FEW_OUTPUTS = 8 * _ALIGN  # those of the features task: up to so many plain Python is faster

_SERIALS_KEPT = 256

_REMEDY = "export the bundle again with palpate_training, or serve another one"

_DTYPES = {"tensor(float)": "float32", "tensor(double)": "float64", "tensor(int64)": "int64"}


def load(bundle: Bundle, task: str) -> Runtime:
    """Load a bundle for a task, e.g. ``"features"``, and warm it up.

    Raises:
        BundleError: It breaks the contract; the error names what and where.
        MissingExtraError: ONNX Runtime is not installed.
    """
    runtime = Runtime(bundle, task)
    _log.info("loaded %s:%d for %s", bundle.manifest.name, bundle.manifest.version, task)
    return runtime


Outputs = dict[str, FloatArray]
"""Outputs of a model for one sample by name, without batch axis."""


class Runtime:
    """A loaded bundle; it may be used from several threads.

    Samples may be computed together, in batches of up to ``batch_most``, if that changes no bit of
    their outputs: an estimate must not depend on which other sensors had a frame at that moment.

    Attributes:
        manifest: The bundle's description of itself.
        name: Its name; ``version`` likewise.
        label: The bundle as ``name:version``.
        batch_most: Most samples in one run; 1 = each is computed alone.
        sha256: Digest of the manifest, 32 bytes; part of every estimate.
        sensor_type: The type of sensor that it was made for.
        contact_threshold_n: Net force above which there is contact [N].
        mesh: Mesh of its fields; None for a task without.
        mesh_sha256: Content hash of that mesh, 32 bytes; empty for a task without.
        range: Compares samples and outputs with what it was trained on.
        basis: Basis of its coefficients; None for a model without.
    """

    def __init__(self, bundle: Bundle, task: str) -> None:
        manifest = bundle.manifest
        self.manifest = manifest
        self.sha256 = bundle.sha256
        self.contact_threshold_n = float(manifest.contact_threshold_n)
        self.mesh = bundle.mesh
        self.mesh_sha256 = b"" if bundle.mesh is None else bundle.mesh.sha256
        self.range = RangeCheck.of(bundle)
        self._intervals = manifest.intervals
        self._made_for: dict[str, bool] = {}
        self._lock = threading.Lock()
        self.name, self.version = manifest.name, manifest.version
        self.label = f"{manifest.name}:{manifest.version}"
        self._label = f"bundle {self.label}"
        if manifest.task != task:
            raise BundleError(
                f"{self._label} is for the task {manifest.task!r}, not {task!r}",
                remedy=f"serve a bundle whose manifest says task = {task!r}",
            )
        self.sensor_type = SensorType[manifest.sensor_type]
        _check_self_contained(bundle.model, self._label)
        self._session = _open_session(bundle.model, self._label)
        _check_model(manifest, self._session, self._label)
        self._check_golden(bundle.golden)
        self.basis = basis_of(bundle)
        self._bind()
        self._warm_up()
        self.batch_most = self._equal_batches(bundle.golden[manifest.inputs[0].name])

    def made_for(self, serial: str) -> bool:
        """Whether the bundle was made for the sensor with this serial number."""
        found = self._made_for.get(serial)
        if found is None:
            found = any(
                serial.startswith(known[:-1]) if known.endswith("*") else serial == known
                for known in self.manifest.sensor_serials
            )
            if len(self._made_for) >= _SERIALS_KEPT:
                self._made_for.clear()
            self._made_for[serial] = found
        return found

    def made_for_others(self, serial: str) -> str:
        """Which fingers it was made for, if not for this one, in words; empty = nothing is known.

        A bundle that was made without presses of its finger names none.
        """
        known = self.manifest.sensor_serials
        if not known or self.made_for(serial):
            return ""
        more = f" and {len(known) - 1} more" if len(known) > 1 else ""
        return f" (made for {known[0]}{more}; this is {serial})"

    def bounds(
        self, size: float, place: Place | None, *, others: bool, contact: bool = True
    ) -> ErrorBounds | None:
        """How far an estimate may be off; None where the bundle cannot say.

        Args:
            size: Of the estimate: length of the force [N], or of a field's coefficients [mm].
            place: Of its input.
            others: The sensor is none that the bundle was made for.
            contact: Whether the estimate has a contact location.
        """
        if self._intervals is None or place is None:
            return None
        terms = bound_terms(size, place.common, place.distance)
        return bounds_of(self._intervals, terms, others=others, contact=contact)

    def run(self, sample: FloatArray) -> Outputs | None:
        """Run the model on one sample.

        Args:
            sample: The model's one input without batch axis, e.g. tared counts, shape ``(19,)``,
                or a displacement field, flat, shape ``(3 V,)``.

        Returns:
            Outputs by name without batch axis, on memory of their own; None if any value is not
            finite or a standard deviation is negative.
        """
        with self._lock:
            self._input[0] = sample
            self._session.run_with_iobinding(self._binding)
            values = self._output.copy()
        return self._named(values)

    def run_all(self, samples: Sequence[FloatArray]) -> list[Outputs | None]:
        """Outputs of ``run`` for each sample, bit for bit, in fewer runs where that is possible."""
        if len(samples) == 1 or self.batch_most == 1:
            return [self.run(sample) for sample in samples]
        results: list[Outputs | None] = []
        for start in range(0, len(samples), self.batch_most):
            part = samples[start : start + self.batch_most]
            if len(part) == 1:
                results.append(self.run(part[0]))
            else:
                results += self._run_batch(np.stack(part))
        return results

    def _run_batch(self, samples: FloatArray) -> list[Outputs | None]:
        feeds = {self.manifest.inputs[0].name: samples}
        names = [name for name, _, _ in self._slices]
        values: FloatArray = np.zeros((len(samples), len(self._output)), np.float32)
        answers = self._session.run(names, feeds)
        for (_, start, stop), answer in zip(self._slices, answers, strict=True):
            values[:, start:stop] = answer.reshape(len(samples), -1)
        return [self._named(row) for row in values]

    def _equal_batches(self, golden: FloatArray) -> int:
        """Largest number of samples up to which every batch gives the bits of single runs.

        Which kernel multiplies matrices depends on the number of rows, and with it, for wide
        inputs, the order of summation: of the shipped bundles synthesis differs in the last bits.
        """
        rows = [
            golden[row % len(golden)] * np.float32(1 - 0.1 * (row // len(golden)))
            for row in range(BATCH_MOST)
        ]
        alone = [self.run(row) for row in rows]
        for size in range(2, BATCH_MOST + 1):
            together = self._run_batch(np.stack(rows[:size]))
            if not all(_same_bits(*pair) for pair in zip(alone, together, strict=False)):
                return size - 1
        return BATCH_MOST

    def _named(self, values: FloatArray) -> Outputs | None:
        """Outputs by name, of the values of one sample; None if they are not plausible."""
        if not self._plausible(values):
            return None
        return {name: values[start:stop] for name, start, stop in self._slices}

    def _plausible(self, values: FloatArray) -> bool:
        """Whether all values are finite, no standard deviation is negative, a normal is a unit."""
        if any(
            abs(hypot(*values[start:stop].tolist()) - 1.0) > UNIT_TOLERANCE
            for start, stop in self._directions
        ):
            return False
        if values.size > _FEW_OUTPUTS:
            return bool(np.isfinite(values).all()) and all(
                values[start:stop].min() >= 0 for start, stop in self._deviations
            )
        # One sum checks all values: it cannot overflow, because doubles reach far beyond float32,
        # and NaN or infinity in any value makes the sum NaN or infinite.
        numbers = values.tolist()
        return isfinite(sum(numbers)) and all(
            min(numbers[start:stop]) >= 0 for start, stop in self._deviations
        )

    @property
    def sample_shape(self) -> tuple[int, ...]:
        """Shape of one sample: ``(19,)``, or ``(3 V,)`` for a field."""
        return self._input.shape[1:]

    def metadata(self) -> ModelMetadata:
        """Description of the model for clients."""
        manifest = self.manifest
        return ModelMetadata(
            name=manifest.name,
            version=manifest.version,
            task=manifest.task,
            bundle_sha256=self.sha256,
            contract_version=manifest.contract_version,
            inputs=tuple(manifest.inputs),
            outputs=tuple(manifest.outputs),
            training_data_sha256=manifest.training_data_sha256,
            metrics=dict(manifest.metrics),
            trained_on=manifest.trained_on,
            training_range=manifest.training_range,
            mesh_sha256=self.mesh_sha256,
            basis_sha256=b"" if self.basis is None else self.basis.sha256,
            modes=0 if self.basis is None else len(self.basis.modes),
        )

    def _check_golden(self, golden: Mapping[str, npt.NDArray[np.float32]]) -> None:
        names = [tensor.name for tensor in (*self.manifest.inputs, *self.manifest.outputs)]
        missing = [name for name in names if name not in golden]
        if missing:
            raise BundleError(
                f"{self._label}: golden.npz has no {', '.join(missing)}", remedy=_REMEDY
            )
        feeds = {tensor.name: golden[tensor.name] for tensor in self.manifest.inputs}
        outputs = [tensor.name for tensor in self.manifest.outputs]
        try:
            answers = self._session.run(outputs, feeds)
        except Exception as error:  # ONNX Runtime's errors share no base of their own
            raise BundleError(
                f"{self._label}: the model does not run on its golden inputs: {_first_line(error)}",
                remedy=_REMEDY,
            ) from error
        for name, answer in zip(outputs, answers, strict=True):
            self._check_answer(name, np.asarray(answer), golden[name])

    def _check_answer(
        self, name: str, answer: npt.NDArray[Any], expected: npt.NDArray[Any]
    ) -> None:
        if not np.isfinite(answer).all():
            raise BundleError(
                f"{self._label}: output {name!r} is NaN or infinite on its golden input",
                remedy=_REMEDY,
            )
        if answer.shape != expected.shape:
            raise BundleError(
                f"{self._label}: output {name!r} has shape {answer.shape} on its golden input, "
                f"golden.npz says {expected.shape}",
                remedy=_REMEDY,
            )
        scale = float(np.max(np.abs(expected), initial=0.0)) or 1.0
        deviation = float(np.max(np.abs(answer - expected), initial=0.0)) / scale
        if not deviation < GOLDEN_TOLERANCE:
            raise BundleError(
                f"{self._label}: output {name!r} deviates from golden.npz by {deviation:.2g} of "
                f"its largest value, {GOLDEN_TOLERANCE:g} is allowed",
                remedy=_REMEDY,
            )

    def _bind(self) -> None:
        """Bind input and outputs to fixed memory once: 2 us cheaper than feeding each sample.

        All outputs share one array, so that one copy and one check suffice.
        """
        entry = self.manifest.inputs[0]
        self._input: FloatArray = np.zeros((1, *entry.shape[1:]), np.float32)
        self._slices: list[tuple[str, int, int]] = []
        end = 0
        for tensor in self.manifest.outputs:
            size = int(np.prod(tensor.shape[1:]))
            self._slices.append((tensor.name, end, end + size))
            end += -(-size // _ALIGN) * _ALIGN
        self._deviations = [
            (start, stop) for name, start, stop in self._slices if name.endswith("_sd")
        ]
        self._directions = [
            (start, stop) for name, start, stop in self._slices if name == "contact_normal"
        ]
        self._output: FloatArray = np.zeros(end, np.float32)
        self._binding = self._session.io_binding()
        self._binding.bind_input(
            entry.name, "cpu", 0, np.float32, self._input.shape, self._input.ctypes.data
        )
        for tensor, (name, start, _) in zip(self.manifest.outputs, self._slices, strict=True):
            address = self._output.ctypes.data + start * self._output.itemsize
            self._binding.bind_output(name, "cpu", 0, np.float32, (1, *tensor.shape[1:]), address)

    def _warm_up(self) -> None:
        silence = np.zeros(self.sample_shape, np.float32)
        for _ in range(WARM_UP_RUNS):
            outputs = self.run(silence)
        if outputs is None:
            raise BundleError(
                f"{self._label}: the output for an untouched sensor (all zero) is not finite, a "
                "standard deviation is negative, or a contact normal is no unit vector",
                remedy=_REMEDY,
            )


def _same_bits(one: Outputs | None, other: Outputs | None) -> bool:
    if one is None or other is None:
        return one is other
    return all(one[name].tobytes() == other[name].tobytes() for name in one)


def _check_self_contained(model: bytes, label: str) -> None:
    try:
        external = has_external_data(model)
    except ValueError as error:
        raise BundleError(
            f"{label}: model.onnx does not load: {error}, so it is no ONNX file", remedy=_REMEDY
        ) from error
    if external:
        raise BundleError(
            f"{label}: model.onnx keeps weights in another file, which no digest covers",
            remedy="export it with all weights inside model.onnx",
        )


def _open_session(model: bytes, label: str) -> Any:
    ort: ModuleType = require("onnxruntime", extra="services")
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    # Threads that spin while they wait keep a core busy between two frames, without gain at 100 Hz.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 4  # fatal only: its errors are raised
    try:
        return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors share no base of their own
        text = str(error)
        if "opset" in text.lower():
            problem = f"{label}: ONNX Runtime {ort.__version__} does not know its opset"
            remedy = "export for an older opset, or upgrade onnxruntime"
        else:
            problem = f"{label}: model.onnx does not load: {_first_line(error)}"
            remedy = _REMEDY
        raise BundleError(problem, remedy=remedy) from error


def _check_model(manifest: Manifest, session: Any, label: str) -> None:
    """The graph must have the tensors of its manifest, which were checked against the task."""
    for side, declared, nodes in (
        ("input", manifest.inputs, session.get_inputs()),
        ("output", manifest.outputs, session.get_outputs()),
    ):
        wanted = {tensor.name: (tensor.dtype, tuple(tensor.shape)) for tensor in declared}
        found = {node.name: _signature(node) for node in nodes}
        if found != wanted:
            raise BundleError(
                f"{label}: model.onnx has {side}s {_describe(found)}; manifest.json says "
                f"{_describe(wanted)}",
                remedy=f"export it to the contract of the task {manifest.task!r}",
            )


def _signature(node: Any) -> tuple[str, tuple[int, ...]]:
    # ONNX Runtime gives a name or None for a free batch size.
    shape = tuple(size if isinstance(size, int) else -1 for size in node.shape)
    return _DTYPES.get(node.type, node.type), shape


def _describe(tensors: dict[str, tuple[str, tuple[int, ...]]]) -> str:
    return ", ".join(
        f"{name} {dtype}{list(shape)}" for name, (dtype, shape) in sorted(tensors.items())
    )


def _first_line(error: Exception) -> str:
    """First line of ONNX Runtime's message, without the source paths of its build."""
    return str(error).splitlines()[0].split(" : ")[-1][:200]
