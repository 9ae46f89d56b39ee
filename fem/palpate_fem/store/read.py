"""Reading a store of simulations into the types of the finite elements."""

from __future__ import annotations

from typing import Any

from palpate.files.hdf5 import text
from palpate.files.simulation_store import SimulationFiles
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.store.content import StoredFingertip, TrajectorySummary
from palpate_fem.store.schema import read_fingertip, read_summary, read_trajectory

UNFINISHED = (IndentationOutcome.CANCELLED, IndentationOutcome.DEADLINE)
"""Outcomes that depend on the run and not on the finger; such a trajectory is run again."""


class SimulationStore(SimulationFiles):
    """Reads a store; see ``SimulationFiles`` for what it does with files."""

    def done(self) -> set[str]:
        """Ids that a resumed sweep does not run again: all except those cancelled or out of time.

        Raises:
            DatasetError: A file is damaged, or belongs to another fingertip, e.g. since two stores
                were copied into one; names it.
        """
        key, found = self._key(), set()
        for name in self.ids():
            with self.group(name) as group:
                self._check_key(name, group, key)
                if _outcome(group) not in UNFINISHED:
                    found.add(name)
        return found

    def outcome(self, trajectory: str) -> IndentationOutcome:
        """How a trajectory ended; a measured one is complete.

        Raises:
            DatasetError: Not there, or damaged.
        """
        with self.group(trajectory) as group:
            return _outcome(group)

    def fingertip(self) -> StoredFingertip:
        """Mesh, parameters and pressurised state that all trajectories share.

        Raises:
            DatasetError: Damaged, or a file of measured trajectories, which has none.
        """
        with self.head() as file:
            return read_fingertip(file)

    def summary(self, trajectory: str) -> TrajectorySummary:
        """Poses, forces and outcome of a trajectory, without its fields.

        Raises:
            DatasetError: Not there, or damaged.
        """
        with self.group(trajectory) as group:
            return read_summary(trajectory, group)

    def trajectory(self, trajectory: str) -> IndentationResult:
        """A whole trajectory. Fields are float64, but were stored as float32.

        Raises:
            DatasetError: Not there, damaged, or measured, so without fields.
        """
        with self.group(trajectory) as group:
            return read_trajectory(group)


def _outcome(group: Any) -> IndentationOutcome:
    return IndentationOutcome(text(group.attrs.get("outcome", IndentationOutcome.COMPLETE.value)))
