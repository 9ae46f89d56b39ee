"""What a bundle was trained on, as it is kept in the bundle (docs/adr/0021).

The ends of each value stand in the manifest, for people and programs. Which inputs occur *together*
no ends can say, so the bundle has a file ``range.npz`` with representatives of the training inputs:
an input that is far from all of them is unlike everything the model was trained on.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import BundleError, printable
from palpate.files.bounded import arrays_of_npz
from palpate.messages import FloatArray, TensorInfo, TrainingRange, ValueRange

RANGE_BYTES_MAX = 1 << 20
"""Size of ``range.npz``, and of what its arrays expand to [bytes]."""

IndexArray = npt.NDArray[np.intp]

PROTOTYPES_MAX = 4096
_WIDTH_MAX = 64
_REMEDY = "export the bundle again with palpate train"


@dataclass(frozen=True, slots=True)
class KnownInputs:
    """Representatives of the inputs that a model was trained on.

    They are compressed: ``arcsinh(value / scale)``, so that a light touch counts beside a hard one.

    Attributes:
        prototypes: Representatives, compressed, float32, shape ``(P, I)``.
        scale: In the unit of the input, positive.
        distance_max: No training row is farther from its nearest representative.
        pattern: How values go together; it replaces the distance. None = the distance is used.
    """

    prototypes: FloatArray
    scale: float
    distance_max: float
    pattern: InputPattern | None = None


@dataclass(frozen=True, slots=True)
class InputPattern:
    """How the values of an input go together in all that a model was trained on or measured with.

    Of compressed values, ``arcsinh(value / scale)``, and their products (``pattern_terms``) some
    combinations hardly vary; an input in which one of these is large is unlike the others. The
    strangeness of an input is the root mean square of ``(terms - centre) @ weights``.

    Attributes:
        scale: In the unit of the input, positive.
        centre: Means of the terms, float32, shape ``(T,)``.
        weights: Float32, shape ``(T, T)``: combinations in the columns, over their spread.
        most: From this strangeness on an input is unlike all known ones, positive.
    """

    scale: float
    centre: FloatArray
    weights: FloatArray
    most: float


def pattern_terms(compressed: FloatArray) -> FloatArray:
    """Values and all their products, ``(..., I)`` to ``(..., I (I + 3) / 2)``."""
    first, second = _pairs(compressed.shape[-1])
    products = compressed[..., first] * compressed[..., second]
    return np.concatenate([compressed, products], axis=-1)


@cache
def _pairs(width: int) -> tuple[IndexArray, IndexArray]:
    return np.triu_indices(width)


def known_inputs_to_bytes(known: KnownInputs) -> bytes:
    """The file ``range.npz``."""
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {
        "prototypes": known.prototypes,
        "scale": np.float64(known.scale),
        "distance_max": np.float64(known.distance_max),
    }
    if (pattern := known.pattern) is not None:
        arrays |= {
            "pattern_scale": np.float64(pattern.scale),
            "pattern_centre": pattern.centre,
            "pattern_weights": pattern.weights,
            "pattern_most": np.float64(pattern.most),
        }
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def known_inputs_from_bytes(data: bytes, width: int, where: str) -> KnownInputs:
    """Read and check ``range.npz`` of a model whose input has ``width`` values.

    Raises:
        BundleError: It is no NumPy archive, lacks an array, or an array is not what it must be.
    """
    try:
        arrays = arrays_of_npz(data, RANGE_BYTES_MAX)
        found = KnownInputs(
            arrays["prototypes"],
            float(arrays["scale"]),
            float(arrays["distance_max"]),
            _pattern_of(arrays),
        )
        problem = _problem(found, width)
    except (ValueError, KeyError, TypeError) as error:
        raise BundleError(
            f"{where} is not a training range: {printable(str(error))}", remedy=_REMEDY
        ) from error
    if problem:
        raise BundleError(f"{where}: {problem}", remedy=_REMEDY)
    return found


def _problem(known: KnownInputs, width: int) -> str:
    prototypes = known.prototypes
    if prototypes.dtype != np.float32 or prototypes.ndim != 2 or prototypes.shape[1] != width:
        return f"prototypes are {prototypes.dtype}{list(prototypes.shape)}, not float32[P, {width}]"
    if not 0 < len(prototypes) <= PROTOTYPES_MAX or width > _WIDTH_MAX:
        return f"{len(prototypes)} prototypes of {width} values are not at most {PROTOTYPES_MAX}"
    if not np.isfinite(prototypes).all():
        return "prototypes hold NaN or infinity"
    numbers = {"scale": known.scale, "distance_max": known.distance_max}
    if (pattern := known.pattern) is not None:
        terms = width * (width + 3) // 2
        for name, array, shape in (
            ("pattern_centre", pattern.centre, (terms,)),
            ("pattern_weights", pattern.weights, (terms, terms)),
        ):
            if array.dtype != np.float32 or array.shape != shape:
                return f"{name} is {array.dtype}{list(array.shape)}, not float32{list(shape)}"
            if not np.isfinite(array).all():
                return f"{name} holds NaN or infinity"
        numbers |= {"pattern_scale": pattern.scale, "pattern_most": pattern.most}
    for name, value in numbers.items():
        if not (math.isfinite(value) and value > 0):
            return f"{name} is {value}, not a positive number"
    return ""


def _pattern_of(arrays: Mapping[str, Any]) -> InputPattern | None:
    if not any(name.startswith("pattern") for name in arrays):
        return None
    return InputPattern(
        float(arrays["pattern_scale"]),
        arrays["pattern_centre"],
        arrays["pattern_weights"],
        float(arrays["pattern_most"]),
    )


def parse_training_range(
    values: object, inputs: tuple[TensorInfo, ...], outputs: tuple[TensorInfo, ...]
) -> TrainingRange:
    """The key ``training_range`` of a manifest.

    Raises:
        ValueError: It is not one, or not of these inputs and outputs; says why.
    """
    if not isinstance(values, dict):
        raise ValueError("training_range is not an object")
    known = {"source", "data_sha256", "rows", "inputs", "outputs", "combinations"}
    if set(values) != known:
        raise ValueError(f"training_range has keys {sorted(values)}, not {sorted(known)}")
    rows, combinations = values["rows"], values["combinations"]
    if isinstance(rows, bool) or not isinstance(rows, int) or not 0 < rows < 1 << 53:
        raise ValueError(f"training_range: rows is {rows!r}, not a positive whole number")
    if not isinstance(combinations, bool):
        raise ValueError("training_range: combinations is not true or false")
    for key in ("source", "data_sha256"):
        if not isinstance(values[key], str):
            raise ValueError(f"training_range: {key} is not a text")
    return TrainingRange(
        values["source"],
        values["data_sha256"],
        rows,
        _value_ranges(values["inputs"], inputs, "inputs"),
        _value_ranges(values["outputs"], outputs, "outputs"),
        combinations,
    )


def _value_ranges(
    values: object, tensors: tuple[TensorInfo, ...], side: str
) -> tuple[ValueRange, ...]:
    if not isinstance(values, list) or len(values) > len(tensors):
        raise ValueError(f"training_range: {side} is no list of at most {len(tensors)} ranges")
    widths = {tensor.name: tensor.shape[1] for tensor in tensors}
    ranges = tuple(_value_range(item, widths, side) for item in values)
    if len({one.name for one in ranges}) != len(ranges):
        raise ValueError(f"training_range: {side} names a tensor twice")
    return ranges


def _value_range(item: object, widths: Mapping[str, int], side: str) -> ValueRange:
    if not isinstance(item, dict) or set(item) != {"name", "unit", "low", "high", "length_max"}:
        raise ValueError(f"training_range: {side} holds {str(item)[:80]!r}, which is no range")
    name = item["name"]
    if name not in widths:
        raise ValueError(f"training_range: the model has no tensor {str(name)[:64]!r} in {side}")
    low, high = (_numbers(item[key], name) for key in ("low", "high"))
    if len(low) != len(high) or len(low) not in (0, widths[name]):
        raise ValueError(f"training_range of {name}: {len(low)} and {len(high)} ends of its values")
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"training_range of {name}: an end lies on the wrong side")
    (length_max,) = _numbers([item["length_max"]], name)
    if length_max < 0 or not (low or length_max):
        raise ValueError(f"training_range of {name} says nothing")
    return ValueRange(name, str(item["unit"]), low, high, length_max)


def _numbers(values: Any, name: str) -> tuple[float, ...]:
    good = isinstance(values, list) and all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e30
        for value in values
    )
    if not good:
        raise ValueError(f"training_range of {name} is no list of finite numbers")
    return tuple(map(float, values))
