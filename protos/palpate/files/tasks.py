"""Tasks: inputs and outputs of the model of each (docs/adr/0008-bundle.md)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from palpate.errors import BundleError
from palpate.messages import SensorType, TensorInfo

SENSOR_TYPE = SensorType.BIOTAC
"""Sensor whose electrodes are inputs and outputs; there are no tasks for a BioTac SP."""

BY_MESH = 0
"""Stands for a width that depends on the number of nodes of the bundle's mesh."""

BY_BASIS = -2
"""Stands for a width that is the number of modes of the bundle's basis."""


@dataclass(frozen=True, slots=True)
class TaskContract:
    """Inputs and outputs of a model of this task.

    Attributes:
        optional: Outputs that may be absent, in the order in which they follow the others.
        together: Names of optional outputs that come together or not at all.
        per_node: Values per node of the tensors whose width is ``BY_MESH``; empty for a task
            without a mesh. A field's tensor is flat: x y z of node 0, x y z of node 1, ...
    """

    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    optional: tuple[TensorInfo, ...] = ()
    together: tuple[tuple[str, ...], ...] = ()
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
            _tensor("centre_of_pressure", 3, "m"),
            _tensor("centre_of_pressure_sd", 3, "m"),
            _tensor("contact_normal", 3, "1"),
            _tensor("contact_normal_sd", 1, "rad"),
        ),
        together=(
            ("contact_location", "contact_location_sd"),
            ("centre_of_pressure", "centre_of_pressure_sd"),
            ("contact_normal", "contact_normal_sd"),
        ),
    ),
    "field": TaskContract(
        inputs=(_tensor("electrodes", _ELECTRODES, "tared counts"),),
        outputs=(_tensor("displacement", BY_MESH, "m"),),
        optional=(
            _tensor("displacement_sd", BY_MESH, "m"),
            _tensor("contact_force", BY_MESH, "N"),
            _tensor("coefficients", BY_BASIS, "m"),
        ),
        per_node={"displacement": 3, "displacement_sd": 1, "contact_force": 3},
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
    task: str, nodes: int, *, optional: Collection[str] = (), modes: int = 0
) -> tuple[tuple[TensorInfo, ...], tuple[TensorInfo, ...]]:
    """Inputs and outputs of a task on a mesh of so many nodes, for a manifest.

    ``optional`` names the optional outputs that are given; ``modes`` is the number of coefficients.
    """
    contract = TASKS[task]
    outputs = contract.outputs + tuple(one for one in contract.optional if one.name in optional)
    return _sized(contract.inputs, contract, nodes), _sized(outputs, contract, nodes, modes)


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
    given = {tensor.name: tensor for tensor in outputs}
    expected = contract.outputs + tuple(one for one in contract.optional if one.name in given)
    shape = given["coefficients"].shape if "coefficients" in given else ()
    modes = shape[1] if len(shape) == 2 and shape[1] > 0 else 0
    fits = (
        ("coefficients" in given) == bool(modes)
        and inputs == _sized(contract.inputs, contract, nodes)
        and outputs == _sized(expected, contract, nodes, modes)
        and all(len(given.keys() & set(group)) in (0, len(group)) for group in contract.together)
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
    tensors: tuple[TensorInfo, ...], contract: TaskContract, nodes: int | None, modes: int = 0
) -> tuple[TensorInfo, ...]:
    """The tensors with the widths that these numbers of nodes and modes give."""

    def width(tensor: TensorInfo) -> int:
        if tensor.shape[1] == BY_BASIS and modes:
            return modes
        if nodes is not None and tensor.name in contract.per_node:
            return contract.per_node[tensor.name] * nodes
        return tensor.shape[1]

    return tuple(replace(tensor, shape=(-1, width(tensor))) for tensor in tensors)


def _names(tensors: tuple[TensorInfo, ...]) -> str:
    return ", ".join(f"{t.name} {t.dtype}{list(t.shape)} [{t.unit}]" for t in tensors)
