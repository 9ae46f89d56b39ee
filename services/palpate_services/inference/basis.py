"""The basis of a field bundle's coefficients: constants of its graph, read from the ONNX file.

They lie in the model already, so no second file holds them, and the digest covers them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.errors import BundleError
from palpate.files.bundle import Bundle
from palpate.messages import FloatArray, ModeBasis
from palpate_services.inference.onnx_file import onnx_fields, varints

_GRAPH, _INITIALIZER = 7, 5  # numbers of onnx.proto, which never change
_DIMS, _TYPE, _NAME, _RAW = 1, 2, 8, 9
_DTYPES: dict[int, np.dtype[np.floating]] = {
    1: np.dtype(np.float32),
    10: np.dtype(np.float16),
}
_TOLERANCE = 1e-4
_PART_BYTES = 2 << 20

_REMEDY = "export the bundle again with palpate train field"


@dataclass(frozen=True, slots=True)
class Basis:
    """displacement = mean + coefficients x modes.

    Attributes:
        mean: [m], float32, shape ``(3V,)``.
        modes: Dimensionless, as the file has them, shape ``(K, 3V)``.
        sha256: Of both as float32, 32 bytes.
    """

    mean: FloatArray
    modes: npt.NDArray[np.floating]
    sha256: bytes

    def parts(self, mesh_sha256: bytes) -> Iterator[ModeBasis]:
        """The basis in messages of moderate size."""
        count, width = self.modes.shape
        each = max(1, _PART_BYTES // (4 * width))
        for first in range(0, count, each):
            modes = self.modes[first : first + each].astype(np.float32)
            yield ModeBasis(
                self.sha256,
                mesh_sha256,
                self.mean.reshape(-1, 3) if first == 0 else None,
                modes.reshape(len(modes), -1, 3),
                count,
                first,
                first + len(modes) < count,
            )


def basis_of(bundle: Bundle) -> Basis | None:
    """The basis of a bundle; None if its model gives no coefficients.

    Raises:
        BundleError: The graph has no such constants, or they are not what decodes the golden
            coefficients.
    """
    names = bundle.manifest.basis
    if not names:
        return None
    label = f"bundle {bundle.manifest.name}:{bundle.manifest.version}"
    found = _constants(bundle.model, names)
    mean, modes = found.get("mean"), found.get("modes")
    golden = bundle.golden
    wanted, coefficients = golden["displacement"], golden["coefficients"]
    shape = (coefficients.shape[1], wanted.shape[1])
    if mean is None or modes is None or modes.shape != shape or mean.shape != shape[1:]:
        raise BundleError(
            f"{label}: model.onnx has no constants {sorted(names.values())} of a basis of "
            f"{shape[0]} modes and {shape[1]} values",
            remedy=_REMEDY,
        )
    wide = modes.astype(np.float32)
    decoded = coefficients @ wide + mean
    if not np.abs(decoded - wanted).max() <= _TOLERANCE * np.abs(wanted).max():
        raise BundleError(
            f"{label}: its basis does not decode its golden coefficients", remedy=_REMEDY
        )
    mean = mean.astype(np.float32)
    return Basis(mean, modes, hashlib.sha256(mean.tobytes() + wide.tobytes()).digest())


def _constants(model: bytes, names: Mapping[str, str]) -> dict[str, npt.NDArray[np.floating]]:
    """Constants of the graph: by the key in ``names``, whose value is the name in the graph."""
    wanted = {name.encode(): key for key, name in names.items()}
    found: dict[str, npt.NDArray[np.floating]] = {}
    for number, graph in onnx_fields(memoryview(model)):
        if number != _GRAPH or not isinstance(graph, memoryview):
            continue
        for inside, tensor in onnx_fields(graph):
            if inside == _INITIALIZER and isinstance(tensor, memoryview):
                _take(tensor, wanted, found)
    return found


def _take(
    tensor: memoryview, wanted: Mapping[bytes, str], found: dict[str, npt.NDArray[np.floating]]
) -> None:
    """Keep a constant, if it is wanted and holds its values as raw bytes of a known type."""
    dims: list[int] = []
    kind, name, raw = 0, b"", None
    for number, value in onnx_fields(tensor):
        if isinstance(value, memoryview):
            if number == _NAME:
                name = bytes(value)
            elif number == _RAW:
                raw = value
            elif number == _DIMS:  # packed
                dims += varints(value)
        elif number == _DIMS:
            dims.append(value)
        elif number == _TYPE:
            kind = value
    if name not in wanted or raw is None or kind not in _DTYPES:
        return
    dtype = _DTYPES[kind]
    size = int(np.prod(dims, dtype=np.int64))
    if size * dtype.itemsize == len(raw):
        found[wanted[name]] = np.frombuffer(raw, dtype).reshape(dims)
