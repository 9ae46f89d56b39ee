"""Archives, headers and numbers of strangers: a ValueError or a typed error, nothing else."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.errors import BundleError, ConfigError, DatasetError
from palpate.files import bounded
from palpate.files.bounded import arrays_of_npz, parse_json
from palpate.files.bundle import mesh_from_bytes
from palpate.files.hdf5 import Hdf5Schema, opened
from palpate.files.tape import read_tape


def archive(content: bytes, method: int = zipfile.ZIP_STORED, members: int = 1) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as file:
        for number in range(members):
            file.writestr(f"nodes{number}.npy", content)
    return buffer.getvalue()


def array(values: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def head(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def damaged_lzma() -> bytes:
    data = bytearray(archive(array(np.arange(300)), zipfile.ZIP_LZMA))
    data[60:120] = bytes(byte ^ 0x5A for byte in data[60:120])
    return bytes(data)


BAD = {
    "LZMA": archive(array(np.arange(300)), zipfile.ZIP_LZMA),
    "LZMA that is damaged": damaged_lzma(),
    "header that does not end": archive(head("{'descr': (\n")),
    "text that does not end": archive(head("{'descr': '''\n")),
    "keys of two kinds": archive(head("{1: 2, 'a': 3}\n")),
    "size beyond all": archive(
        head(f"{{'descr': '<f4', 'fortran_order': False, 'shape': (0, {2**70})}}\n")
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_archive_is_told(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nodes0|packed|dimension"):
        arrays_of_npz(BAD[name], 1 << 20)
    with pytest.raises(BundleError, match=r"mesh\.npz"):
        mesh_from_bytes(BAD[name], "mesh.npz")
    tape = tmp_path / "odd.npz"
    tape.write_bytes(BAD[name])
    with pytest.raises(DatasetError, match=r"odd\.npz is no tape or damaged"):
        read_tape(tape)


def test_all_arrays_of_a_tape_together_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None of them is expanded: sixty of 200 MiB would have taken all the memory."""
    monkeypatch.setattr(bounded, "_array", lambda name, _: pytest.fail(f"{name} was expanded"))
    monkeypatch.setattr("palpate.files.tape._ARRAYS_BYTES_MAX", 1 << 20)
    path = tmp_path / "large.npz"
    path.write_bytes(archive(bytes(800 << 10), zipfile.ZIP_DEFLATED, members=2))
    with pytest.raises(DatasetError, match="1,638,400 bytes, 1,048,576 are allowed"):
        read_tape(path)


def test_a_tape_that_is_a_fifo_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "tape.npz")
    with pytest.raises(ConfigError, match=r"tape\.npz.*not a regular file"):
        read_tape(tmp_path / "tape.npz")


@pytest.mark.parametrize("text", [b"1e999", b'{"a": [-1e400]}', b"NaN", b"Infinity"])
def test_numbers_of_json_are_finite(text: bytes) -> None:
    with pytest.raises(ValueError, match="is not a number of JSON"):
        parse_json(text)


@pytest.mark.parametrize("version", ["one", [1, 2], float("nan"), float("inf")])
def test_a_version_that_is_no_number_is_told(version: Any, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.attrs["schema"], file.attrs["schema_version"] = "palpate.features", version
    with (
        pytest.raises(DatasetError, match=r"a\.h5: attribute schema_version is no whole number"),
        opened(path, extra="fem") as file,
    ):
        Hdf5Schema("palpate.features", 1, "make it again").check(path, file)
