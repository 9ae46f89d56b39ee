"""ONNX files read by hand: only their length prefixes, never the weights.

The ``onnx`` package is no dependency of the services.
"""

from __future__ import annotations

from collections.abc import Iterator

# Message type -> field number -> type of that field; numbers of onnx.proto, which never change.
_NESTED: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14  # fields of TensorProto
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types of protobuf


def has_external_data(model: bytes) -> bool:
    """Whether a model keeps weights outside its own bytes.

    No digest covers such weights, and ONNX Runtime reads them from the working directory even for a
    model that was loaded from bytes.

    Raises:
        ValueError: The bytes are no protobuf.
    """
    waiting = [("model", memoryview(model))]
    while waiting:
        kind, data = waiting.pop()
        for number, value in onnx_fields(data):
            if kind == "tensor":
                if number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value != 0):
                    return True
            elif isinstance(value, memoryview) and number in _NESTED[kind]:
                waiting.append((_NESTED[kind][number], value))
    return False


def onnx_fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Fields of one message of an ONNX file: number, and a number or the bytes inside.

    Raises:
        ValueError: The bytes are no protobuf.
    """
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        number, wire_type = tag >> 3, tag & 7
        if wire_type == _VARINT:
            value, at = _varint(data, at)
            yield number, value
            continue
        if wire_type == _BYTES:
            size, at = _varint(data, at)
        elif wire_type in (_FIXED64, _FIXED32):
            size = 8 if wire_type == _FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire_type} at byte {at}")
        if at + size > len(data):
            raise ValueError(f"field {number} exceeds its message at byte {at}")
        yield number, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data) and shift < 70:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError(f"number cut off at byte {at}")


def varints(data: memoryview) -> list[int]:
    """The numbers of a packed repeated field.

    Raises:
        ValueError: The bytes are none.
    """
    found, at = [], 0
    while at < len(data):
        value, at = _varint(data, at)
        found.append(value)
    return found
