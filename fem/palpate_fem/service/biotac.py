"""The BioTac for worker processes: its geometry by name, and the solver as ``PressurisedTip``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.errors import ConfigError
from palpate_fem.arrays import Floats
from palpate_fem.config import EDGE_M, FingertipParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.load_stepping import SolverSettings
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.solid import FingertipGeometry
from palpate_fem.result import IndentationOutcome, IndentationResult, IndentationStep
from palpate_fem.service.fingertips import BuildTip, OnFraction
from palpate_fem.store.content import Setting, StoredFingertip

if TYPE_CHECKING:  # workers on the CPU do without it
    from palpate_fem.batched.fingertip import BatchedFingertip

PARAMETRIC = "biotac"
"""Name of the open parametric mesh; anything else is a folder with the public meshes."""


class BiotacTip:
    """A pressurised fingertip of the finite-element solver."""

    def __init__(self, solved: Fingertip) -> None:
        self._solved = solved

    def describe(self) -> StoredFingertip:
        """See ``PressurisedTip.describe``."""
        tip = self._solved
        return StoredFingertip(
            mesh=tip.geometry.mesh,
            parameters=tip.parameters,
            settings=dict(_named(tip.settings)),
            pressurised_nodes=tip.nodes,
            fluid_pressure_pa=tip.fluid_pressure_pa,
            fluid_volume_m3=tip.fluid_volume_m3,
            total_thickness_m=tip.total_thickness_m,
            core_vertices=tip.geometry.core.vertices,
            core_faces=tip.geometry.core.faces,
        )

    def indent(
        self,
        indenter: str,
        path: Floats,
        *,
        friction_coefficient: float,
        on_step: Callable[[IndentationStep], None] | None = None,
        should_stop: Callable[[], IndentationOutcome | None] | None = None,
    ) -> IndentationResult:
        """See ``PressurisedTip.indent``."""
        tip = self._solved
        # Friction has no effect on the pressurised state, so one state serves all coefficients.
        tip.parameters = replace(tip.parameters, friction_coefficient=friction_coefficient)
        return tip.indent(make_indenter(indenter), path, on_step=on_step, should_stop=should_stop)

    def on_device(
        self, indenters: Sequence[str], *, slots: int, device: str, friction_coefficient: float
    ) -> BatchedFingertip:
        """See ``SlottedTip.on_device``."""
        from palpate_fem.batched.fingertip import BatchedFingertip

        tip = self._solved
        tip.parameters = replace(tip.parameters, friction_coefficient=friction_coefficient)
        made = [make_indenter(name) for name in indenters]
        return BatchedFingertip(tip, made, slots=slots, device=device)


def biotac(
    *,
    mesh: str = PARAMETRIC,
    edge_m: float | None = None,
    layers: int = 2,
    solver: Mapping[str, Setting] | None = None,
) -> BuildTip:
    """Factory of fingertips with one geometry.

    Args:
        mesh: ``biotac`` for the open parametric mesh, else the folder of the public meshes.
        edge_m: Edge of the parametric mesh's elements on the pad [m]; None = ``EDGE_M``.
        layers: Elements through the skin.
        solver: Settings of the solver by name, e.g. ``{"force_limit_n": 32.0}``.

    Raises:
        ConfigError: An option makes no mesh, or a setting does not exist.
    """
    geometry_of = _geometry(mesh, edge_m, layers)
    settings = _settings(solver or {})

    def build(parameters: FingertipParameters, on_fraction: OnFraction) -> BiotacTip:
        geometry = geometry_of(parameters.skin_thickness_m)
        return BiotacTip(Fingertip.pressurised(geometry, parameters, settings, on_fraction))

    return build


def _geometry(mesh: str, edge_m: float | None, layers: int) -> Callable[[float], FingertipGeometry]:
    """A function from skin thickness [m] to geometry."""
    if mesh == PARAMETRIC:
        from palpate_fem.mesh.parametric import biotac as parametric

        edge = EDGE_M if edge_m is None else edge_m
        return lambda thickness: parametric(thickness_m=thickness, edge_m=edge, layers=layers)
    from palpate_fem.mesh.nvlabs import read_nvlabs

    if edge_m is not None:
        raise ConfigError("the public mesh has its own edge length", remedy="leave edge_m out")
    return lambda thickness: read_nvlabs(Path(mesh), thickness_m=thickness, layers=layers)


def _settings(given: Mapping[str, Setting]) -> SolverSettings:
    known = {field.name for field in fields(SolverSettings)}
    if unknown := sorted(set(given) - known):
        raise ConfigError(
            f"the solver has no setting {unknown[0]!r}", remedy=f"known: {', '.join(sorted(known))}"
        )
    return SolverSettings(**given)  # type: ignore[arg-type]


def _named(settings: object, above: str = "") -> list[tuple[str, Setting]]:
    """Every number, flag and word of nested settings, by dotted name."""
    found: list[tuple[str, Setting]] = []
    assert is_dataclass(settings)
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            found += _named(value, f"{above}{field.name}.")
        elif isinstance(value, bool | int | float | str):
            # Stores compare these names: a setting that was renamed keeps the name it is stored as.
            found.append((above + field.metadata.get("stored_as", field.name), value))
    return found
