"""Solutions of many copies of a fingertip, on the device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from palpate_fem.arrays import Floats, Ints
from palpate_fem.batched import kernels
from palpate_fem.batched.launches import Launches
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mesh.solid import SolidMesh

FIELDS = (
    "position", "pressure", "fluid_pressure", "core_pressure", "indenter_pressure", "traction",
    "anchor",
)  # fmt: skip
"""Of a `SolutionState`; its mortar corrections belong to an evaluation, and are kept elsewhere."""


@dataclass(frozen=True, slots=True)
class SlotNumbers:
    """Numbers of one slot at one state; names and meaning as in `ForceBalance`.

    Attributes:
        net_force: Of the indenter on the skin [N], (3,).
        fluid_pressure: Above ambient [Pa].
        sets_changed: Whether the active set of contact differs from that of the last tangent.
    """

    residual: float
    volume: float
    strain_error: float
    gap_error_m: float
    traction_error: float
    smallest_jacobian: float
    net_force: Floats
    fluid_pressure: float
    sets_changed: bool


class BatchedState:
    """The unknowns of `SolutionState` for every slot, one slot after the other.

    Attributes:
        position: Nodal positions [m], (S V,) vectors.
        pressure: Element pressures [Pa], (S E,).
        fluid_pressure: Above ambient [Pa], (S,).
        core_pressure: On the core [Pa], (S F, k).
        indenter_pressure: On the indenter [Pa], (S F, k).
        traction: Friction [Pa], (S F, k) vectors.
        anchor: In the indenter's frame [m], (S F, k) vectors.
    """

    def __init__(self, mesh: SolidMesh, slots: int, device: str) -> None:
        """Make room; put states before use."""
        self._rest, self._launches = SolutionState.at_rest(mesh), Launches(device)
        outer, inner = mesh.outer_faces, mesh.inner_faces

        def room(shape: tuple[int, ...], kind: type = wp.float64) -> wp.array:
            return wp.zeros(shape, dtype=kind, device=device)

        self.position = room((slots * len(mesh.nodes),), wp.vec3d)
        self.pressure = room((slots * len(mesh.elements),))
        self.fluid_pressure = room((slots,))
        self.core_pressure = room((slots * len(inner), inner.shape[1]))
        self.indenter_pressure = room((slots * len(outer), outer.shape[1]))
        self.traction = room((slots * len(outer), outer.shape[1]), wp.vec3d)
        self.anchor = room((slots * len(outer), outer.shape[1]), wp.vec3d)
        self._flat = {name: flat(getattr(self, name)) for name in FIELDS}
        self._each = {name: len(one) // slots for name, one in self._flat.items()}

    def put(self, slot: int, state: SolutionState) -> None:
        """Put a state into a slot."""
        for name, array in self._flat.items():
            values = np.ascontiguousarray(np.ravel(getattr(state, name)), np.float64)
            source = wp.array(values, dtype=wp.float64, device="cpu", copy=False)
            wp.copy(array, source, dest_offset=slot * self._each[name], count=len(values))

    def get(self, slot: int) -> SolutionState:
        """A copy of the state of a slot; without its mortar corrections."""
        state = self._rest.copy()
        for name, array in self._flat.items():
            each = self._each[name]
            values = array[slot * each : (slot + 1) * each].numpy()
            if name == "fluid_pressure":
                state.fluid_pressure = float(values[0])
            else:
                setattr(state, name, values.reshape(np.shape(getattr(state, name))).copy())
        return state

    def copy_slots(self, source: BatchedState, slots: wp.array) -> None:
        """Copy the listed slots, (m,) int32, of another state."""
        for name, array in self._flat.items():
            self._launch(kernels.copy_rows, slots, name, [source._flat[name]], [array])

    def extrapolate(
        self, now: BatchedState, before: BatchedState, ratio: wp.array, slots: wp.array
    ) -> None:
        """Set the listed slots to now + ratio (now - before), ratios (S,); see `LoadStepping`."""
        for name, array in self._flat.items():
            old, new = before._flat[name], now._flat[name]
            if name == "anchor":
                self._launch(kernels.copy_rows, slots, name, [new], [array])
                continue
            positive = int(name in ("core_pressure", "indenter_pressure"))
            self._launch(kernels.extrapolate, slots, name, [ratio, positive, new, old], [array])

    def _launch(
        self, kernel: wp.Kernel, slots: wp.array, name: str, inputs: list[object],
        outputs: list[wp.array],
    ) -> None:  # fmt: skip
        each = self._each[name]
        dim = (len(slots), kernels.threads_for(each))
        self._launches(kernel, dim, [slots, each, *inputs], outputs)


def flat(array: wp.array) -> wp.array:
    """All numbers of an array of numbers, vectors or matrices, as one row, without a copy."""
    size = array.capacity // 8
    return wp.array(ptr=array.ptr, dtype=wp.float64, shape=(size,), device=array.device, copy=False)


def rows_of_three(array: wp.array) -> wp.array:
    """Vectors (N,) as numbers (N, 3), without a copy."""
    return wp.array(
        ptr=array.ptr, dtype=wp.float64, shape=(len(array), 3), device=array.device, copy=False
    )


def on_device(values: Floats | Ints, kind: type, device: str) -> wp.array:
    """A copy of an array on a device."""
    return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)
