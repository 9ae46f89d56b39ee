"""A fingertip in finite elements: pressurised once, then indented again and again.

Reading order of this folder: `reference_element`, `skin` (with ``element_kernels``),
`contact` (with ``contact_kernels``), `state`, `system`, `iteration`, `newton`, `load_stepping`, and
this module.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from palpate.errors import SimulationError
from palpate_fem.arrays import Floats
from palpate_fem.config import FingertipParameters
from palpate_fem.indenter.approach import OuterSurface, check_clear
from palpate_fem.indenter.path import check_path
from palpate_fem.indenter.shape import Indenter
from palpate_fem.mechanics.load_stepping import (
    ConvergedIncrement,
    LoadStepping,
    SolverSettings,
)
from palpate_fem.mechanics.newton import NewtonSolver
from palpate_fem.mechanics.state import SolutionState
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.check import check_mesh
from palpate_fem.mesh.solid import FingertipGeometry, SolidMesh
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.sparse.factor import make_factor

STEPS_TO_PRESSURISE = 4
REFERENCE_MODULUS_PA = 2.8e5
"""Shear modulus for which the default contact constants are made: the paper's optimum [Pa]."""
THICKNESS_TOLERANCE_M = 1e-8
LARGEST_RISE_M = 0.5e-3
"""Change of thickness in one filling step [m]: the secant is good and Newton starts near."""


class Fingertip:
    """A pressurised fingertip that can be indented again and again."""

    def __init__(
        self, geometry: FingertipGeometry, parameters: FingertipParameters, settings: SolverSettings
    ) -> None:
        """An unpressurised fingertip; use `pressurised`."""
        self.geometry, self.parameters, self.settings = geometry, parameters, settings
        self.system = self.equations(geometry.mesh)
        pattern = self.system.pattern
        self.newton = NewtonSolver(
            self.system,
            make_factor(
                pattern.indptr, pattern.indices, groups=pattern.free // 3, solver=settings.solver
            ),
            settings.newton,
        )
        self.state = SolutionState.at_rest(geometry.mesh)
        self.core_volume = geometry.core.volume_m3 if geometry.core else 0.0

    @classmethod
    def pressurised(
        cls,
        geometry: FingertipGeometry,
        parameters: FingertipParameters | None = None,
        settings: SolverSettings | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Fingertip:
        """A fingertip that is filled with its fluid.

        Args:
            geometry: Mesh and core. The mesh is as thick as it was made: ``skin_thickness_m`` of
                the parameters is not looked at, give it to the mesh, too.
            parameters: Physical parameters; None = the paper's optimum.
            settings: Tolerances and limits of the solver.
            progress: Called with the fraction done.

        Raises:
            SimulationError: No equilibrium, or the fluid volume does not fit the cavity: less than
                the unpressurised skin holds would suck the skin inwards.
        """
        parameters = parameters or FingertipParameters()
        check_mesh(geometry.mesh)
        tip = cls(geometry, parameters, settings or SolverSettings())
        tip._pressurise(progress or (lambda _: None))
        return tip

    def equations(self, mesh: SolidMesh) -> EquilibriumSystem:
        """The equations of this finger with other nodes of its mesh."""
        parameters, settings, core = self.parameters, self.settings, self.geometry.core
        return EquilibriumSystem(
            mesh,
            core.grid if core else None,
            shear_modulus_pa=parameters.shear_modulus_pa,
            bulk_ratio=parameters.bulk_ratio,
            contact=settings.contact.scaled(parameters.shear_modulus_pa / REFERENCE_MODULUS_PA),
            volume_barrier=settings.volume_barrier,
            strain_stiffening=parameters.strain_stiffening or 0.0,
        )

    @property
    def nodes(self) -> Floats:
        """Nodal positions of the pressurised, untouched state [m], (V, 3)."""
        return self.state.position

    @property
    def total_thickness_m(self) -> float:
        """Dorso-ventral extent of the skin [m]."""
        return float(np.ptp(self.state.position[:, 2]))

    @property
    def fluid_pressure_pa(self) -> float:
        """Fluid pressure of the untouched state above ambient [Pa]."""
        return self.state.fluid_pressure

    @property
    def fluid_volume_m3(self) -> float:
        """Fluid between skin and core [m^3]."""
        return self.cavity_m3 - self.core_volume

    def _pressurise(self, progress: Callable[[float], None]) -> None:
        """Fill to the given volume, or by a secant on the volume to the given thickness."""
        parameters, state = self.parameters, self.state
        self.cavity_m3 = self.system.balance(state, None).volume
        if parameters.fluid_volume_m3 is not None:
            self._check_suction(parameters.fluid_volume_m3)
            self._fill_to(parameters.fluid_volume_m3 + self.core_volume, STEPS_TO_PRESSURISE)
            # Where it rests on the core the last step leaves it 0.1 um from where it comes back to.
            self._fill_to(self.cavity_m3, 1)
            progress(1.0)
            return
        wanted = parameters.total_thickness_m
        outer = self.geometry.mesh.outer_nodes
        area = float(np.ptp(state.position[outer, 0]) * np.ptp(state.position[outer, 1]))
        # Secant on thickness(volume), with steps short enough for Newton's method.
        low = (self.cavity_m3, self.total_thickness_m)
        if wanted < low[1] - THICKNESS_TOLERANCE_M:
            raise SimulationError(
                f"the unpressurised skin is {low[1] * 1e3:.2f} mm thick already, "
                f"{wanted * 1e3:.2f} mm are wanted",
                remedy="take a thinner skin, or give the fluid (fluid_volume_m3, --fill-ml)",
            )
        begin = low[1]
        # First guess of d thickness / d volume; the BioTac grows by 1.45 mm in 474 mm^3.
        slope = 0.35 / area
        previous, reached = low, 0.0
        for _ in range(40):
            missing = wanted - self.total_thickness_m
            if abs(missing) < THICKNESS_TOLERANCE_M:
                progress(1.0)
                return
            rise = math.copysign(min(abs(missing), LARGEST_RISE_M), missing)
            self._fill_to(self.cavity_m3 + rise / slope, 1)
            now = (self.cavity_m3, self.total_thickness_m)
            if abs(now[0] - previous[0]) > 1e-16:
                slope = (now[1] - previous[1]) / (now[0] - previous[0])
            previous = now
            if slope <= 0.0:
                break
            reached = max(reached, min(0.99, (now[1] - begin) / max(wanted - begin, 1e-12)))
            progress(reached)  # never falls, though the secant may overshoot
        raise SimulationError(
            f"the skin does not get {wanted * 1e3:.2f} mm thick by filling; it reached "
            f"{self.total_thickness_m * 1e3:.2f} mm",
            remedy="check skin_thickness_m and total_thickness_m",
        )

    def _check_suction(self, fluid_m3: float) -> None:
        """Refuse a fill that pulls at the skin instead of pushing it out.

        The unpressurised skin is free of stress, so what it holds beside the core is the fill of no
        pressure. A BioTac is filled until it bulges, and a model of skin that is sucked onto the
        core, folds included, was never checked.
        """
        least = self.cavity_m3 - self.core_volume
        if fluid_m3 < least:
            raise SimulationError(
                f"{fluid_m3 * 1e6:.3f} ml of fluid suck the skin inwards",
                remedy=f"fill in at least {math.ceil(least * 1e9) * 1e-3:.3f} ml, which the "
                "unpressurised skin holds, or leave the volume out",
            )

    def _fill_to(self, cavity: float, steps: int) -> None:
        """Bring the cavity to a volume [m^3] in steps; those that do not converge are halved."""
        start, done, size = self.cavity_m3, 0.0, 1.0 / steps
        while done < 1.0 - 1e-12:
            kept = self.state.copy()
            goal = min(1.0, done + size)
            volume = start + goal * (cavity - start)
            report, _ = self.newton.solve(self.state, None, volume=volume)
            if report.converged:
                done, self.cavity_m3 = goal, volume
                continue
            self.state = kept
            size *= 0.5
            if size < 1e-3:
                raise SimulationError(
                    f"pressurisation stopped at {volume * 1e9:.1f} mm^3: {report.reason}",
                    remedy="check the mesh and the fluid volume",
                )

    def load_stepping(
        self,
        indenter: Indenter,
        path: Floats,
        *,
        on_step: Callable[[IndentationStep], None] | None = None,
        should_stop: Callable[[], IndentationOutcome | None] | None = None,
        history: list[ConvergedIncrement] | None = None,
    ) -> LoadStepping:
        """An indentation that is ready to run; its path is not checked, as `indent` does."""
        return LoadStepping(
            self.newton,
            self.settings,
            self.state,
            self.cavity_m3,
            indenter,
            path,
            friction=self.parameters.friction_coefficient,
            fluid_m3=self.fluid_volume_m3,
            on_step=on_step,
            should_stop=should_stop,
            history=history,
        )

    def indent(
        self,
        indenter: Indenter,
        path: Floats,
        *,
        on_step: Callable[[IndentationStep], None] | None = None,
        should_stop: Callable[[], IndentationOutcome | None] | None = None,
        history: list[ConvergedIncrement] | None = None,
    ) -> IndentationResult:
        """Move an indenter along a path and compute the skin's response.

        Args:
            indenter: The indenter.
            path: Poses in the sensor frame: position [m], quaternion w x y z, (K, 7). The first
                does not touch the skin.
            on_step: Called with each converged step.
            should_stop: Called at least once in each iteration; an outcome ends the indentation.
            history: An empty list that takes up the start and all increments, for the gradients of
                the indentation (``adjoint``).

        Returns:
            The converged steps; if not all of them, why, and how far the indenter came.

        Raises:
            ConfigError: The path is not valid, see `check_path`.
            SimulationError: The indenter starts inside the skin.
        """
        path = check_path(path)
        surface = OuterSurface(self.nodes, self.geometry.mesh.outer_faces)
        check_clear(indenter, path[0], surface)
        return self.load_stepping(
            indenter, path, on_step=on_step, should_stop=should_stop, history=history
        ).run()
