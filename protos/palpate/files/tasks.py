"""Tasks: inputs and outputs of the model of each (docs/adr/0008-bundle.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from palpate.errors import BundleError
from palpate.messages import SensorType, TensorInfo

SENSOR_TYPE = SensorType.BIOTAC
"""Sensor whose electrodes are inputs and outputs; there are no tasks for a BioTac SP."""

BY_MESH = 0
"""Stands for a width that depends on the number of nodes of the bundle's mesh."""


@dataclass(frozen=True, slots=True)
class TaskContract:
    """Inputs and outputs of a model of this task.

    Attributes:
        inputs: Tensors it takes.
        outputs: Tensors it gives.
        optional: Outputs that may be absent together.
        per_node: Values per node of the tensors whose width is ``BY_MESH``; empty for a task
            without a mesh. A field's tensor is flat: x y z of node 0, x y z of node 1, ...
    """

    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    optional: tuple[TensorInfo, ...] = ()
    per_node: Mapping[str, int] = field(default_factory=dict)


def _tensor(name: str, width: int, unit: str) -> TensorInfo:
    return TensorInfo(name, "float32", (-1, width), unit)


_ELECTRODES = SENSOR_TYPE.layout.electrodes

TASKS: dict[str, TaskContract] = {
    "features": TaskContract(
        inputs=(_tensor("electrodes", _ELECTRODES, "tared counts"),),
        outputs=(_tensor("force", 3, "N"), _tensor("force_sd", 3, "N")),
        optional=(
            _tensor("contact_location", 3, "m"),
            _tensor("contact_location_sd", 3, "m"),
        ),
    ),
    "field": TaskContract(
        inputs=(_tensor("electrodes", _ELECTRODES, "tared counts"),),
        outputs=(_tensor("displacement", BY_MESH, "m"),),
        optional=(_tensor("displacement_sd", BY_MESH, "m"),),
        per_node={"displacement": 3, "displacement_sd": 1},
    ),
    "synthesis": TaskContract(
        inputs=(_tensor("displacement", BY_MESH, "m"),),
        outputs=(
            _tensor("tared_counts", _ELECTRODES, "tared counts"),
            _tensor("tared_counts_sd", _ELECTRODES, "tared counts"),
        ),
        per_node={"displacement": 3},
    ),
}
"""What each task's model takes and gives. Normalisation is inside the graph."""


def tensors_of(
    task: str, nodes: int, *, optional: bool = False
) -> tuple[tuple[TensorInfo, ...], tuple[TensorInfo, ...]]:
    """Inputs and outputs of a task on a mesh of so many nodes, for a manifest.

    Args:
        task: A key of ``TASKS``.
        nodes: Number of nodes V of the mesh.
        optional: Whether the optional outputs are given.
    """
    contract = TASKS[task]
    outputs = contract.outputs + (contract.optional if optional else ())
    return (
        tuple(_sized(tensor, contract, nodes) for tensor in contract.inputs),
        tuple(_sized(tensor, contract, nodes) for tensor in outputs),
    )


def check_tensors(
    task: str, inputs: tuple[TensorInfo, ...], outputs: tuple[TensorInfo, ...], where: str
) -> tuple[TaskContract, int | None]:
    """Check that inputs and outputs are those of a task.

    Args:
        task: What the manifest says.
        inputs: Inputs by the manifest.
        outputs: Outputs by the manifest.
        where: Whose manifest, for the error.

    Returns:
        The task's contract, and the number of nodes that the widths of its fields mean; None for
        a task without a mesh.

    Raises:
        BundleError: An unknown task, or tensors that differ from its contract.
    """
    contract = TASKS.get(task)
    if contract is None:
        raise BundleError(
            f"{where}: task {task!r} is not one of {', '.join(sorted(TASKS))}",
            remedy="upgrade palpate, or train a bundle for one of these tasks",
        )
    nodes = _nodes(contract, (*inputs, *outputs))
    sized = {
        side: tuple(_sized(tensor, contract, nodes) for tensor in tensors)
        for side, tensors in (
            ("inputs", contract.inputs),
            ("outputs", contract.outputs),
            ("all", contract.outputs + contract.optional),
        )
    }
    fits = inputs == sized["inputs"] and outputs in (sized["outputs"], sized["all"])
    if not fits or (contract.per_node and not nodes):
        raise BundleError(
            f"{where}: inputs {_names(inputs)} and outputs {_names(outputs)} are not those of "
            f"task {task!r}: {_names(contract.inputs)} -> "
            f"{_names(contract.outputs + contract.optional)}"
            + (f", {BY_MESH} = {_widths(contract)} with V nodes" if contract.per_node else ""),
            remedy="export the model again with palpate train",
        )
    return contract, nodes


def _nodes(contract: TaskContract, tensors: tuple[TensorInfo, ...]) -> int | None:
    """Nodes that the width of the displacement means, where it means any."""
    for tensor in tensors:
        each = contract.per_node.get(tensor.name)
        if each is not None and len(tensor.shape) == 2 and tensor.shape[1] > 0:
            return tensor.shape[1] // each
    return None


def _sized(tensor: TensorInfo, contract: TaskContract, nodes: int | None) -> TensorInfo:
    each = contract.per_node.get(tensor.name)
    if each is None or nodes is None:
        return tensor
    return TensorInfo(tensor.name, tensor.dtype, (-1, each * nodes), tensor.unit)


def _widths(contract: TaskContract) -> str:
    return ", ".join(f"{name} {each}V" for name, each in contract.per_node.items())


def _names(tensors: tuple[TensorInfo, ...]) -> str:
    return ", ".join(f"{t.name} {t.dtype}{list(t.shape)} [{t.unit}]" for t in tensors)
