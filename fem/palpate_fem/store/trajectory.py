"""One trajectory of the store: HDF5 group to `IndentationResult` and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from palpate import __version__
from palpate.files.hdf5 import set_attributes, text
from palpate_fem.result import Convergence, IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.store.content import Outline, TrajectorySummary
from palpate_fem.store.hdf5 import PACKED, create

SCALAR_FIELDS = {
    "pose": "m, 1",
    "force": "N",
    "torque": "N m",
    "fluid_pressure_pa": "Pa",
    "contact_area_m2": "m^2",
    "centre_of_pressure": "m",
}
"""A few numbers for each step, float64."""

NODAL_FIELDS = {"displacement": "m", "indenter_force": "N", "core_force": "N"}
"""Three numbers for each step and node, float32, a chunk for each step."""

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
        nodes: Nodes of the mesh; what the fields of no step at all would have.
        fingertip: Key of the fingertip that it was run on.
        sensor: Name of the BioTac it was measured on; empty = simulated.
        outline: The indenter's surface, for pictures.
        stress: Whether to keep the stress, which doubles the size.
    """
    steps = trajectory.steps
    told = ("indenter", "reason", "travel_m", "seconds")
    set_attributes(
        group,
        {
            **{name: getattr(trajectory, name) for name in told},
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
    """Read what is quick to read; a measured trajectory needs only pose, force and indenter."""
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
    """Read all of one trajectory; stress has no rows where it was not kept."""
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
    """One chunk a step, so that a step is read alone; written one by one to save memory."""
    count = len(values)
    chunks = {"chunks": (1, *shape), **PACKED} if count else {}
    dataset = group.create_dataset(name, shape=(count, *shape), dtype=np.float32, **chunks)
    for at, value in enumerate(values):
        dataset[at] = value
    set_attributes(dataset, {"unit": unit})
