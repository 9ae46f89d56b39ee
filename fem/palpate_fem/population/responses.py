"""What the electrodes of several specimens read along stored trajectories.

The mechanics are shared, the electrical properties are each specimen's own (learning notes, section
4.5): forces of real sensors agree, their electrodes do not. So the skin is solved once, and each
film separately.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import DatasetError
from palpate_fem.arrays import Floats
from palpate_fem.electrodes.gap import Gap
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.mesh.parametric import biotac
from palpate_fem.mesh.solid import FingertipGeometry
from palpate_fem.result import IndentationResult, IndentationStep
from palpate_fem.store.content import StoredFingertip

_NAME = re.compile(r"biotac-(?P<thickness>[0-9.]+)mm-(?P<edge>[0-9.]+)mm-(?P<layers>\d+)")


def geometry_of(fingertip: StoredFingertip) -> FingertipGeometry:
    """Build the parametric geometry that a stored fingertip was simulated on, for its core.

    Raises:
        DatasetError: It has another mesh, or one from another version of the geometry.
    """
    match = _NAME.fullmatch(fingertip.mesh.name)
    if match is None:
        raise DatasetError(
            f"the fingertip's mesh {fingertip.mesh.name!r} is not a parametric one",
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
    """Specimens on one fingertip.

    Attributes:
        electrodes: Model of each specimen's electrodes, by name.
        rest_counts: Ideal counts of the untouched specimens, each of shape (19,).
    """

    def __init__(self, fingertip: StoredFingertip, specimens: Sequence[SpecimenParameters]) -> None:
        """Prepare the films.

        Args:
            fingertip: Pressurised, with the parametric mesh.
            specimens: With different names.

        Raises:
            DatasetError: The fingertip has another mesh, or two specimens have the same name.
        """
        geometry = geometry_of(fingertip)
        names = [specimen.name for specimen in specimens]
        if len(set(names)) != len(names) or not all(names):
            raise DatasetError(
                f"specimens are called {', '.join(map(repr, names))}",
                remedy="give each a different name",
            )
        self.electrodes: dict[str, ElectrodeModel] = {}
        model = ElectrodeModel(geometry, specimens[0])
        for specimen in specimens:
            model = model.with_specimen(specimen)
            self.electrodes[specimen.name] = model
        self._nodes = fingertip.pressurised_nodes
        self._groups = _sharing_films(self.electrodes)
        rest = {name: self.gap(name) for name in self.electrodes}
        self.rest_counts: Mapping[str, Floats] = {
            name: model.of_gap(rest[name]).counts for name, model in self.electrodes.items()
        }

    def gap(self, specimen: str, step: IndentationStep | None = None) -> Gap:
        """Gap over the film of a specimen at a step; None = untouched."""
        finder = self.electrodes[specimen].finder
        if step is None:
            return finder.measure(self._nodes)
        return finder.of_step(self._nodes, step)

    def counts(
        self, steps: Iterable[IndentationStep], names: Collection[str] | None = None
    ) -> dict[str, Floats]:
        """Ideal counts of specimens at the steps of a trajectory, each of shape (S, 19).

        Args:
            steps: The steps.
            names: Of the specimens; None = all.
        """
        wanted = self.electrodes.keys() if names is None else names
        found: dict[str, list[Floats]] = {name: [] for name in self.electrodes if name in wanted}
        for step in steps:
            for group in self._groups:
                some = [name for name in group if name in found]
                if not some:
                    continue
                gap = self.gap(some[0], step)
                for name in some:
                    found[name].append(self.electrodes[name].of_gap(gap).counts)
        return {name: np.array(rows).reshape(-1, 19) for name, rows in found.items()}


def _sharing_films(models: Mapping[str, ElectrodeModel]) -> list[list[str]]:
    """Names of specimens, grouped by shared film mesh: one gap serves each group."""
    groups: dict[int, list[str]] = {}
    for name, model in models.items():
        groups.setdefault(id(model.finder), []).append(name)
    return list(groups.values())


MOUNT_SHARE = 0.05
"""Largest share of the indenter's nodal forces that may act on held nodes."""


def clear_steps(trajectory: IndentationResult, held: NDArray[np.integer[Any]]) -> int:
    """Number of steps before the indenter presses on what nail and clamp hold.

    From there on a trajectory collides with the mount; the paper leaves such trajectories out
    ("Experimental testing procedure").

    Args:
        trajectory: As simulated.
        held: Ids of the nodes that are held.
    """
    for k, step in enumerate(trajectory.steps):
        force = np.linalg.norm(step.indenter_force, axis=1)
        if force[held].sum() > MOUNT_SHARE * force.sum():
            return k
    return len(trajectory.steps)
