"""The Rerun view of simulations: a store in, one ``.rrd`` with an explicit layout out.

A tab for each trajectory: the pressurised skin coloured by its displacement, the core, the
indenter, the contact forces, and curves over the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate.files.hdf5 import text
from palpate.files.simulation_store import SimulationFiles, choose_trajectories
from palpate.process import require
from palpate_services.viewer.layout import (
    AXES,
    SIDES,
    STEP,
    TRUTH_COLOUR,
    simulation_fixtures,
    simulation_layout,
)
from palpate_services.viewer.record_view import APPLICATION
from palpate_services.viewer.surfaces import Floats, Ints, border_of, normals_of, shades

_FIELDS = ("displacement", "indenter_force", "core_force")

MOST = 8
"""Trajectories in one view by default: each takes 4 MB and a tab."""

LONGEST_ARROW_M = 3e-3
"""Length of a trajectory's largest nodal force."""

NET_ARROW_M_PER_N = 5e-4

_TOUCH_COLOUR = (240, 82, 96)
_CORE_PUSH_COLOUR = (120, 200, 255)
_CORE_COLOUR = (92, 108, 140)
_INDENTER_COLOUR = (226, 182, 120)


def review_simulations(
    store: Path,
    view: Path | None = None,
    *,
    trajectories: Sequence[str] = (),
    most: int = MOST,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Make the view of a store, by default beside it with the ending ``.rrd``; returns its path.

    It is written whole or not at all; one that is there is replaced. ``trajectories`` chooses some
    by id or pattern; without, ``most`` are evenly chosen from all.
    ``progress`` is called with the number of drawn trajectories and of all.

    Raises:
        DatasetError: The store is damaged, has none of these, or the view cannot be written.
        MissingExtraError: Rerun or h5py is not installed.
    """
    rr = require("rerun", extra="services")
    simulations = DrawnSimulations.open(store)
    names = choose_trajectories(simulations.ids(), trajectories, most)
    finger = simulations.fingertip()
    # One scale for all, so that colours can be compared between tabs.
    longest_m = max(_largest(simulations.trajectory(name).displacement) for name in names) or 1e-3
    target = store.with_suffix(".rrd") if view is None else view
    stream = rr.RecordingStream(APPLICATION)
    with written_whole(target) as part:
        try:
            stream.save(part, default_blueprint=simulation_layout(names, longest_m))
            stream.send_recording_name(store.stem)
            for count, name in enumerate(names):
                if progress is not None:
                    progress(count, len(names))
                _Drawing(rr, stream, finger, simulations.trajectory(name), longest_m).draw()
            stream.flush(timeout_sec=30.0)
        except DatasetError:
            raise
        except Exception as error:  # Rerun's errors share no base of their own
            raise DatasetError(
                f"{target}: Rerun cannot write the view: {error}",
                remedy="check the folder's rights and free space; the store is not affected",
            ) from error
        finally:
            stream.disconnect()
    return target


class _Drawing:
    """Draws one trajectory into the stream."""

    def __init__(
        self, rr: Any, stream: Any, finger: DrawnFingertip, press: DrawnTrajectory, longest_m: float
    ) -> None:
        self._rr, self._stream, self._finger, self._press = rr, stream, finger, press
        self._longest_m = longest_m
        self._count = len(press.pose)
        self._positions = (finger.nodes + press.displacement).astype(np.float32)

    def draw(self) -> None:
        self._fixed()
        self._skin()
        self._indenter()
        self._patch()
        press = self._press
        largest = max(_largest(press.indenter_force), _largest(press.core_force)) or 1.0
        for name, force, colour in (
            ("indenter", press.indenter_force, _TOUCH_COLOUR),
            ("core", press.core_force, _CORE_PUSH_COLOUR),
        ):
            loaded = np.abs(force).max(axis=2) > 1e-3 * largest
            self._arrows(
                f"finger/push/{name}",
                [self._positions[at][loaded[at]] for at in range(self._count)],
                [LONGEST_ARROW_M / largest * force[at][loaded[at]] for at in range(self._count)],
                colour,
                4e-5,
            )
        self._net_force()
        for at, axis in enumerate(AXES):
            self._curve(f"force/{axis}", press.force[:, at])
        self._curve("pressure", press.fluid_pressure_pa)
        self._curve("area", press.contact_area_m2)
        self._curve("newton", press.iterations)

    def _fixed(self) -> None:
        """What does not change: the core, colours of the curves, the description."""
        rr, press, finger = self._rr, self._press, self._finger
        vertices = finger.core_vertices.astype(np.float32)
        core = rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=finger.core_faces,
            vertex_normals=normals_of(vertices, finger.core_faces),
            albedo_factor=_CORE_COLOUR,
        )
        self._log("finger/core", core)
        for entity, look in simulation_fixtures(rr).items():
            self._log(entity, look)
        peak = np.linalg.norm(press.force, axis=1).max(initial=0.0)
        facts = {
            "indenter": press.indenter,
            "outcome": press.outcome + (f": {press.reason}" if press.reason else ""),
            "steps": str(self._count - 1),
            "largest force": f"{peak:.3g} N",
            **finger.facts,
        }
        lines = [f"| {name} | {value} |" for name, value in facts.items()]
        about = "\n".join([f"**{press.id}**", "", "| | |", "|---|---|", *lines])
        self._log("about", rr.TextDocument(about, media_type="text/markdown"))

    def _skin(self) -> None:
        """Outer and inner surface, as two halves."""
        rr, finger = self._rr, self._finger
        faces = np.concatenate([finger.outer, finger.inner])
        lateral = finger.nodes[faces][:, :, 1].mean(axis=1)
        moved = np.linalg.norm(self._press.displacement, axis=2)
        colours = shades(moved / self._longest_m)
        normals = np.stack([normals_of(positions, faces) for positions in self._positions])
        for side, chosen in zip(SIDES, (lateral >= 0, lateral < 0), strict=True):
            used, triangles = np.unique(faces[chosen], return_inverse=True)
            if not len(used):
                continue
            entity = f"finger/skin/{side}"
            indices = triangles.reshape(-1, 3).astype(np.uint32)
            self._log(entity, rr.Mesh3D.from_fields(triangle_indices=indices))
            columns = rr.Mesh3D.columns(
                vertex_positions=self._positions[:, used].reshape(-1, 3),
                vertex_normals=normals[:, used].reshape(-1, 3),
                vertex_colors=colours[:, used].reshape(-1),
            )
            self._send(entity, columns.partition([len(used)] * self._count))

    def _indenter(self) -> None:
        rr, press = self._rr, self._press
        w, x, y, z = press.pose[:, 3:].T
        columns = rr.Transform3D.columns(
            translation=press.pose[:, :3], quaternion=np.stack([x, y, z, w], axis=1)
        )
        self._send("finger/indenter", columns)
        if press.shape is None:
            self._log("finger/indenter/tip", rr.Points3D([[0.0, 0.0, 0.0]], radii=[3e-4]))
            return
        vertices, faces = press.shape[0].astype(np.float32), press.shape[1]
        # Corners are not shared between faces: shared normals would round the edges of a cube.
        corners = vertices[faces].reshape(-1, 3)
        alone = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
        body = rr.Mesh3D(
            vertex_positions=corners,
            triangle_indices=alone,
            vertex_normals=normals_of(corners, alone),
            albedo_factor=_INDENTER_COLOUR,
        )
        self._log("finger/indenter/shape", body)

    def _patch(self) -> None:
        """Outline of the triangles that the indenter loads, and the centre of pressure."""
        rr, press = self._rr, self._press
        strips = []
        for positions, force in zip(self._positions, press.indenter_force, strict=True):
            loaded = np.abs(force).max(axis=1) > 0
            touched = self._finger.outer[loaded[self._finger.outer].all(axis=1)]
            strips.append(list(positions[border_of(touched)]))
        self._log("finger/patch", rr.LineStrips3D.from_fields(colors=[_TOUCH_COLOUR], radii=[7e-5]))
        columns = rr.LineStrips3D.columns(strips=[strip for step in strips for strip in step])
        self._send("finger/patch", columns.partition([len(step) for step in strips]))
        there = np.isfinite(press.centre_of_pressure).all(axis=1)
        centres = press.centre_of_pressure[there]
        self._log(
            "finger/centre_of_pressure",
            rr.Points3D.from_fields(colors=[TRUTH_COLOUR], radii=[2e-4]),
        )
        columns = rr.Points3D.columns(positions=centres).partition(there.astype(int))
        self._send("finger/centre_of_pressure", columns)

    def _net_force(self) -> None:
        press = self._press
        steps = range(self._count)
        known = [[k] if np.isfinite(press.centre_of_pressure[k]).all() else [] for k in steps]
        at = [press.centre_of_pressure[k] for k in known]
        vectors = [NET_ARROW_M_PER_N * press.force[k] for k in known]
        self._arrows("finger/force", at, vectors, TRUTH_COLOUR, 1.5e-4)

    def _arrows(
        self,
        entity: str,
        ends: Sequence[Floats],
        vectors: Sequence[Floats],
        colour: tuple[int, int, int],
        radius_m: float,
    ) -> None:
        """Forces on the skin; each arrow ends at its point of attack."""
        rr = self._rr
        self._log(entity, rr.Arrows3D.from_fields(colors=[colour], radii=[radius_m]))
        flat = np.concatenate(vectors).astype(np.float32)
        origins = np.concatenate(ends).astype(np.float32) - flat
        columns = rr.Arrows3D.columns(vectors=flat, origins=origins)
        self._send(entity, columns.partition([len(step) for step in vectors]))

    def _curve(self, entity: str, values: npt.NDArray[Any]) -> None:
        columns = self._rr.Scalars.columns(scalars=np.asarray(values, np.float64))
        self._send(entity, columns)

    def _log(self, entity: str, value: Any) -> None:
        self._stream.log(f"{self._press.id}/{entity}", value, static=True)

    def _send(self, entity: str, columns: Any) -> None:
        steps = self._rr.TimeColumn(STEP, sequence=range(self._count))
        self._stream.send_columns(f"{self._press.id}/{entity}", [steps], columns)


def _largest(vectors: Floats) -> float:
    """Largest magnitude of vectors of shape (K, V, 3)."""
    return float(np.linalg.norm(vectors, axis=2).max(initial=0.0))


@dataclass(frozen=True, slots=True)
class DrawnFingertip:
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
class DrawnTrajectory:
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


class DrawnSimulations(SimulationFiles):
    """A store of simulations, read for drawing."""

    def fingertip(self) -> DrawnFingertip:
        """The fingertip.

        Raises:
            DatasetError: Damaged, or a file of measured trajectories, which has none.
        """
        with self.head() as file:
            tip = file["fingertip"]
            facts = {name: f"{float(value):g}" for name, value in tip["parameters"].attrs.items()}
            for name in ("fluid_pressure_pa", "total_thickness_m"):
                facts[name] = f"{tip.attrs[name]:g}"
            facts["mesh"] = f"{text(tip.attrs['mesh_name'])}, {len(tip['nodes']):,} nodes"
            return DrawnFingertip(
                nodes=tip["pressurised_nodes"][()],
                outer=_triangles(tip["outer_faces"][()]),
                # Kept with normals into the solid, which is right for a volume and not for a light.
                inner=_triangles(tip["inner_faces"][()])[:, ::-1],
                core_vertices=tip["core_vertices"][()],
                core_faces=tip["core_faces"][()],
                facts=facts,
            )

    def trajectory(self, trajectory: str) -> DrawnTrajectory:
        """One trajectory.

        Raises:
            DatasetError: Not there, damaged, or measured, so without fields.
        """
        with self.head() as file:
            rest_pa = float(file["fingertip"].attrs["fluid_pressure_pa"])
        with self.group(trajectory) as group:
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
            return DrawnTrajectory(
                id=trajectory,
                indenter=text(group.attrs["indenter"]),
                outcome=text(group.attrs["outcome"]),
                reason=text(group.attrs["reason"]),
                **{name: _begun(group[name][()], first) for name, first in before.items()},
                iterations=_begun(group["convergence"]["iterations"], 0),
                shape=shape,
            )


def _begun(steps: Floats, first: Any) -> Any:
    return np.concatenate(
        [np.broadcast_to(first, (1, *steps.shape[1:])).astype(steps.dtype), steps]
    )


def _triangles(faces: Ints) -> Ints:
    """Triangles of triangles or quadrilaterals."""
    if faces.shape[1:] != (4,):
        return faces
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
