"""Schema ``palpate.simulations`` version 1: HDF5 groups to values of Python and back.

docs/simulation-store.md is the same in words. Groups only; files and folders are others' business.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import h5py
import numpy as np

from palpate import __version__
from palpate.files.hdf5 import set_attributes, text
from palpate.files.simulation_store import SIMULATIONS
from palpate_fem.config import FingertipParameters
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.store.content import StoredFingertip, named_values

LIBVER = ("v110", "v110")
"""Readable since HDF5 1.10 (2016); the format before it has no checksums of its own structure."""

PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True, "fletcher32": True}
"""The checksum is why small arrays are packed too: a flipped bit is an error, not a force."""

MESH_UNITS = {
    "nodes": "m",
    "elements": "1",
    "outer_faces": "1",
    "outer_elements": "1",
    "inner_faces": "1",
    "inner_elements": "1",
    "fixed": "1",
    "mirror": "1",
}
FINGERTIP_UNITS = {**MESH_UNITS, "pressurised_nodes": "m", "core_vertices": "m", "core_faces": "1"}


def file_image(fill: Callable[[Any], None], *, command: str) -> bytes:
    """Bytes of an HDF5 file with our header.

    Made in memory: HDF5 writes out of order, so a file it has open is no file until it is closed.

    Args:
        fill: Writes into the open file.
        command: What made it, for people.
    """
    with h5py.File("image", "w", driver="core", backing_store=False, libver=LIBVER) as file:
        write_header(file, command=command)
        fill(file)
        file.flush()
        image: bytes = file.id.get_file_image()
    return image


def write_header(file: Any, *, command: str) -> None:
    """Attributes that every file has: schema, frame, maker."""
    set_attributes(file, {**SIMULATIONS.facts, "palpate": __version__, "command": command})


def write_fingertip(file: Any, tip: StoredFingertip) -> None:
    """Write group ``fingertip``."""
    group = file.create_group("fingertip")
    scalars = ("fluid_pressure_pa", "fluid_volume_m3", "total_thickness_m")
    names = {"mesh_name": tip.mesh.name, "mesh_sha256": tip.mesh.sha256.hex()}
    numbers = {name: float(getattr(tip, name)) for name in scalars}
    set_attributes(group, {"key": tip.key, **names, **numbers})
    set_attributes(group.create_group("parameters"), named_values(tip.parameters))
    set_attributes(group.create_group("settings"), tip.settings)
    for name, unit in FINGERTIP_UNITS.items():
        array = getattr(tip.mesh if name in MESH_UNITS else tip, name)
        create(group, name, array, unit)


def read_fingertip(file: Any) -> StoredFingertip:
    """Read group ``fingertip``."""
    group = file["fingertip"]
    arrays = {name: group[name][()] for name in FINGERTIP_UNITS}
    mesh = SolidMesh(
        **{name: arrays[name] for name in MESH_UNITS}, name=text(group.attrs["mesh_name"])
    )
    return StoredFingertip(
        mesh=mesh,
        parameters=FingertipParameters(
            **{name: float(value) for name, value in group["parameters"].attrs.items()}
        ),
        settings={name: _setting(value) for name, value in group["settings"].attrs.items()},
        **{name: arrays[name] for name in FINGERTIP_UNITS if name not in MESH_UNITS},
        fluid_pressure_pa=float(group.attrs["fluid_pressure_pa"]),
        fluid_volume_m3=float(group.attrs["fluid_volume_m3"]),
        total_thickness_m=float(group.attrs["total_thickness_m"]),
    )


def _setting(value: Any) -> bool | int | float | str:
    if isinstance(value, bytes):
        return text(value)
    plain: bool | int | float | str = value.item() if isinstance(value, np.generic) else value
    return plain


def create(group: Any, name: str, array: Any, unit: str) -> None:
    """Write an array with its unit."""
    dataset = group.create_dataset(name, data=array, **(PACKED if array.size else {}))
    set_attributes(dataset, {"unit": unit})
