"""Schema ``palpate.simulations`` version 1: HDF5 groups to Python values and back.

docs/simulation-store.md describes the same in words. This module knows groups only; files and
folders are the business of ``store.writer`` and ``palpate.files.simulation_store``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np

from palpate import __version__
from palpate.files.hdf5 import set_attributes, text
from palpate.files.simulation_store import SIMULATIONS
from palpate_fem.config import FingertipParameters
from palpate_fem.mesh.solid import SolidMesh
from palpate_fem.result import Convergence, IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.store.content import Outline, StoredFingertip, TrajectorySummary, named_values

LIBVER = ("v110", "v110")
"""Readable since HDF5 1.10 (2016); the format before it has no checksums of its own structure."""

PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True, "fletcher32": True}
"""Small arrays are packed too, for the checksum: a flipped bit is an error, not a wrong force."""

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

_IMAGES = itertools.count()


def file_image(fill: Callable[[Any], None], *, command: str) -> bytes:
    """Bytes of an HDF5 file with our header.

    Made in memory: HDF5 writes out of order, so a file on the disk would be invalid until closed.

    Args:
        fill: Writes into the open file.
        command: Command line that makes it, for provenance.
    """
    name = f"image {next(_IMAGES)}"  # HDF5 refuses the name of a file that another thread has open
    with h5py.File(name, "w", driver="core", backing_store=False, libver=LIBVER) as file:
        write_header(file, command=command)
        fill(file)
        file.flush()
        image: bytes = file.id.get_file_image()
    return image


def write_header(file: Any, *, command: str) -> None:
    """Write the attributes that every file has: schema, frame, version, command."""
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


SCALAR_FIELDS = {
    "pose": "m, 1",
    "force": "N",
    "torque": "N m",
    "fluid_pressure_pa": "Pa",
    "contact_area_m2": "m^2",
    "centre_of_pressure": "m",
}
"""Datasets with a few numbers for each step, float64, and their units."""

NODAL_FIELDS = {"displacement": "m", "indenter_force": "N", "core_force": "N"}
"""Datasets with three numbers for each step and node, float32, and their units."""

CONVERGENCE = np.dtype(
    [
        ("increments", "<i4"),
        ("iterations", "<i4"),
        ("factorisations", "<i4"),
        ("residual", "<f8"),
        ("volume_error", "<f8"),
        ("penetration_m", "<f8"),
        ("seconds", "<f8"),
    ]
)


def write_trajectory(
    group: Any,
    trajectory: IndentationResult,
    *,
    nodes: int,
    fingertip: str,
    sensor: str = "",
    outline: Outline | None = None,
    stress: bool = False,
) -> None:
    """Write one trajectory.

    Args:
        group: An empty group.
        trajectory: What to write.
        nodes: Number of nodes of the mesh; gives fields a shape if there is no step.
        fingertip: Key of the fingertip.
        sensor: Name of the BioTac it was measured on; empty = simulated.
        outline: The indenter's surface, for pictures.
        stress: Whether to keep stress, which doubles the size.
    """
    steps = trajectory.steps
    plain = ("indenter", "reason", "travel_m", "seconds")
    set_attributes(
        group,
        {
            **{name: getattr(trajectory, name) for name in plain},
            "outcome": trajectory.outcome.value,
            "complete": trajectory.outcome is IndentationOutcome.COMPLETE,
            "sensor": sensor,
            "fingertip": fingertip,
            "palpate": __version__,
        },
    )
    create(group, "path", np.asarray(trajectory.path, np.float64), "m, 1")
    shapes = {"pose": (7,), "fluid_pressure_pa": (), "contact_area_m2": ()}
    for name, unit in SCALAR_FIELDS.items():
        values = np.array([getattr(step, name) for step in steps], np.float64)
        create(group, name, values.reshape(len(steps), *shapes.get(name, (3,))), unit)
    table = np.zeros(len(steps), CONVERGENCE)
    for name in table.dtype.names or ():
        table[name] = [getattr(step.convergence, name) for step in steps]
    create(group, "convergence", table, "see names; seconds in s")
    for name, unit in NODAL_FIELDS.items():
        _create_stepwise(group, name, [getattr(step, name) for step in steps], (nodes, 3), unit)
    if stress and steps:
        tensors = [step.stress for step in steps]
        _create_stepwise(group, "stress", tensors, tensors[0].shape, "Pa")
    if outline is not None:
        create(group, "indenter_vertices", np.asarray(outline[0], np.float32), "m")
        create(group, "indenter_faces", np.asarray(outline[1], np.int32), "1")


def read_summary(trajectory: str, group: Any) -> TrajectorySummary:
    """Read poses and forces; a measured trajectory needs only pose, force and indenter."""
    pose, force = (group[name][()].astype(np.float64) for name in ("pose", "force"))
    pressure = group.get("fluid_pressure_pa")
    attributes = group.attrs
    outcome = IndentationOutcome(text(attributes.get("outcome", IndentationOutcome.COMPLETE.value)))
    return TrajectorySummary(
        id=trajectory,
        indenter=text(attributes["indenter"]),
        sensor=text(attributes.get("sensor", "")),
        outcome=outcome,
        reason=text(attributes.get("reason", "")),
        complete=bool(attributes.get("complete", outcome is IndentationOutcome.COMPLETE)),
        travel_m=float(attributes.get("travel_m", np.nan)),
        seconds=float(attributes.get("seconds", np.nan)),
        path=group["path"][()] if "path" in group else pose,
        pose=pose,
        force=force,
        fluid_pressure_pa=np.full(len(force), np.nan) if pressure is None else pressure[()],
    )


def read_trajectory(group: Any) -> IndentationResult:
    """Read a whole trajectory; stress has no rows if it was not stored."""
    table = group["convergence"][()]
    columns: dict[str, Any] = {
        name: group[name][()].astype(np.float64) for name in (*SCALAR_FIELDS, *NODAL_FIELDS)
    }
    for name in ("fluid_pressure_pa", "contact_area_m2"):
        columns[name] = columns[name].tolist()
    columns["stress"] = (
        group["stress"][()].astype(np.float64)
        if "stress" in group
        else np.zeros((len(table), 0, 6))
    )
    columns["convergence"] = [Convergence(*row) for row in table.tolist()]
    steps = tuple(
        IndentationStep(**{name: values[at] for name, values in columns.items()})
        for at in range(len(table))
    )
    return IndentationResult(
        indenter=text(group.attrs["indenter"]),
        path=group["path"][()],
        steps=steps,
        outcome=IndentationOutcome(text(group.attrs["outcome"])),
        reason=text(group.attrs["reason"]),
        travel_m=float(group.attrs["travel_m"]),
        seconds=float(group.attrs["seconds"]),
    )


def _create_stepwise(
    group: Any, name: str, values: list[Any], shape: tuple[int, ...], unit: str
) -> None:
    """Write a field with one chunk for each step, so that a step can be read alone."""
    count = len(values)
    chunks = {"chunks": (1, *shape), **PACKED} if count else {}
    dataset = group.create_dataset(name, shape=(count, *shape), dtype=np.float32, **chunks)
    for at, value in enumerate(values):
        dataset[at] = value
    set_attributes(dataset, {"unit": unit})
