"""What the electrodes of several units say to stored trajectories: the skin once, each film apart.

The mechanics are shared, the electrics are each unit's own (learning notes, section 4.5): forces of
real sensors agree, their electrodes do not.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import DatasetError
from palpate_fem.electrodes.gap import Gap
from palpate_fem.electrodes.sensor import Electrodes
from palpate_fem.electrodes.unit import UnitParameters
from palpate_fem.mesh.parametric import biotac
from palpate_fem.mesh.solid import FingertipGeometry
from palpate_fem.result import IndentationStep
from palpate_fem.store.content import StoredFingertip

Floats = NDArray[np.float64]


_NAME = re.compile(r"biotac-(?P<thickness>[0-9.]+)mm-(?P<edge>[0-9.]+)mm-(?P<layers>\d+)")


def geometry_of(fingertip: StoredFingertip) -> FingertipGeometry:
    """Build the parametric geometry that a stored fingertip was simulated on, for its core.

    Raises:
        DatasetError: It is of another mesh, or made by another version of the geometry.
    """
    match = _NAME.fullmatch(fingertip.mesh.name)
    if match is None:
        raise DatasetError(
            f"the fingertip's mesh is called {fingertip.mesh.name!r}, which is no parametric one",
            remedy="simulate on the parametric mesh: its core carries the electrodes",
        )
    geometry = biotac(
        thickness_m=fingertip.parameters.skin_thickness_m,
        edge_m=float(match["edge"]) * 1e-3,
        layers=int(match["layers"]),
    )
    if geometry.mesh.sha256 != fingertip.mesh.sha256:
        raise DatasetError(
            f"the mesh {fingertip.mesh.name} is not the one that this palpate builds",
            remedy="simulate again with this version",
        )
    return geometry


class Population:
    """Units on one fingertip.

    Attributes:
        sensors: Electrodes of each unit, by name.
        rest: Gap of the untouched finger.
        rest_counts: Ideal counts of the untouched units, each of shape (19,).
    """

    def __init__(self, fingertip: StoredFingertip, units: Sequence[UnitParameters]) -> None:
        """Make the films ready.

        Args:
            fingertip: Pressurised, of the parametric mesh.
            units: Named differently.

        Raises:
            DatasetError: The fingertip is of another mesh, or two units bear one name.
        """
        geometry = geometry_of(fingertip)
        names = [unit.name for unit in units]
        if len(set(names)) != len(names) or not all(names):
            raise DatasetError(
                f"units are called {', '.join(map(repr, names))}",
                remedy="give each a name of its own",
            )
        self.sensors: dict[str, Electrodes] = {}
        first: Electrodes | None = None
        for unit in units:
            first = Electrodes(geometry, unit) if first is None else first.with_unit(unit)
            self.sensors[unit.name] = first
        assert first is not None
        self._nodes = fingertip.pressurised_nodes
        self._finders = _shared_finders(self.sensors)
        rest = {name: self.gap(name) for name in self.sensors}
        self.rest_counts: Mapping[str, Floats] = {
            name: sensor.of_gap(rest[name]).counts for name, sensor in self.sensors.items()
        }

    def gap(self, unit: str, step: IndentationStep | None = None) -> Gap:
        """Gap over the film of a unit; untouched without a step."""
        finder = self.sensors[unit].finder
        if step is None:
            return finder.measure(self._nodes)
        return finder.of_step(self._nodes, step)

    def answer(self, steps: Iterable[IndentationStep]) -> dict[str, Floats]:
        """Ideal counts of each unit to the steps of a trajectory, each of shape (S, 19)."""
        found: dict[str, list[Floats]] = {name: [] for name in self.sensors}
        for step in steps:
            for names in self._finders:
                gap = self.gap(names[0], step)
                for name in names:
                    found[name].append(self.sensors[name].of_gap(gap).counts)
        return {name: np.array(rows).reshape(-1, 19) for name, rows in found.items()}


def _shared_finders(sensors: Mapping[str, Electrodes]) -> list[list[str]]:
    """Names of units grouped by the film that they share: one gap serves each group."""
    groups: dict[int, list[str]] = {}
    for name, sensor in sensors.items():
        groups.setdefault(id(sensor.finder), []).append(name)
    return list(groups.values())


@dataclass(frozen=True, slots=True)
class Extremes:
    """Smallest and largest tared value over full scale of one unit, and where.

    Attributes:
        low: Over all electrodes and states.
        high: Likewise.
        by_electrode: Low and high of each electrode, shape (2, 19).
    """

    low: float
    high: float
    by_electrode: Floats

    @classmethod
    def of(cls, tared: Floats) -> Extremes:
        """Of tared values over full scale, shape (N, 19)."""
        ends = np.stack([tared.min(axis=0), tared.max(axis=0)])
        return cls(float(ends[0].min()), float(ends[1].max()), ends)
