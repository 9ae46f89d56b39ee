"""Bundles that try to hang, to fill the memory, to lie or to act on the terminal.

Each is made from a good bundle of the task ``features`` by one change; the digests in its manifest
are right unless the case is about them, so that the change itself has to be found.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import socket
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from palpate.files.tasks import TASKS, tensors_of

Files = dict[str, bytes]
Case = Callable[[Path], None]

WEIGHTS = np.random.default_rng(1).normal(0, 0.01, (19, 3)).astype(np.float32)


def _values(task: str = "features", nodes: int = 0) -> dict[str, Any]:
    inputs, outputs = (
        tensors_of(task, nodes) if nodes else (TASKS[task].inputs, TASKS[task].outputs)
    )
    return {
        "name": "hostile",
        "version": 1,
        "task": task,
        "inputs": [_tensor(tensor) for tensor in inputs],
        "outputs": [_tensor(tensor) for tensor in outputs],
        "sensor_type": "BIOTAC",
        "contact_threshold_n": 0.2,
        "training_data_sha256": "00" * 32,
        "trained_on": "nothing",
        "metrics": {"force_median_n": 0.1},
        "created": "2026-11-22T00:00:00+00:00",
        "palpate_version": "0.1.0",
        "opset": 17,
        "normalisation": {},
        "contract_version": 1,
    }


def _tensor(tensor: Any) -> dict[str, Any]:
    return {
        "name": tensor.name,
        "dtype": tensor.dtype,
        "shape": list(tensor.shape),
        "unit": tensor.unit,
    }


def _graph(nodes: list[Any], tensors: list[Any], source: str) -> bytes:
    """A model of the task features; ``nodes`` compute ``source``, a value to add to the force."""
    weights = [numpy_helper.from_array(WEIGHTS, "w"), *tensors]
    nodes = [
        *nodes,
        helper.make_node("MatMul", ["electrodes", "w"], ["raw"]),
        helper.make_node("Add", ["raw", source], ["force"]),
        helper.make_node("Abs", ["force"], ["force_sd"]),
    ]
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "hostile",
        [value("electrodes", TensorProto.FLOAT, ["N", 19])],
        [value(name, TensorProto.FLOAT, ["N", 3]) for name in ("force", "force_sd")],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    return bytes(model.SerializeToString())


def good_model() -> bytes:
    """A model that works."""
    return _graph([], [numpy_helper.from_array(np.zeros(1, np.float32), "zero")], "zero")


def _endless() -> bytes:
    """A Loop that runs 2^63 times."""
    value = helper.make_tensor_value_info
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["on"], ["on_next"]),
            helper.make_node("Sin", ["state"], ["state_next"]),
        ],
        "body",
        [
            value("at", TensorProto.INT64, []),
            value("on", TensorProto.BOOL, []),
            value("state", TensorProto.FLOAT, [1]),
        ],
        [value("on_next", TensorProto.BOOL, []), value("state_next", TensorProto.FLOAT, [1])],
    )
    tensors = [
        numpy_helper.from_array(np.array(2**63 - 1, np.int64), "trips"),
        numpy_helper.from_array(np.array(True), "yes"),
        numpy_helper.from_array(np.ones(1, np.float32), "one"),
    ]
    loop = helper.make_node("Loop", ["trips", "yes", "one"], ["state_end"], body=body)
    return _graph([loop], tensors, "state_end")


def _greedy(values: int, *, at_load: bool) -> bytes:
    """A model that asks for ``values`` floats, when it is loaded or when it runs."""
    shape = numpy_helper.from_array(np.array([values], np.int64), "size")
    nodes, source = [], "size"
    if not at_load:  # a size that depends on the input cannot be folded into a constant
        nodes = [
            helper.make_node("ReduceSum", ["electrodes"], ["sum"], keepdims=0),
            helper.make_node("Mul", ["sum", "zero"], ["nothing"]),
            helper.make_node("Cast", ["nothing"], ["none"], to=TensorProto.INT64),
            helper.make_node("Add", ["size", "none"], ["asked"]),
        ]
        source = "asked"
    nodes += [
        helper.make_node("ConstantOfShape", [source], ["zeros"]),
        helper.make_node("ReduceSum", ["zeros"], ["total"], keepdims=1),
    ]
    zero = numpy_helper.from_array(np.zeros((), np.float32), "zero")
    return _graph(nodes, [shape, zero], "total")


def _external() -> bytes:
    model = onnx.load_model_from_string(good_model())
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/hostname")
    return bytes(model.SerializeToString())


def _nested_graphs(depth: int) -> bytes:
    """A protobuf of graphs in attributes of nodes of graphs ..."""
    inside = b""
    for _ in range(depth):
        for number in (6, 5, 1):  # attribute.g, node.attribute, graph.node
            inside = bytes([number << 3 | 2]) + _varint(len(inside)) + inside
    return bytes([7 << 3 | 2]) + _varint(len(inside)) + inside


def _varint(value: int) -> bytes:
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def golden_bytes(shift: float = 0.0) -> bytes:
    """Golden vectors of the good model."""
    electrodes = np.random.default_rng(7).normal(0, 100, (8, 19)).astype(np.float32)
    force = (electrodes @ WEIGHTS).astype(np.float32)
    buffer = io.BytesIO()
    np.savez(buffer, electrodes=electrodes, force=force + shift, force_sd=np.abs(force))
    return buffer.getvalue()


def _zip(members: dict[str, bytes], *, compress: bool = False) -> bytes:
    buffer = io.BytesIO()
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def _header(text: str) -> bytes:
    code = text.encode()
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(code)) + code


def _claims(shape: str, dtype: str = "'<f4'") -> bytes:
    return _header(f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}}}\n")


_BLOCK = 1 << 24


def _expanding(name: str, head: bytes, size: int) -> bytes:
    """A zip with one member: ``head``, then ``size`` zeros, a thousandth of it on disk.

    Written by hand, because to compress gigabytes of zeros takes half a minute.
    """
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    begin = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(_BLOCK)) + packer.flush(zlib.Z_FULL_FLUSH)
    data = begin + block * (size // _BLOCK) + packer.flush()
    crc = zlib.crc32(head)
    for _ in range(size // _BLOCK):
        crc = zlib.crc32(bytes(_BLOCK), crc)
    code = name.encode()
    sizes = struct.pack("<III", crc, len(data), len(head) + size // _BLOCK * _BLOCK)
    common = struct.pack("<HHHHH", 20, 0, 8, 0, 0) + sizes + struct.pack("<HH", len(code), 0)
    local = b"PK\x03\x04" + common + code + data
    entry = b"PK\x01\x02" + struct.pack("<H", 20) + common + struct.pack("<HHHII", 0, 0, 0, 0, 0)
    end = struct.pack("<HHHHIIH", 0, 0, 1, 1, len(entry) + len(code), len(local), 0)
    return local + entry + code + b"PK\x05\x06" + end


def _bomb(gigabytes: int) -> bytes:
    """An array of zeros, a thousandth of it on disk."""
    size = gigabytes << 30
    return _expanding("electrodes.npy", _claims(f"({size // 4},)"), size)


def _says_little(data: bytes) -> bytes:
    """A zip whose directory says that its member has 100 bytes, whatever it expands to."""
    out = bytearray(data)
    at = out.rfind(b"PK\x01\x02")
    out[at + 24 : at + 28] = struct.pack("<I", 100)
    return bytes(out)


def _object_array() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.array([{"a": 1}], object), allow_pickle=True)
    return _zip({"electrodes.npy": buffer.getvalue(), "x.pkl": pickle.dumps({"a": 1})})


def _write(
    folder: Path,
    *,
    model: bytes | None = None,
    golden: bytes | None = None,
    mesh: bytes | None = None,
    text: bytes | None = None,
    values: dict[str, Any] | None = None,
    **changes: Any,
) -> None:
    """Write a bundle in which everything that is not given is good."""
    folder.mkdir(parents=True, exist_ok=True)
    model = good_model() if model is None else model
    golden = golden_bytes() if golden is None else golden
    said = {
        **(_values() if values is None else values),
        "model_sha256": hashlib.sha256(model).hexdigest(),
        "golden_sha256": hashlib.sha256(golden).hexdigest(),
    }
    files: Files = {"model.onnx": model, "golden.npz": golden}
    if mesh is not None:
        files["mesh.npz"] = mesh
        said |= {"mesh_sha256": "11" * 32, "mesh_file_sha256": hashlib.sha256(mesh).hexdigest()}
    said |= changes
    files["manifest.json"] = json.dumps(said).encode() if text is None else text
    for name, data in files.items():
        (folder / name).write_bytes(data)


def _instead(name: str, make: Callable[[Path], None]) -> Case:
    """A bundle in which ``make`` puts something else in the place of a file."""

    def write(folder: Path) -> None:
        _write(folder)
        (folder / name).unlink()
        make(folder / name)

    return write


def _sparse(size: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        with open(path, "wb") as file:
            file.truncate(size)

    return make


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as end:
        here = os.open(path.parent, os.O_RDONLY)
        try:  # the path of a socket has at most 107 bytes
            end.bind(f"/proc/self/fd/{here}/{path.name}")
        finally:
            os.close(here)


def _outside(path: Path) -> None:
    target = path.parent.parent / "elsewhere.npz"
    target.write_bytes(golden_bytes())
    path.symlink_to(target)


def _mesh_bomb() -> bytes:
    return _expanding("nodes.npy", _claims("(100663296, 3)"), 9 * (1 << 27))


def _nested(depth: int) -> dict[str, Any]:
    value: dict[str, Any] = {}
    for _ in range(depth):
        value = {"a": value}
    return value


def _with(**changes: Any) -> Case:
    return lambda folder: _write(folder, **changes)


def _lazy(part: str, make: Callable[[], bytes], **more: Any) -> Case:
    def write(folder: Path) -> None:
        given: dict[str, Any] = {part: make(), **more}
        _write(folder, **given)

    return write


CASES: dict[str, Case] = {
    "manifest is a FIFO": _instead("manifest.json", os.mkfifo),
    "model is a FIFO": _instead("model.onnx", os.mkfifo),
    "golden is a link to /dev/zero": _instead("golden.npz", lambda p: p.symlink_to("/dev/zero")),
    "golden is a link to another folder": _instead("golden.npz", _outside),
    "model is a socket": _instead("model.onnx", _socket),
    "manifest is a folder": _instead("manifest.json", lambda p: p.mkdir()),
    "manifest of 2 GB": _instead("manifest.json", _sparse(2 << 30)),
    "model of 100 GB": _instead("model.onnx", _sparse(100 << 30)),
    "JSON nested 100,000 deep": _with(text=b"[" * 100_000 + b"]" * 100_000),
    "JSON objects nested 900 deep": _with(normalisation=_nested(900)),
    "number of 20,000 digits": _with(text=b'{"version": ' + b"9" * 20_000 + b"}"),
    "a key twice": _with(text=b'{"name": "a", "name": "b"}'),
    "threshold NaN": _with(contact_threshold_n=float("nan")),
    "threshold negative": _with(contact_threshold_n=-0.2),
    "threshold 1e30 N": _with(contact_threshold_n=1e30),
    "version '1; rm -rf'": _with(version="1; rm -rf ~"),
    "name '../../evil'": _with(name="../../evil"),
    "ANSI escapes in a text": _with(trained_on="\x1b[2J\x1b]0;owned\x07 good data"),
    "direction override in a text": _with(trained_on="\u202egnp.atad"),
    "escapes in an unknown task": _with(task="\x1b[31mfeatures"),
    "unknown type of sensor": _with(sensor_type="GELSIGHT"),
    "metric infinite": _with(metrics={"force_median_n": float("inf")}),
    "tensor of 10^30 values": _with(
        inputs=[{"name": "electrodes", "dtype": "float32", "shape": [-1, 10**30], "unit": "n"}]
    ),
    "golden expands to 3 GB": _lazy("golden", lambda: _bomb(3)),
    "golden says 100 bytes, expands to 3 GB": _lazy("golden", lambda: _says_little(_bomb(3))),
    "golden header of 4 TB": _lazy(
        "golden", lambda: _zip({"electrodes.npy": _claims("(1099511627776,)")})
    ),
    "golden header nested deeply": _lazy(
        "golden", lambda: _zip({"electrodes.npy": _header("(" * 2000 + ")" * 2000)})
    ),
    "golden header of 60 MB": _lazy(
        "golden",
        lambda: _zip({"electrodes.npy": _header("{" + " " * 60_000_000 + "}")}, compress=True),
    ),
    "golden with a pickle": _lazy("golden", _object_array),
    "golden of 5,000 arrays": _lazy(
        "golden", lambda: _zip({f"a{k}.npy": _claims("(0,)") for k in range(5000)})
    ),
    "golden cut off": _lazy("golden", lambda: golden_bytes()[:-40]),
    "mesh expands to 1.2 GB": _lazy(
        "mesh", _mesh_bomb, values=_values("field", nodes=4), normalisation={}
    ),
    "Loop that never ends": _lazy("model", _endless),
    "100 GB at load": _lazy("model", lambda: _greedy(25_000_000_000, at_load=True)),
    "2 GB folded at load": _lazy("model", lambda: _greedy(500_000_000, at_load=True)),
    "100 GB at run": _lazy("model", lambda: _greedy(25_000_000_000, at_load=False)),
    "2 GB at run": _lazy("model", lambda: _greedy(500_000_000, at_load=False)),
    "weights in /etc/hostname": _lazy("model", _external),
    "graphs nested 5,000 deep": _lazy("model", lambda: _nested_graphs(5000)),
    "model of random bytes": _lazy(
        "model", lambda: np.random.default_rng(1).integers(0, 256, 10_000, np.uint8).tobytes()
    ),
    "golden of another model": _lazy("golden", lambda: golden_bytes(shift=1.0)),
}
"""What is wrong, and the function that writes it into a folder."""


def write_good(folder: Path) -> None:
    """A bundle with nothing wrong: the control."""
    _write(folder)
