"""Damaged tapes, tapes of other schemas, and files that are none: a typed error, nothing else."""

from __future__ import annotations

import importlib
import io
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from palpate.errors import DatasetError
from palpate.files import tape as tape_file
from palpate.files.tape import read_tape, write_tape
from palpate.files.tape_build import build_tape

sys.path.append(str(Path(__file__).parent))
fakes: Any = importlib.import_module("tape_arrays")


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Bytes of a tape."""
    path = tmp_path_factory.mktemp("tape") / "a.npz"
    write_tape(path, build_tape(**fakes.arrays()))
    return path.read_bytes()


@given(
    at=st.integers(0, 10**6),
    bits=st.lists(st.integers(0, 7), min_size=1, max_size=3, unique=True),
)
@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_flipped_bits_change_nothing_or_are_told(
    image: bytes, tmp_path: Path, at: int, bits: list[int]
) -> None:
    data = bytearray(image)
    for bit in bits:
        data[at % len(data)] ^= 1 << bit
    _same_or_told(bytes(data), image, tmp_path)


@given(length=st.integers(0, 10**6))
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_truncated_tapes_are_told(image: bytes, tmp_path: Path, length: int) -> None:
    path = tmp_path / "cut.npz"
    path.write_bytes(image[: length % len(image)])
    with pytest.raises(DatasetError, match=r"cut\.npz"):
        read_tape(path)


@given(data=st.binary(max_size=300))
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_other_bytes_are_told(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "other.npz"
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=r"other\.npz"):
        read_tape(path)


def _same_or_told(data: bytes, image: bytes, folder: Path) -> None:
    good, bad = folder / "good.npz", folder / "bad.npz"
    good.write_bytes(image)
    bad.write_bytes(data)
    try:
        read = read_tape(bad)
    except DatasetError as error:
        told = str(error)
    else:
        assert fakes.plain(read) == fakes.plain(read_tape(good))
        return
    assert "bad.npz" in told
    assert "->" in told


def rewritten(image: bytes, change: Callable[[dict[str, Any], dict[str, Any]], None]) -> bytes:
    """The tape with another header or other arrays and a digest that fits them."""
    with np.load(io.BytesIO(image)) as archive:
        members = {name: archive[name] for name in archive.files}
    header = json.loads(members.pop("header").tobytes())
    change(header, members)
    if header.get("sha256") and members.keys() == tape_file.UNITS.keys():
        header["sha256"] = tape_file._digest(header, members).hex()
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=True, header=text, **members)
    return buffer.getvalue()


def setting(array: str, index: Any, value: Any) -> Callable[[Any, Any], None]:
    """Changes one place of an array."""

    def change(header: Any, members: Any) -> None:
        members[array] = members[array].copy()
        members[array][index] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h, m: h.update(schema="palpate.simulations"), "not of schema palpate.tape"),
        (lambda h, m: h.update(version=2), "version 2.*knows 1 -> upgrade palpate"),
        (lambda h, m: h.update(version="x"), "version 'x'"),
        (lambda h, m: h.update(frame="world"), "not in the sensor frame"),
        (lambda h, m: h["units"].update(force="lbf"), "not in the sensor frame and SI units"),
        (lambda h, m: h.pop("source"), "missing or unknown: source"),
        (lambda h, m: h.update(more=1), "missing or unknown: more"),
        (lambda h, m: h.update(trajectories=[]), "is no tape"),
        (lambda h, m: h.update(trajectories=5), "is no tape"),
        (lambda h, m: h["fingers"][0].pop("creep_tau_s"), "is no tape"),
        (lambda h, m: h["fingers"][0].update(creep_tau_s=0.0), "'biotac1'.*creep_tau_s"),
        (lambda h, m: h["fingers"][0].update(noise_counts="x"), "noise_counts = 'x'"),
        (lambda h, m: h["fingers"][0].update(parameters="[]"), "parameters is no JSON object"),
        (lambda h, m: h["fingers"][1].update(name="biotac1"), "'biotac1' is there twice"),
        (lambda h, m: h["trajectories"][1].update(id="p0"), "'p0' is there twice"),
        (lambda h, m: h["trajectories"][1].update(indenter=""), "'p1': indenter"),
        (lambda h, m: h.update(rest_pressure_pa=float("nan")), "rest_pressure_pa"),
        (lambda h, m: h.update(rest_pressure_pa="1"), "rest_pressure_pa"),
        (lambda h, m: h.update(rest_pressure_pa=1900.0), "at step 0 is not rest_pressure_pa"),
        (lambda h, m: h.update(mesh_sha256="00"), "mesh_sha256 is not 32 bytes"),
        (lambda h, m: h.update(mesh_sha256="zz"), "is no tape"),
        (lambda h, m: m.pop("torque"), "missing or unknown: torque"),
        (lambda h, m: m.update(extra=np.zeros(1)), "missing or unknown: extra"),
        (lambda h, m: m.update(force=m["force"].astype(np.float64)), "force is float64"),
        (lambda h, m: m.update(force=m["force"][:, :2]), "force has shape"),
        (lambda h, m: m.update(poses=m["poses"][:-1]), "same number of steps"),
        (lambda h, m: m.update(steps=np.array([20, -10], np.int32)), "same number of steps"),
        (lambda h, m: m.update(steps=np.array([1, 9], np.int32)), "'p0': poses has one step"),
        (lambda h, m: m.update(modes=m["modes"][:, :-1]), "modes has shape"),
        (lambda h, m: m.update(force=np.array([{}], object)), "no tape or damaged"),
        (setting("force", (0, 1), 1.0), "'p0': force or torque is not zero"),
        (setting("counts", (1, 5, 3), 7.0), "'p1': counts at step 0.*'biotac2'"),
        (setting("coefficients", (0, 0), 1e3), "'p0': coefficients at step 0"),
        (setting("coefficients", (1, 0), np.inf), "coefficients is not finite"),
        (setting("poses", (3, 3), 0.5), "quaternion"),
        (setting("outer_faces", (0, 0), 9), "outer_faces names nodes outside"),
    ],
)
def test_other_tapes_are_told(
    image: bytes, tmp_path: Path, change: Callable[[Any, Any], None], message: str
) -> None:
    path = tmp_path / "odd.npz"
    path.write_bytes(rewritten(image, change))
    with pytest.raises(DatasetError, match=rf"odd\.npz.*{message}"):
        read_tape(path)


def test_content_that_its_digest_does_not_fit_is_told(image: bytes, tmp_path: Path) -> None:
    def edit(header: Any, members: Any) -> None:
        members["nodes"] = members["nodes"] * np.float32(1.001)

    whole = rewritten(image, edit)
    with np.load(io.BytesIO(image)) as archive:
        old = archive["header"]
    with (
        zipfile.ZipFile(io.BytesIO(whole)) as archive,
        zipfile.ZipFile(tmp_path / "a.npz", "w") as out,
    ):
        for name in archive.namelist():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, old)
            out.writestr(name, buffer.getvalue() if name == "header.npy" else archive.read(name))
    with pytest.raises(DatasetError, match="not what its digest says"):
        read_tape(tmp_path / "a.npz")
