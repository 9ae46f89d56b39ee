"""Writing simulations: crash-safe, resumable, by one process or by many; and exporting them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py

from palpate.errors import ConfigError, DatasetError
from palpate.files.hdf5 import new_file, text
from palpate.files.simulation_store import FINGERTIP, SUFFIX, TRAJECTORIES, check_id
from palpate.process import Closing
from palpate_fem.result import IndentationResult
from palpate_fem.store.content import Outline, StoredFingertip
from palpate_fem.store.files import (
    PART,
    FileClaim,
    FolderLock,
    StoreMismatchError,
    StoreTakenError,
    disk_error,
)
from palpate_fem.store.read import UNFINISHED, SimulationStore
from palpate_fem.store.schema import (
    LIBVER,
    file_image,
    write_fingertip,
    write_header,
    write_trajectory,
)


@dataclass(frozen=True)
class TrajectoryImages:
    """Makes the content of trajectories' files; can be pickled, for other processes to make it.

    Attributes:
        nodes: Number of nodes of the mesh.
        fingertip: Key of the fingertip.
        outline: Function from the name of an indenter to its surface; None = none is stored.
        stress: Whether to keep stress.
        command: Command line that runs the simulations, for provenance.
    """

    nodes: int
    fingertip: str
    outline: Callable[[str], Outline] | None
    stress: bool
    command: str
    _outlines: dict[str, Outline] = field(default_factory=dict, compare=False)

    def image(self, trajectory: str, result: IndentationResult, sensor: str = "") -> bytes:
        """Content of the file of a trajectory; takes 50 to 100 ms on a mesh of 10,000 nodes."""
        name = result.indenter
        if self.outline is not None and name not in self._outlines:
            self._outlines[name] = self.outline(name)

        def fill(file: Any) -> None:
            write_trajectory(
                file.create_group(f"{TRAJECTORIES}/{trajectory}"),
                result,
                nodes=self.nodes,
                fingertip=self.fingertip,
                sensor=sensor,
                outline=self._outlines.get(name),
                stress=self.stress,
            )

        return file_image(fill, command=self.command)


class StoreWriter(SimulationStore, Closing):
    """A store that takes trajectories; it is created if it does not exist, else continued.

    One writer at a time by default. If several processes share the work, each opens the store with
    ``shared`` and claims a trajectory before it runs it; the first one gets it::

        with StoreWriter(path, tip, shared=True) as store:
            for id in sorted(wanted - store.done()):
                try:
                    with store.claim(id) as claim:
                        claim.write(run(id))
                except StoreTakenError:
                    continue  # another process runs it, or has run it

    Args:
        path: Folder ``NAME.sim``.
        fingertip: The fingertip that is simulated; a store holds one only.
        shared: Whether other writers with ``shared`` may write at the same time.
        outline: Function from the name of an indenter to its surface, for pictures; None = none
            is stored.
        stress: Whether to keep stress, the largest of the fields.
        command: Command line that runs the simulations, for provenance.

    Attributes:
        images: Makes the content of trajectories' files.

    Raises:
        StoreTakenError: Another process is writing.
        StoreMismatchError: The store belongs to another fingertip; says what differs.
        StoreDiskError: The folder cannot be written.
        DatasetError: The folder is not a store, or is damaged.
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
        self._fingertip, self._command = fingertip, command
        self.images = TrajectoryImages(
            len(fingertip.mesh.nodes), fingertip.key, outline, stress, command
        )
        self._prepare_folder()
        self._lock: FolderLock | None = FolderLock(path, shared=shared)
        try:
            if not shared:
                self._sweep_parts()
            self._begin()
        except BaseException:
            self.close()
            raise

    def claim(self, trajectory: str) -> TrajectoryClaim:
        """Reserve a trajectory before it is run.

        Args:
            trajectory: Its id, e.g. ``sphere_medium/03/normal``.

        Raises:
            StoreTakenError: It is done, or another process or thread runs it.
            DatasetError: Its id is inside another trajectory's, or contains one.
            ConfigError: It is not a valid id.
        """
        check_id(trajectory)
        if self._lock is None:
            raise ValueError(f"{self.path} is closed")
        self._check_place(trajectory)
        claim = FileClaim(self.file_of(trajectory))
        try:
            if claim.target.exists() and self.outcome(trajectory) not in UNFINISHED:
                raise StoreTakenError(
                    f"{self.path}: {trajectory} is done",
                    remedy=f"leave out what done() lists, or remove {claim.target}",
                )
        except BaseException:
            claim.close()
            raise
        return TrajectoryClaim(self, trajectory, claim)

    def write(self, trajectory: str, result: IndentationResult, *, sensor: str = "") -> None:
        """Claim and write a trajectory; when this returns, it is on the disk.

        Args:
            trajectory: Its id.
            result: The result, with any outcome.
            sensor: Name of the BioTac it was measured on; empty = simulated.

        Raises:
            StoreDiskError: The disk is full or refuses; the store is as before.
            DatasetError: As :meth:`claim`.
        """
        with self.claim(trajectory) as place:
            place.write(result, sensor=sensor)

    def close(self) -> None:
        """Release the store for other writers. May be called again."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

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
                f"{self.path} is not a store: it holds {strange[0]}", remedy="choose another folder"
            )

    def _sweep_parts(self) -> None:
        """Remove what killed writers left behind; safe because there is no other writer now."""
        for part in self.path.rglob(f"*.h5{PART}"):
            part.unlink(missing_ok=True)

    def _begin(self) -> None:
        head = self.path / FINGERTIP
        if not head.exists():
            with FileClaim(head, wait=True) as claim:
                if not head.exists():  # else another process has created it while we waited
                    tip = self._fingertip
                    self._check_orphans()
                    claim.commit(
                        file_image(lambda file: write_fingertip(file, tip), command=self._command)
                    )
        differences = self._fingertip.differences(SimulationStore.open(self.path).fingertip())
        if differences:
            raise StoreMismatchError(
                f"{self.path} is another fingertip's: {'; '.join(differences)} as in the store",
                remedy="write to a new store, or use the parameters and settings of this one",
            )

    def _check_orphans(self) -> None:
        """Refuse trajectories whose fingertip is not there, if they are of another one."""
        for name in self.ids():
            with self.group(name) as group:
                if text(group.attrs.get("fingertip", "")) != self._fingertip.key:
                    raise StoreMismatchError(
                        f"{self.path} has lost its {FINGERTIP}, and {name} is another fingertip's",
                        remedy=f"bring {FINGERTIP} back, or write to a new store",
                    )

    def _check_place(self, trajectory: str) -> None:
        """Refuse an id inside another one: in an export, one group would contain the other."""
        folder = self.path / TRAJECTORIES
        parents = [parent.as_posix() for parent in Path(trajectory).parents][:-1]
        inside = [name for name in parents if (folder / f"{name}.h5").exists()]
        if inside or next((folder / trajectory).rglob("*.h5"), None) is not None:
            raise DatasetError(
                f"{self.path}: {trajectory} would be inside another trajectory, or hold one",
                remedy="give ids of the same depth, e.g. sphere_medium/03/normal",
            )


class TrajectoryClaim(Closing):
    """The exclusive right to write one trajectory, from :meth:`StoreWriter.claim`.

    Attributes:
        trajectory: Its id.
    """

    def __init__(self, store: StoreWriter, trajectory: str, claim: FileClaim) -> None:
        self.trajectory = trajectory
        self._images, self._claim = store.images, claim

    def write(self, result: IndentationResult, *, sensor: str = "") -> None:
        """Write the trajectory; possible once.

        Raises:
            StoreDiskError: The disk is full or refuses; the store is as before.
        """
        self.commit(self._images.image(self.trajectory, result, sensor))

    def commit(self, image: bytes | memoryview) -> None:
        """Write what ``StoreWriter.images`` has made of the trajectory; possible once.

        Raises:
            StoreDiskError: The disk is full or refuses; the store is as before.
        """
        self._claim.commit(image)

    def close(self) -> None:
        """Release the claim if nothing was written."""
        self._claim.close()


def export(
    store: SimulationStore,
    path: Path,
    *,
    ids: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    command: str = "",
) -> int:
    """Copy a folder of trajectories into one file; it appears complete or not at all.

    Args:
        store: A store that is a folder.
        path: The file to write (``.h5``); never replaced.
        ids: Trajectories to copy; None = all.
        progress: Called with the number of copied trajectories, and of all.
        command: Command line that makes the file, for provenance.

    Returns:
        Number of trajectories in it.

    Raises:
        ConfigError: The file is there already.
        DatasetError: The store is damaged, lacks one of ``ids``, or is one file already.
        StoreDiskError: The disk is full or refuses.
    """
    check_free(path)
    if store.path.is_file():
        raise DatasetError(f"{store.path} is one file already", remedy="copy it")
    names = store.ids() if ids is None else list(ids)
    with FileClaim(path) as claim:
        try:
            with new_file(claim.part, extra="fem", libver=LIBVER) as target:
                write_header(target, command=command)
                _copy(store.path / FINGERTIP, "fingertip", target)
                for at, name in enumerate(names):
                    if progress is not None:
                        progress(at, len(names))
                    store.summary(name)  # raises a readable error if it is damaged
                    group = f"{TRAJECTORIES}/{name}"
                    _copy(store.path / f"{group}.h5", group, target)
        except (OSError, RuntimeError) as error:
            told = error if isinstance(error, OSError) else OSError(str(error))
            raise disk_error(path, told) from error
        check_free(path)  # copying takes minutes
        claim.finish()
    return len(names)


def check_free(path: Path) -> None:
    """Check that a file is not there.

    Raises:
        ConfigError: It is.
    """
    if path.exists():
        raise ConfigError(f"{path} is there already", remedy="name another file, or remove it")


def _copy(source: Path, group: str, target: h5py.File) -> None:
    above, _, name = f"/{group}".rpartition("/")
    with h5py.File(source, "r", locking=False) as file:
        target.copy(file[group], target.require_group(above or "/"), name)
