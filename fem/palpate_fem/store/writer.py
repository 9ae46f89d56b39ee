"""Writing simulations: crash-safe, resumable, by one process or by many."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate.errors import ConfigError, DatasetError
from palpate.files.simulation_store import FINGERTIP, SUFFIX, TRAJECTORIES, check_id
from palpate.process import Closing
from palpate_fem.result import IndentationResult
from palpate_fem.store.content import Outline, StoredFingertip
from palpate_fem.store.files import (
    PART,
    Claim,
    FolderLock,
    StoreMismatchError,
    StoreTakenError,
    disk_error,
)
from palpate_fem.store.hdf5 import file_image, write_fingertip
from palpate_fem.store.read import UNFINISHED, SimulationStore
from palpate_fem.store.trajectory import write_trajectory


class StoreWriter(SimulationStore, Closing):
    """A store that takes trajectories; made if it is not there, else continued.

    Alone by default. Where several processes share the work, each opens the store with ``shared``
    and claims what it is about to run; the first one to come gets it::

        with StoreWriter(path, tip, shared=True) as store:
            for id in sorted(wanted - store.done()):
                try:
                    with store.claim(id) as place:
                        place.write(run(id))
                except StoreTakenError:
                    continue  # another process is at it, or was

    Args:
        path: Folder ``NAME.sim``.
        fingertip: What is simulated; a store takes one only.
        shared: Whether other writers that say so too may write at the same time.
        outline: Gives the surface of an indenter by its name, for pictures; None = keep none.
        stress: Whether to keep stress, the largest of the fields.
        command: What runs the simulations, for people.

    Raises:
        StoreTakenError: Another process is writing.
        StoreMismatchError: The store is another fingertip's; says what differs.
        StoreDiskError: The folder cannot be written.
        DatasetError: The folder is no store, or damaged.
        ConfigError: ``path`` does not end in ``.sim``.
    """

    def __init__(
        self,
        path: Path,
        fingertip: StoredFingertip,
        *,
        shared: bool = False,
        outline: Callable[[str], Outline] | None = None,
        stress: bool = False,
        command: str = "",
    ) -> None:
        super().__init__(path)
        self._fingertip, self._stress, self._command = fingertip, stress, command
        self._outline = outline
        self._outlines: dict[str, Outline] = {}
        self._prepare_folder()
        self._lock: FolderLock | None = FolderLock(path, shared=shared)
        try:
            if not shared:
                self._sweep_parts()
            self._begin()
        except BaseException:
            self.close()
            raise

    def claim(self, trajectory: str) -> Place:
        """Reserve a trajectory before it is run.

        Args:
            trajectory: Its id, e.g. ``sphere_medium/03/normal``.

        Raises:
            StoreTakenError: It is done, or another process or thread is running it.
            DatasetError: It would be inside another trajectory, or hold one.
            ConfigError: It is no id.
        """
        check_id(trajectory)
        if self._lock is None:
            raise ValueError(f"{self.path} is closed")
        self._check_place(trajectory)
        claim = Claim(self.file_of(trajectory))
        try:
            if claim.target.exists() and self.outcome(trajectory) not in UNFINISHED:
                raise StoreTakenError(
                    f"{self.path}: {trajectory} is done",
                    remedy=f"leave out what done() lists, or remove {claim.target}",
                )
        except BaseException:
            claim.close()
            raise
        return Place(self, trajectory, claim)

    def write(self, trajectory: str, result: IndentationResult, *, sensor: str = "") -> None:
        """Claim and write in one; when this returns it is on the disk.

        Args:
            trajectory: Its id.
            result: How it went, whatever the outcome.
            sensor: Name of the BioTac it was measured on; empty = simulated.

        Raises:
            StoreDiskError: The disk is full or refuses; the store is as before.
            DatasetError: As :meth:`claim`.
        """
        with self.claim(trajectory) as place:
            place.write(result, sensor=sensor)

    def close(self) -> None:
        """Let others in. Again does nothing."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def image(self, trajectory: str, result: IndentationResult, sensor: str) -> bytes:
        """Bytes of the file of a trajectory."""

        def fill(file: Any) -> None:
            write_trajectory(
                file.create_group(f"{TRAJECTORIES}/{trajectory}"),
                result,
                nodes=len(self._fingertip.mesh.nodes),
                fingertip=self._fingertip.key,
                sensor=sensor,
                outline=self._outline_of(result.indenter),
                stress=self._stress,
            )

        return file_image(fill, command=self._command)

    def _outline_of(self, indenter: str) -> Outline | None:
        if self._outline is None:
            return None
        if indenter not in self._outlines:
            self._outlines[indenter] = self._outline(indenter)
        return self._outlines[indenter]

    def _prepare_folder(self) -> None:
        if self.path.suffix != SUFFIX:
            raise ConfigError(
                f"{self.path} does not end in {SUFFIX}", remedy=f"call it {self.path.stem}{SUFFIX}"
            )
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            strange = [
                entry.name
                for entry in self.path.iterdir()
                if entry.name not in (FINGERTIP, FINGERTIP + PART, TRAJECTORIES, "lock")
            ]
        except OSError as error:
            raise disk_error(self.path, error) from error
        if strange and not (self.path / FINGERTIP).exists():
            raise DatasetError(
                f"{self.path} is no store: it holds {strange[0]}", remedy="choose another folder"
            )

    def _sweep_parts(self) -> None:
        """Remove what killed writers left; nobody else is writing now."""
        for part in self.path.rglob(f"*.h5{PART}"):
            part.unlink(missing_ok=True)

    def _begin(self) -> None:
        head = self.path / FINGERTIP
        if not head.exists():
            with Claim(head, wait=True) as claim:
                if not head.exists():  # else another one has begun while we waited
                    tip = self._fingertip
                    claim.commit(
                        file_image(lambda file: write_fingertip(file, tip), command=self._command)
                    )
        differences = self._fingertip.differences(SimulationStore.open(self.path).fingertip())
        if differences:
            raise StoreMismatchError(
                f"{self.path} is another fingertip's: {'; '.join(differences)} as in the store",
                remedy="write to a new store, or run with what this one was begun with",
            )

    def _check_place(self, trajectory: str) -> None:
        """A trajectory cannot be inside another one: in HDF5 both would be one group."""
        folder = self.path / TRAJECTORIES
        parents = [parent.as_posix() for parent in Path(trajectory).parents][:-1]
        inside = [name for name in parents if (folder / f"{name}.h5").exists()]
        if inside or next((folder / trajectory).rglob("*.h5"), None) is not None:
            raise DatasetError(
                f"{self.path}: {trajectory} would be inside another trajectory, or hold one",
                remedy="give ids of the same depth, e.g. sphere_medium/03/normal",
            )


class Place(Closing):
    """The right to write one trajectory, from :meth:`StoreWriter.claim`."""

    def __init__(self, store: StoreWriter, trajectory: str, claim: Claim) -> None:
        self._store, self._trajectory, self._claim = store, trajectory, claim

    def write(self, result: IndentationResult, *, sensor: str = "") -> None:
        """Write it, once.

        Raises:
            StoreDiskError: The disk is full or refuses; the store is as before.
        """
        self._claim.commit(self._store.image(self._trajectory, result, sensor))

    def close(self) -> None:
        """Let go of it, unwritten. Nothing if it was written."""
        self._claim.close()
