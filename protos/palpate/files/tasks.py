"""Tasks: inputs and outputs of the model of each (docs/adr/0008-bundle.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

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
        optional=(_tensor("contact_location", 3, "m"), _tensor("contact_location_sd", 3, "m")),
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

    With ``optional`` its optional outputs are given, too.
    """
    contract = TASKS[task]
    outputs = contract.outputs + (contract.optional if optional else ())
    return _sized(contract.inputs, contract, nodes), _sized(outputs, contract, nodes)


def check_tensors(
    task: str, inputs: tuple[TensorInfo, ...], outputs: tuple[TensorInfo, ...], where: str
) -> tuple[TaskContract, int | None]:
    """Check that inputs and outputs of a manifest are those of its task.

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
    fits = inputs == _sized(contract.inputs, contract, nodes) and outputs in (
        _sized(contract.outputs, contract, nodes),
        _sized(contract.outputs + contract.optional, contract, nodes),
    )
    if not fits or (contract.per_node and not nodes):
        widths = ", ".join(f"{name} {each}V" for name, each in contract.per_node.items())
        raise BundleError(
            f"{where}: inputs {_names(inputs)} and outputs {_names(outputs)} are not those of "
            f"task {task!r}: {_names(contract.inputs)} -> "
            f"{_names(contract.outputs + contract.optional)}"
            + (f", {BY_MESH} = {widths} with V nodes" if contract.per_node else ""),
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


def _sized(
    tensors: tuple[TensorInfo, ...], contract: TaskContract, nodes: int | None
) -> tuple[TensorInfo, ...]:
    """The tensors with the widths that this number of nodes gives."""
    return tuple(
        replace(tensor, shape=(-1, contract.per_node[tensor.name] * nodes))
        if nodes is not None and tensor.name in contract.per_node
        else tensor
        for tensor in tensors
    )


def _names(tensors: tuple[TensorInfo, ...]) -> str:
    return ", ".join(f"{t.name} {t.dtype}{list(t.shape)} [{t.unit}]" for t in tensors)
