"""A store as one HDF5 file, to hand on: the same schema, everything in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import h5py

from palpate.errors import DatasetError
from palpate.files.simulation_store import FINGERTIP, TRAJECTORIES
from palpate_fem.store.files import Claim, disk_error
from palpate_fem.store.hdf5 import LIBVER, write_header
from palpate_fem.store.read import SimulationStore


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
        path: The file to write (``.h5``); replaced if it is there.
        ids: Which trajectories; None = all.
        progress: Told how many of how many are copied.
        command: What made the file, for people.

    Returns:
        How many trajectories it holds.

    Raises:
        DatasetError: The store is damaged, lacks one of ``ids``, or is one file already.
        StoreDiskError: The disk is full or refuses.
    """
    if store.path.is_file():
        raise DatasetError(f"{store.path} is one file already", remedy="copy it")
    names = store.ids() if ids is None else list(ids)
    with Claim(path) as claim:
        try:
            with h5py.File(claim.part, "w", libver=LIBVER, locking=False) as target:
                write_header(target, command=command)
                _copy(store.path / FINGERTIP, "fingertip", target)
                for at, name in enumerate(names):
                    if progress is not None:
                        progress(at, len(names))
                    store.summary(name)  # says in our words what is wrong with it
                    group = f"{TRAJECTORIES}/{name}"
                    _copy(store.path / f"{group}.h5", group, target)
        except (OSError, RuntimeError) as error:  # HDF5 says at closing that a disk is full
            raise disk_error(path, OSError(str(error))) from error
        claim.finish()
    return len(names)


def _copy(source: Path, group: str, target: h5py.File) -> None:
    above, _, name = f"/{group}".rpartition("/")
    with h5py.File(source, "r", locking=False) as file:
        target.copy(file[group], target.require_group(above or "/"), name)
