"""Steps of many solutions at once, made on the device and fetched in one copy."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import warp as wp

from palpate_fem.arrays import Floats
from palpate_fem.batched import kernels, reductions
from palpate_fem.batched.equations import BatchedEquations
from palpate_fem.batched.launches import Launches, Listed
from palpate_fem.batched.reductions import (
    AREA,
    FORCE,
    MOMENT,
    ON_CORE,
    ON_INDENTER,
    SUMS,
    TORQUE,
    WEIGHT,
)
from palpate_fem.batched.state import BatchedState, flat, on_device
from palpate_fem.mechanics.load_stepping import CONTACT_SHARE
from palpate_fem.mechanics.reference_element import face_element
from palpate_fem.result import Convergence, IndentationStep

COPYING = 4
"""Threads that copy steps out of the pages that the device writes; it waits meanwhile."""


class BatchedSteps:
    """Makes `IndentationStep` of converged solutions; see `indentation_step`, which does of one."""

    def __init__(self, equations: BatchedEquations, rest: Floats) -> None:
        """Make room.

        Args:
            equations: Of the slots.
            rest: Nodal positions from which displacements count [m], (V, 3).
        """
        self._equations, self._rest, device = equations, rest, equations.device
        self._launch = Launches(device)
        mesh, slots = equations.system.mesh, equations.slots
        self._nodes, self._elements = len(mesh.nodes), len(mesh.elements)
        self._stress = wp.zeros(slots * self._elements, dtype=wp.mat33d, device=device)
        self._sums = wp.zeros((slots, SUMS), dtype=wp.float64, device=device)
        face = face_element(equations.system.outer.points)
        self._face = [
            on_device(values, wp.float64, device)
            for values in (face.shape, face.gradient, face.weight)
        ]
        width = 9 * self._nodes + 6 * self._elements + SUMS
        # What the device writes and what the host reads, which copies fast only from locked pages.
        self._packed = wp.zeros((slots, width), dtype=wp.float64, device=device)
        locked = wp.get_device(device).is_cuda
        self._fetched = wp.zeros((slots, width), dtype=wp.float64, device="cpu", pinned=locked)
        self._pool = ThreadPoolExecutor(COPYING, thread_name_prefix="palpate-steps")

    def make(
        self,
        state: BatchedState,
        listed: Listed,
        poses: Sequence[Floats],
        fluid_pa: Sequence[float],
        convergences: Sequence[Convergence],
    ) -> list[IndentationStep]:
        """Steps of the listed slots.

        Args:
            state: Converged solutions, at which the last `BatchedEquations.balance` was.
            listed: Slots, m of them.
            poses: Of their indenters, (7,) each.
            fluid_pa: Fluid pressures [Pa].
            convergences: How they were solved; penetrations are filled in.
        """
        self._sum(state, listed)
        # Copied at once, as the next fetch overwrites them; it takes long to get new pages.
        rows = list(self._pool.map(np.copy, self._fetch(state, listed)))
        stiffness = self._equations.system.contact.stiffness
        steps = []
        for row, pose, fluid, convergence in zip(rows, poses, fluid_pa, convergences, strict=True):
            fields, sums = row[:-SUMS], row[-SUMS:]
            displacement, on_indenter, on_core = (
                fields[k * 3 * self._nodes : (k + 1) * 3 * self._nodes].reshape(-1, 3)
                for k in range(3)
            )
            displacement -= self._rest
            centre = np.full(3, np.nan)
            if sums[AREA] > 0.0:
                centre = sums[MOMENT : MOMENT + 3] / sums[WEIGHT]
            deepest = float(max(sums[ON_INDENTER], sums[ON_CORE]))
            steps.append(
                IndentationStep(
                    pose=np.array(pose),
                    displacement=displacement,
                    fluid_pressure_pa=fluid,
                    force=sums[FORCE : FORCE + 3],
                    torque=sums[TORQUE : TORQUE + 3],
                    indenter_force=on_indenter,
                    core_force=on_core,
                    contact_area_m2=float(sums[AREA]),
                    centre_of_pressure=centre,
                    stress=fields[9 * self._nodes :].reshape(-1, 6),
                    convergence=replace(convergence, penetration_m=deepest / stiffness),
                )
            )
        return steps

    def _sum(self, state: BatchedState, listed: Listed) -> None:
        """Sums of the listed slots."""
        outer, inner = self._equations.outer, self._equations.inner
        slots, count, sums = listed.slots, len(listed.slots), [self._sums]
        self._equations.clear(listed, SUMS, self._sums)
        self._launch(
            reductions.sum_forces,
            (count, self._nodes),
            [slots, self._nodes, state.position, outer.force],
            sums,
        )
        for items, surface, pressure, place in (
            (listed.outer, outer, state.indenter_pressure, ON_INDENTER),
            (listed.inner, inner, state.core_pressure, ON_CORE),
        ):
            self._launch(
                reductions.largest_pressure,
                len(items),
                [items, surface.count, pressure, place],
                sums,
            )
        self._launch(
            reductions.sum_contact_area,
            len(listed.outer),
            [outer.faces, *self._face, outer.area, self._nodes, listed.outer,
             wp.float64(CONTACT_SHARE), state.position, state.indenter_pressure],
            sums,
        )  # fmt: skip

    def _fetch(self, state: BatchedState, listed: Listed) -> Floats:
        """Rows of the listed slots: positions, forces of indenter and core, stresses, sums.

        They are overwritten by the next call.
        """
        equations = self._equations
        equations.stress(state, listed, self._stress)
        slots, count, at = listed.slots, len(listed.slots), 0
        for factor, array in (
            (1.0, state.position),
            (-1.0, equations.outer.force),
            (-1.0, equations.inner.force),
        ):
            self._launch(
                kernels.pack,
                (count, 3 * self._nodes),
                [slots, 3 * self._nodes, wp.float64(factor), flat(array), at],
                [self._packed],
            )
            at += 3 * self._nodes
        self._launch(
            kernels.pack_stress,
            (count, self._elements),
            [slots, self._elements, self._stress, at],
            [self._packed],
        )
        self._launch(
            kernels.pack,
            (count, SUMS),
            [slots, SUMS, wp.float64(1.0), flat(self._sums), at + 6 * self._elements],
            [self._packed],
        )
        wp.copy(self._fetched, self._packed, count=count * self._packed.shape[1])
        wp.synchronize_device(equations.device)
        return np.asarray(self._fetched.numpy()[:count])
