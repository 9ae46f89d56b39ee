"""Reading simulations on disk: schema ``palpate.simulations`` (docs/simulation-store.md).

A store is a folder ``NAME.sim`` with one HDF5 file for each trajectory, or one exported HDF5 file
with all of them. The finite-element room writes stores; this module reads them for everybody.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from palpate.config import looking_at
from palpate.errors import ConfigError, DatasetError, PalpateError
from palpate.files.hdf5 import Hdf5Schema, h5py_module, text

if TYPE_CHECKING:
    import h5py

SIMULATIONS = Hdf5Schema(
    "palpate.simulations", 1, "name a store that `palpate fem run` wrote, or a file in its schema"
)

SUFFIX = ".sim"
FINGERTIP = "fingertip.h5"
TRAJECTORIES = "trajectories"

_ID = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]*(/[A-Za-z0-9_-][A-Za-z0-9._-]*)*")
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def check_id(trajectory: str) -> None:
    """Check the id of a trajectory: it becomes a path in a folder and in an HDF5 file.

    Raises:
        ConfigError: It is not made of words of letters, digits, ``.``, ``_``, ``-`` between ``/``.
    """
    if not _ID.fullmatch(trajectory) or len(trajectory) > 200:
        raise ConfigError(
            f"{trajectory!r} is no id of a trajectory",
            remedy="use letters, digits, '.', '_' and '-', e.g. sphere_medium/03/normal",
        )


class SimulationFiles:
    """The files of a store. Holds no file open, so it may be read while others write.

    HDF5 does not survive a crash while a file is open for writing, so each trajectory of a folder
    is a file of its own that appears, complete, by renaming.

    Raises:
        MissingExtraError: h5py is not installed.
    """

    def __init__(self, path: Path) -> None:
        self._h5 = h5py_module("fem")
        self.path = path
        self._whole = path.is_file()

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open a store: a folder ``NAME.sim``, or a file in the same schema.

        Raises:
            ConfigError: It is closed, or lies in a folder that is.
            DatasetError: It does not exist, is damaged, or has another schema or version.
            MissingExtraError: h5py is not installed.
        """
        path = Path(path)
        with looking_at(path):
            store = cls(path)
            exists, begun = path.exists(), store._whole or (path / FINGERTIP).is_file()
        if not exists:
            raise DatasetError(f"{path}: no such store", remedy="check the path")
        if not begun:
            raise DatasetError(
                f"{path}: no {FINGERTIP} in it: no store, or one whose writer did not get that far",
                remedy="name another folder, or run the command that writes it again",
            )
        with store.head():
            pass
        return store

    def ids(self) -> list[str]:
        """Ids of all whole trajectories, sorted."""
        if self._whole:
            with self.head() as file:
                return sorted(self._groups(file.get(TRAJECTORIES, {})))
        folder = self.path / TRAJECTORIES
        names = (file.relative_to(folder).as_posix() for file in folder.rglob("*.h5"))
        return sorted(name.removesuffix(".h5") for name in names)

    def outline(self, trajectory: str) -> tuple[npt.NDArray[Any], npt.NDArray[np.int32]] | None:
        """The indenter's surface in its own frame: vertices [m], triangles; None = not kept.

        Raises:
            DatasetError: Not there, or damaged.
        """
        with self.group(trajectory) as group:
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
            with self.group(name) as group:
                self._check_key(name, group, key)
                for dataset in group.values():
                    if isinstance(dataset, self._h5.Dataset):
                        dataset[()]
        return len(names)

    def _key(self) -> str:
        """Key of the fingertip of all trajectories; empty for measured ones."""
        with self.head() as file:
            return text(file["fingertip"].attrs["key"]) if "fingertip" in file else ""

    def _check_key(self, trajectory: str, group: h5py.Group, key: str) -> None:
        """Refuse the group of a trajectory that is another fingertip's.

        Raises:
            DatasetError: It is; names it.
        """
        if text(group.attrs.get("fingertip", "")) != key:
            raise DatasetError(
                f"{self.file_of(trajectory)}: run on another fingertip than the store's",
                remedy="remove it; a resumed sweep runs it again",
            )

    def file_of(self, trajectory: str) -> Path:
        """The file of a trajectory, which need not exist."""
        return self.path if self._whole else self.path / TRAJECTORIES / f"{trajectory}.h5"

    def head(self) -> contextlib.AbstractContextManager[h5py.File]:
        """The open file that holds the group ``fingertip``; errors as of ``group``."""
        return self._reading(self.path if self._whole else self.path / FINGERTIP)

    @contextlib.contextmanager
    def group(self, trajectory: str) -> Iterator[h5py.Group]:
        """The open HDF5 group of a trajectory.

        What HDF5 raises in the block, e.g. for an array that is missing, becomes a
        ``DatasetError``.

        Raises:
            DatasetError: Not there, damaged, or it breaks the schema.
            ConfigError: ``trajectory`` is no id.
        """
        check_id(trajectory)
        path = self.file_of(trajectory)
        with self._reading(path, missing=trajectory) as file:
            name = f"{TRAJECTORIES}/{trajectory}"
            if self._whole and name not in file:
                raise _missing(path, trajectory)
            yield file[name]

    @contextlib.contextmanager
    def _reading(self, path: Path, *, missing: str = "") -> Iterator[h5py.File]:
        try:
            # Files that are there are finished and never change, so none is locked: this works on
            # read-only disks too.
            with self._h5.File(path, "r", locking=False) as file:
                SIMULATIONS.check(path, file)
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

    def _groups(self, group: Any, above: str = "") -> Iterator[str]:
        """Ids of the trajectories in a single file: groups that hold poses."""
        for name, child in group.items():
            if not isinstance(child, self._h5.Group):
                continue
            if "pose" in child:
                yield above + name
            else:
                yield from self._groups(child, f"{above}{name}/")


def _missing(path: Path, trajectory: str) -> DatasetError:
    return DatasetError(
        f"{path}: there is no {trajectory!r}", remedy="see what there is: palpate review"
    )


def is_simulation_store(path: Path) -> bool:
    """Whether a path looks like a store of simulations: a folder, or an HDF5 file."""
    if path.is_dir():
        return True
    with contextlib.suppress(OSError), path.open("rb") as file:
        return file.read(8) == _HDF5_MAGIC
    return False


def choose_trajectories(ids: Sequence[str], patterns: Sequence[str], most: int) -> list[str]:
    """Which of the sorted ids to show: those that fit a pattern, e.g. ``sphere_*/03/*``, or all.

    From more than ``most``, evenly spaced ones are taken, so that all indenters have a chance.

    Raises:
        DatasetError: A pattern matches no id, or the store is empty.
    """
    if not ids:
        raise DatasetError("the store holds no trajectory yet", remedy="wait for the first")
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in ids):
            raise DatasetError(
                f"no trajectory is called {pattern!r}",
                remedy=f"there are {len(ids)}, the first {ids[0]!r}; try '*' for parts of the name",
            )
    fitting = [name for name in ids if not patterns or any(fnmatchcase(name, p) for p in patterns)]
    picks = np.linspace(0, len(fitting) - 1, min(most, len(fitting))).round().astype(int)
    return [fitting[at] for at in picks]
