"""Simulations as they lie on disk: schema ``palpate.simulations`` version 1, read for drawing.

The schema is docs/simulation-store.md; its writer is another room, which is not imported here.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.extras import require

SCHEMA = "palpate.simulations"
SCHEMA_VERSION = 1

_FIELDS = ("displacement", "indenter_force", "core_force")

Floats = npt.NDArray[np.floating[Any]]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Finger:
    """The pressurised, untouched fingertip.

    Attributes:
        nodes: Positions [m], shape (V, 3), sensor frame.
        outer: Triangles of the outer surface, shape (T, 3), outward.
        inner: Triangles of the inner surface, shape (T, 3), away from the skin's solid.
        core_vertices: The core's surface [m], shape (C, 3).
        core_faces: Its triangles.
        facts: What to say of it, by name with unit.
    """

    nodes: Floats
    outer: Ints
    inner: Ints
    core_vertices: Floats
    core_faces: Ints
    facts: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Press:
    """One trajectory as far as it is drawn: how it began and its steps, K in all.

    Sensor frame, SI. At the beginning, row 0, the finger is pressurised and nothing touches it.

    Attributes:
        id: E.g. ``sphere_medium/03/normal``.
        indenter: Its name.
        outcome: How it ended.
        reason: Why it did not complete.
        pose: Position and quaternion w x y z, shape (K, 7).
        force: Net force on the BioTac [N], shape (K, 3).
        fluid_pressure_pa: Shape (K,).
        contact_area_m2: Shape (K,).
        centre_of_pressure: Shape (K, 3); NaN without contact.
        displacement: Shape (K, V, 3) [m].
        indenter_force: Nodal forces on the skin, shape (K, V, 3) [N].
        core_force: Likewise of the core.
        iterations: Newton iterations, shape (K,).
        shape: The indenter in its own frame: vertices [m], triangles; None = not kept.
    """

    id: str
    indenter: str
    outcome: str
    reason: str
    pose: Floats
    force: Floats
    fluid_pressure_pa: Floats
    contact_area_m2: Floats
    centre_of_pressure: Floats
    displacement: Floats
    indenter_force: Floats
    core_force: Floats
    iterations: Ints
    shape: tuple[Floats, Ints] | None


class Simulations:
    """A store on disk: a folder ``NAME.sim`` or one exported file.

    Args:
        path: Which.

    Raises:
        DatasetError: It is no store, damaged, or of another schema or version.
        MissingExtraError: h5py is not installed.
    """

    def __init__(self, path: Path) -> None:
        self._h5 = require("h5py", extra="fem")
        self.path = path
        self._head = path / "fingertip.h5" if path.is_dir() else path
        with self._open(self._head):
            pass

    def ids(self) -> list[str]:
        """Ids of all trajectories, sorted."""
        if self.path.is_dir():
            folder = self.path / "trajectories"
            files = (file.relative_to(folder).as_posix() for file in folder.rglob("*.h5"))
            return sorted(name.removesuffix(".h5") for name in files)
        with self._open(self._head) as file:
            return sorted(self._groups(file.get("trajectories", {}), ""))

    def finger(self) -> Finger:
        """The fingertip.

        Raises:
            DatasetError: Damaged, or a file of measured trajectories, which has none.
        """
        with self._open(self._head) as file:
            tip = file["fingertip"]
            facts = {name: f"{float(value):g}" for name, value in tip["parameters"].attrs.items()}
            for name in ("fluid_pressure_pa", "total_thickness_m"):
                facts[name] = f"{tip.attrs[name]:g}"
            facts["mesh"] = f"{_text(tip.attrs['mesh_name'])}, {len(tip['nodes']):,} nodes"
            return Finger(
                nodes=tip["pressurised_nodes"][()],
                outer=_triangles(tip["outer_faces"][()]),
                # Kept with normals into the solid, which is right for a volume and not for a light.
                inner=_triangles(tip["inner_faces"][()])[:, ::-1],
                core_vertices=tip["core_vertices"][()],
                core_faces=tip["core_faces"][()],
                facts=facts,
            )

    def press(self, trajectory: str) -> Press:
        """One trajectory.

        Raises:
            DatasetError: Not there, damaged, or measured, so without fields.
        """
        with self._open(self._head) as file:
            rest_pa = float(file["fingertip"].attrs["fluid_pressure_pa"])
        path = self._head
        if self.path.is_dir():
            path = self.path / "trajectories" / f"{trajectory}.h5"
        with self._open(path) as file:
            group = file[f"trajectories/{trajectory}"]
            shape = None
            if "indenter_vertices" in group:
                shape = group["indenter_vertices"][()], group["indenter_faces"][()]
            # What is added in front of the steps: the first pose, and nothing happening.
            before = {
                "pose": group["path"][0],
                "fluid_pressure_pa": rest_pa,
                "centre_of_pressure": np.nan,
                **dict.fromkeys(("force", "contact_area_m2", *_FIELDS), 0.0),
            }
            return Press(
                id=trajectory,
                indenter=_text(group.attrs["indenter"]),
                outcome=_text(group.attrs["outcome"]),
                reason=_text(group.attrs["reason"]),
                **{name: _begun(group[name][()], first) for name, first in before.items()},
                iterations=_begun(group["convergence"]["iterations"], 0),
                shape=shape,
            )

    def _groups(self, group: Any, above: str) -> Iterator[str]:
        for name, child in group.items():
            if isinstance(child, self._h5.Group):
                if "pose" in child:
                    yield above + name
                else:
                    yield from self._groups(child, f"{above}{name}/")

    @contextlib.contextmanager
    def _open(self, path: Path) -> Iterator[Any]:
        try:
            with self._h5.File(path, "r", locking=False) as file:
                _check_header(path, file)
                yield file
        except FileNotFoundError as error:
            lacking = "such store" if path == self.path else f"{path.relative_to(self.path)} in it"
            raise DatasetError(
                f"{self.path}: no {lacking}",
                remedy="name a store of simulations, NAME.sim or .h5",
            ) from error
        except (OSError, RuntimeError) as error:
            raise DatasetError(
                f"{path}: truncated, damaged or no HDF5 file: {error}",
                remedy="remove this one and resume the run that made it, or copy the store again",
            ) from error
        except KeyError as error:
            raise DatasetError(
                f"{path}: something the schema asks for is missing: {error.args[0]}",
                remedy="only simulated trajectories can be drawn, see docs/simulation-store.md",
            ) from error


def choose(ids: Sequence[str], patterns: Sequence[str], most: int) -> list[str]:
    """Which trajectories to draw.

    Args:
        ids: All there are, sorted.
        patterns: As in a shell, e.g. ``sphere_*/03/*``; none = all.
        most: How many at most; from more, evenly spaced ones, so that all indenters have a chance.

    Raises:
        DatasetError: A pattern fits none, or there is none at all.
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


def is_simulations(path: Path) -> bool:
    """Whether a path looks like a store of simulations: a folder, or an HDF5 file."""
    if path.is_dir():
        return True
    with contextlib.suppress(OSError), path.open("rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"
    return False


def _check_header(path: Path, file: Any) -> None:
    schema = _text(file.attrs.get("schema", ""))
    if schema != SCHEMA:
        raise DatasetError(
            f"{path}: schema is {schema or 'not stated'!r}, expected {SCHEMA!r}",
            remedy="name a store of simulations",
        )
    found = int(file.attrs.get("schema_version", 0))
    if found != SCHEMA_VERSION:
        raise DatasetError(
            f"{path}: schema version {found}, this palpate reads {SCHEMA_VERSION}",
            remedy="update palpate" if found > SCHEMA_VERSION else "make the store again",
        )


def _begun(steps: Floats, first: Any) -> Any:
    return np.concatenate(
        [np.broadcast_to(first, (1, *steps.shape[1:])).astype(steps.dtype), steps]
    )


def _text(value: object) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _triangles(faces: Ints) -> Ints:
    """Triangles of triangles or quadrilaterals."""
    if faces.shape[1:] != (4,):
        return faces
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
