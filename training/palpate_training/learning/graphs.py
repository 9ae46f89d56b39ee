"""The networks as they are shipped: the whole field in, or the whole field out.

The modes lie in the graph in half precision and are cast to single, so torch and ONNX Runtime
compute with the same numbers and the file is half as large.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from palpate.files.tasks import TASKS
from palpate.messages import TensorInfo
from palpate_training.learning.contact_code import ContactCode
from palpate_training.learning.field_code import FieldCode
from palpate_training.learning.film import FilmNet, FilmPooling

FloatArray = npt.NDArray[np.float32]


def _register(module: nn.Module, **constants: npt.NDArray[Any]) -> None:
    """Make arrays constants of a graph, by name."""
    for name, values in constants.items():
        module.register_buffer(name, torch.from_numpy(values))


class FeaturesGraph(nn.Module):
    """The ``features`` task: estimates of one network, and constant standard deviations.

    Args:
        net: Tared counts ``(N, 19)`` -> force [N], then what only a contact has, ``(N, 3 Q)``.
        force_sd: Residual standard deviation per axis on validation rows [N], shape ``(3,)``.
        contact_sd: The same of what only a contact has, by the name of its output, in the order of
            the contract: ``contact_location`` and ``centre_of_pressure`` [m], one per axis;
            ``contact_normal``, that of its angle [rad], shape ``(1,)``. Normals are made unit
            vectors.
    """

    def __init__(
        self,
        net: nn.Module,
        force_sd: FloatArray,
        contact_sd: Mapping[str, FloatArray] | None = None,
    ) -> None:
        super().__init__()
        given = contact_sd or {}
        self.names = tuple(one.name for one in TASKS["features"].optional if one.name in given)
        if self.names != tuple(given):
            raise ValueError(f"{tuple(given)} are not in the order of the contract")
        self.net = net
        # Not named as the outputs are: ONNX wants every name once.
        _register(self, force_spread=force_sd.astype(np.float32))
        for name in self.names:
            _register(self, **{f"{name}_spread": given[name].astype(np.float32)})

    def forward(self, electrodes: Tensor) -> tuple[Tensor, ...]:
        """Tared counts ``(N, 19)`` -> the task's outputs in order."""
        rows = electrodes.shape[0]
        force, *contact = torch.split(self.net(electrodes), 3, dim=1)
        outputs = [force, self.get_buffer("force_spread").expand(rows, 3)]
        for name, estimate in zip(self.names, contact, strict=True):
            spread = self.get_buffer(f"{name}_spread")
            if name == "contact_normal":
                estimate = nn.functional.normalize(estimate, dim=1)
            outputs += [estimate, spread.expand(rows, len(spread))]
        return tuple(outputs)

    @property
    def outputs(self) -> tuple[TensorInfo, ...]:
        """What it gives, as the contract names it."""
        contract = TASKS["features"]
        given = {*self.names, *(f"{name}_sd" for name in self.names)}
        return contract.outputs + tuple(one for one in contract.optional if one.name in given)


class FieldGraph(nn.Module):
    """Tared counts ``(N, 19)`` -> the ``field`` task; ``optional`` names what it adds to it.

    Args:
        net: Tared counts -> coefficients of the displacement [m], then of the contact forces [N],
            shape ``(N, K + C)``.
        code: What the first K are coefficients of.
        node_sd: Root mean square length of the nodal error on validation rows [m], shape ``(V,)``.
        contact: What the last C are coefficients of; None = there are none.
    """

    modes: Tensor
    scale: Tensor
    mean: Tensor
    node_spread: Tensor

    def __init__(
        self,
        net: nn.Module,
        code: FieldCode,
        node_sd: FloatArray,
        contact: ContactCode | None = None,
    ) -> None:
        super().__init__()
        self.net = net
        _register(self, modes=code.modes, scale=code.scale, mean=code.mean)
        _register(self, node_spread=node_sd.astype(np.float32))
        self.optional: tuple[str, ...] = ("displacement_sd", "coefficients")
        if contact is not None:
            self.optional = ("displacement_sd", "contact_force", "coefficients")
            _register(self, contact_modes=contact.modes, contact_scale=contact.scale)
            # Inner nodes take the zero that follows the forces of the outer ones.
            place = np.full(contact.nodes, len(contact.outer), np.int64)
            place[contact.outer] = np.arange(len(contact.outer))
            _register(self, contact_place=place)

    def forward(self, electrodes: Tensor) -> tuple[Tensor, ...]:
        """Displacement ``(N, 3V)`` [m], and what ``optional`` names.

        Standard deviation ``(N, V)`` [m], contact force ``(N, 3V)`` [N], coefficients ``(N, K)``
        [m].
        """
        estimate = self.net(electrodes)
        coefficients = estimate[:, : len(self.scale)] * self.scale  # (N, K)
        field = coefficients @ self.modes.to(torch.float32) + self.mean  # (N, 3V)
        spread = self.node_spread.expand(electrodes.shape[0], -1)
        if "contact_force" not in self.optional:
            return field, spread, coefficients
        of_contact = estimate[:, len(self.scale) :] * self.get_buffer("contact_scale")
        outer = of_contact @ self.get_buffer("contact_modes").to(torch.float32)  # (N, 3O)
        vectors = nn.functional.pad(outer, (0, 3)).reshape(outer.shape[0], -1, 3)  # (N, O + 1, 3)
        force = torch.index_select(vectors, 1, self.get_buffer("contact_place")).flatten(1)
        return field, spread, force, coefficients


class SynthesisGraph(nn.Module):
    """Nodal displacement ``(N, 3V)`` [m] -> tared counts and their spread, each ``(N, 19)``.

    Args:
        net: Coefficients and pooled film change -> tared counts.
        code: Modes to project on.
        pooling: How the film near the electrodes is pooled.
        counts_sd: Root mean square residual on validation rows [counts], shape ``(19,)``.
    """

    optional: tuple[str, ...] = ()

    modes: Tensor
    scale: Tensor
    mean: Tensor
    nodes: Tensor
    normals: Tensor
    weights: Tensor
    counts_spread: Tensor

    def __init__(
        self, net: FilmNet, code: FieldCode, pooling: FilmPooling, counts_sd: FloatArray
    ) -> None:
        super().__init__()
        self.net = net
        _register(self, modes=code.modes, scale=code.scale, mean=code.mean)
        _register(self, nodes=pooling.nodes, normals=pooling.normals, weights=pooling.weights)
        _register(self, counts_spread=counts_sd.astype(np.float32))

    def forward(self, displacement: Tensor) -> tuple[Tensor, Tensor]:
        """Tared counts and standard deviation, each ``(N, 19)`` [counts]."""
        modes = self.modes.to(torch.float32)
        coefficients = nn.functional.linear(displacement - self.mean, modes) * self.scale
        vectors = displacement.reshape(displacement.shape[0], -1, 3)
        near = torch.index_select(vectors, 1, self.nodes)  # (N, I, 3)
        pooled = (near * self.normals).sum(dim=2) @ self.weights  # (N, P)
        counts: Tensor = self.net(torch.cat([coefficients, pooled], dim=1))
        return counts, self.counts_spread.expand(displacement.shape[0], -1)
