"""Simulations on disk: a folder ``NAME.sim`` of whole files, or one exported HDF5 file.

HDF5 does not survive a crash while a file is open for writing, so nothing is ever open: each
trajectory is a small file of its own that appears, complete, by renaming. Reading takes a folder
that is still being written, a finished one, and an exported file alike.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

from palpate.errors import DatasetError, PalpateError
from palpate_fem.result import IndentationOutcome, IndentationResult
from palpate_fem.store.content import (
    Outline,
    StoredFingertip,
    TrajectorySummary,
    check_id,
)
from palpate_fem.store.hdf5 import check_header, read_fingertip, text
from palpate_fem.store.trajectory import read_summary, read_trajectory

SUFFIX = ".sim"
FINGERTIP = "fingertip.h5"
TRAJECTORIES = "trajectories"

UNFINISHED = (IndentationOutcome.CANCELLED, IndentationOutcome.DEADLINE)
"""Outcomes that say nothing of the finger: such a trajectory is not done, and run again."""


class SimulationStore:
    """Reads a store. Holds no file open, so it may be read while others write.

    Attributes:
        path: Folder or file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._whole = path.is_file()

    @classmethod
    def open(cls, path: Path) -> SimulationStore:
        """Open a store.

        Args:
            path: A folder ``NAME.sim`` or a file in the same schema.

        Raises:
            DatasetError: There is none, it is damaged, or of another schema or version.
        """
        store = cls(path)
        if not path.exists():
            raise DatasetError(f"{path}: no such store", remedy="check the path")
        if not store._whole and not (path / FINGERTIP).is_file():
            raise DatasetError(
                f"{path}: no {FINGERTIP} in it: no store, or one whose writer did not get that far",
                remedy="name another folder, or run the command that writes it again",
            )
        with store._reading(store._head()):
            pass
        return store

    def ids(self) -> list[str]:
        """Ids of all whole trajectories, sorted."""
        if self._whole:
            with self._reading(self.path) as file:
                return sorted(_groups(file.get(TRAJECTORIES, {})))
        folder = self.path / TRAJECTORIES
        names = (file.relative_to(folder).as_posix() for file in folder.rglob("*.h5"))
        return sorted(name.removesuffix(".h5") for name in names)

    def done(self) -> set[str]:
        """Ids that a resumed sweep need not run again: all but those cancelled or out of time.

        Raises:
            DatasetError: A file is damaged; names it.
        """
        return {name for name in self.ids() if self._outcome(name) not in UNFINISHED}

    def fingertip(self) -> StoredFingertip:
        """Mesh, parameters and pressurised state that all trajectories share.

        Raises:
            DatasetError: Damaged, or a file of measured trajectories, which has none.
        """
        head = self._head()
        with self._reading(head) as file:
            return read_fingertip(file)

    def summary(self, trajectory: str) -> TrajectorySummary:
        """Poses, forces and outcome of a trajectory, without its fields.

        Raises:
            DatasetError: Not there, or damaged.
        """
        with self._group(trajectory) as group:
            return read_summary(trajectory, group)

    def trajectory(self, trajectory: str) -> IndentationResult:
        """All of a trajectory. Fields come back as float64 but were kept as float32.

        Raises:
            DatasetError: Not there, damaged, or measured, so without fields.
        """
        with self._group(trajectory) as group:
            return read_trajectory(group)

    def outline(self, trajectory: str) -> Outline | None:
        """The indenter's surface in its own frame: vertices [m], triangles; None = not kept.

        Raises:
            DatasetError: Not there, or damaged.
        """
        with self._group(trajectory) as group:
            if "indenter_vertices" not in group:
                return None
            return group["indenter_vertices"][()], group["indenter_faces"][()]

    def check(self) -> int:
        """Read every byte of every trajectory against its checksum; how many there are.

        Raises:
            DatasetError: One is damaged, or belongs to another fingertip; names it.
        """
        key = self._key()
        names = self.ids()
        for name in names:
            with self._group(name) as group:
                found = text(group.attrs.get("fingertip", ""))
                if found != key:
                    raise DatasetError(
                        f"{self._file_of(name)}: run on another fingertip than the store's",
                        remedy="remove it; a resumed sweep runs it again",
                    )
                for dataset in group.values():
                    if isinstance(dataset, h5py.Dataset):
                        dataset[()]
        return len(names)

    def _key(self) -> str:
        with self._reading(self._head()) as file:
            return text(file["fingertip"].attrs["key"]) if "fingertip" in file else ""

    def _outcome(self, trajectory: str) -> IndentationOutcome:
        with self._group(trajectory) as group:
            return IndentationOutcome(
                text(group.attrs.get("outcome", IndentationOutcome.COMPLETE.value))
            )

    def _head(self) -> Path:
        return self.path if self._whole else self.path / FINGERTIP

    def _file_of(self, trajectory: str) -> Path:
        return self.path if self._whole else self.path / TRAJECTORIES / f"{trajectory}.h5"

    @contextlib.contextmanager
    def _group(self, trajectory: str) -> Iterator[Any]:
        check_id(trajectory)
        path = self._file_of(trajectory)
        with self._reading(path, missing=trajectory) as file:
            name = f"{TRAJECTORIES}/{trajectory}"
            if self._whole and name not in file:
                raise _missing(path, trajectory)
            yield file[name]

    @contextlib.contextmanager
    def _reading(self, path: Path, *, missing: str = "") -> Iterator[Any]:
        """An open file with its header checked, and what HDF5 says in our words."""
        try:
            # Files that are there are finished and never change, so none is locked: this works on
            # read-only disks too.
            with h5py.File(path, "r", locking=False) as file:
                check_header(str(path), file)
                yield file
        except FileNotFoundError as error:
            raise _missing(self.path, missing or path.name) from error
        except PermissionError as error:
            raise DatasetError(f"{path}: may not be read", remedy="check its rights") from error
        except OSError as error:
            raise DatasetError(
                f"{path}: truncated, damaged or no HDF5 file: {error}", remedy=self._remedy(path)
            ) from error
        except KeyError as error:
            raise DatasetError(
                f"{path}: something the schema asks for is missing: {error.args[0]}",
                remedy="a file of measured trajectories has no fields; else: " + self._remedy(path),
            ) from error
        except DatasetError:
            raise
        except (RuntimeError, TypeError, ValueError) as error:
            problem = error.problem if isinstance(error, PalpateError) else error
            raise DatasetError(
                f"{path}: breaks the schema: {problem}", remedy=self._remedy(path)
            ) from error

    def _remedy(self, path: Path) -> str:
        if self._whole:
            return "export or copy it again, and compare its size"
        if path.name == FINGERTIP and path.parent == self.path:
            return "copy it again; without it the store cannot be read"
        return "remove this file; a resumed sweep runs the trajectory again"


def _missing(path: Path, trajectory: str) -> DatasetError:
    return DatasetError(
        f"{path}: there is no {trajectory!r}", remedy="see what there is: palpate review"
    )


def _groups(group: Any, above: str = "") -> Iterator[str]:
    """Ids of the trajectories in a single file: groups that hold poses."""
    for name, child in group.items():
        if not isinstance(child, h5py.Group):
            continue
        if "pose" in child:
            yield above + name
        else:
            yield from _groups(child, f"{above}{name}/")
