"""Small meshes and a small finger; the service on its own bus, its workers solving a formula."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.client import Client
from palpate.config import LinkConfig, parse_config
from palpate.errors import PalpateError
from palpate_fem.config import FingertipParameters
from palpate_fem.mechanics.iteration import NewtonSettings
from palpate_fem.mechanics.load_stepping import SolverSettings
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mechanics.system import EquilibriumSystem
from palpate_fem.mesh.core import DistanceGrid, RigidCore
from palpate_fem.mesh.solid import FingertipGeometry, SolidMesh
from palpate_fem.service import node
from palpate_fem.service.config import FemConfig

FOLDER = str(Path(__file__).parent)
sys.path.append(FOLDER)  # tests import the fakes by name, as worker processes do
SEARCH_PATH = os.pathsep.join([FOLDER, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
PATIENCE_S = 20.0
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Shell = Callable[..., SolidMesh]
Fill = Callable[..., Fingertip]

FAKES = {"factory": "fem_fakes:make", "workers": 2, "waiting": 2, "grace_s": 0.3, "threads": 1}


class Served:
    """The service in a thread, and a robot."""

    def __init__(self, link: LinkConfig, values: dict[str, Any]) -> None:
        self.stop = threading.Event()
        self.error: BaseException | None = None
        self.link = link
        self._config = parse_config(FemConfig, {**FAKES, **values}, where="test")
        self.thread = threading.Thread(target=self._run)
        self.thread.start()
        self.robot = Client(link.connect[0], timeout_s=5)

    def _run(self) -> None:
        try:
            node.run(self._config, self.link, "lab", self.stop)
        except PalpateError as error:
            self.error = error

    def until(self, true: Callable[[], Any]) -> Any:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            if value := true():
                return value
            time.sleep(0.02)
        raise AssertionError("it did not become true in time")

    def ready(self) -> bool:
        return any(a.service == "fem" and a.ready for a in self.robot.alive())

    def counters(self) -> dict[str, int]:
        return dict(self.robot.status()[0].counters)

    def close(self) -> None:
        self.robot.close()
        self.stop.set()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()

    def in_thread(self, *args: Any, **more: Any) -> tuple[threading.Thread, list[Any]]:
        """What ``simulate`` returns or raises."""
        out: list[Any] = []

        def run() -> None:
            try:
                out.append(self.robot.simulate(*args, **more))
            except PalpateError as error:
                out.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        return thread, out


@pytest.fixture
def own_bus(link: LinkConfig, monkeypatch: pytest.MonkeyPatch) -> LinkConfig:
    """A bus for a service that does not outlive its test."""
    monkeypatch.setenv("PYTHONPATH", SEARCH_PATH)
    return link


@pytest.fixture(scope="module")
def bus(router: Callable[[], AbstractContextManager[LinkConfig]]) -> Iterator[LinkConfig]:
    """A router on a free port, and workers that find the fakes."""
    with router() as link, pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", SEARCH_PATH)
        yield link


@contextmanager
def _serving(bus: LinkConfig, **values: Any) -> Iterator[Served]:
    served = Served(bus, values)
    try:
        served.until(served.ready)
        yield served
    finally:
        served.close()


@pytest.fixture(scope="module")
def service(bus: LinkConfig) -> Iterator[Served]:
    """One service for all tests that leave it as it was."""
    with _serving(bus) as served:
        yield served


@pytest.fixture
def serving(own_bus: LinkConfig) -> Callable[..., AbstractContextManager[Served]]:
    """A ready service for one test, with other values of its configuration."""
    return lambda **values: _serving(own_bus, **values)


@pytest.fixture
def starting(own_bus: LinkConfig) -> Iterator[Callable[..., Served]]:
    """The same, from the moment it starts."""
    started: list[Served] = []

    def start(**values: Any) -> Served:
        started.append(Served(own_bus, values))
        return started[-1]

    yield start
    for served in started:
        served.close()


@pytest.fixture
def workers_find_fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that start worker processes themselves."""
    monkeypatch.setenv("PYTHONPATH", SEARCH_PATH)


def _solid(
    nodes: Floats, quads: NDArray[np.int64], layers: int, corners: int, *, cavity: bool
) -> SolidMesh:
    """Layers upon quads: node n of layer l has the number n (layers + 1) + l."""
    halves = [quads] if corners == 8 else [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    faces = (np.concatenate(halves) * (layers + 1)).astype(np.int32)
    count = len(faces)
    elements = [np.concatenate([faces + k, faces + k + 1], axis=1) for k in range(layers)]
    everyone = np.arange(count * layers, dtype=np.int32)
    none = np.zeros(0, np.int32)
    return SolidMesh(
        nodes=nodes,
        elements=np.concatenate(elements),
        outer_faces=faces + np.int32(layers),
        outer_elements=everyone[-count:],
        inner_faces=faces if cavity else np.zeros((0, faces.shape[1]), np.int32),
        inner_elements=everyone[: count if cavity else 0],
        fixed=none,
        mirror=none,
    )


def _quads(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    corners = [grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def make_block(
    counts: tuple[int, int, int], size_m: float = 1e-3, *, corners: int = 8
) -> SolidMesh:
    """Cubes of one size, or halves of them; the outer surface is the top, there is no cavity."""
    x, y, z = (size_m * np.arange(n + 1) for n in counts)
    nodes = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = np.arange(len(x) * len(y)).reshape(len(x), len(y))
    return _solid(nodes, _quads(grid), counts[2], corners, cavity=False)


def make_shell(
    around: int, layers: int, inner_m: float, outer_m: float, *, corners: int = 8
) -> SolidMesh:
    """Thick sphere: the squares of a cube, blown up."""
    part = np.tan(np.linspace(-np.pi / 4, np.pi / 4, around + 1))
    part = (part - part[::-1]) / 2  # symmetric to the last bit
    side = np.stack(np.meshgrid([1.0], part, part, indexing="ij"), axis=-1).reshape(-1, 3)
    quads = _quads(np.arange(len(side)).reshape(around + 1, around + 1))
    points = np.concatenate([sign * np.roll(side, k, axis=1) for k in range(3) for sign in (1, -1)])
    turned = (quads, quads[:, ::-1])  # seen from outside, a point reflection turns them round
    cells = np.concatenate([turned[k % 2] + k * len(side) for k in range(6)])
    places = np.round(points, 9) + 0.0
    _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
    direction = points[first]
    # Sorted, so that nodes that mirror one another get the same length.
    length = np.sqrt(np.sum(np.sort(direction**2, axis=1), axis=1))
    direction /= length[:, None]
    radii = np.linspace(inner_m, outer_m, layers + 1)
    nodes = (direction[:, None] * radii[:, None]).reshape(-1, 3)
    quads = np.asarray(number.reshape(-1)[cells], np.int64)
    _, mirror = cKDTree(nodes).query(nodes * (1.0, -1.0, 1.0))
    solid = _solid(nodes, quads, layers, corners, cavity=True)
    return replace(solid, mirror=mirror.astype(np.int32)) if corners == 8 else solid


def make_ball(radius_m: float, spacing_m: float = 0.25e-3) -> RigidCore:
    """A ball about the origin as a core."""
    axis = spacing_m * np.arange(-16.0, 17.0)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = np.linalg.norm(points, axis=-1) - radius_m
    grid = DistanceGrid.sampled(np.full(3, axis[0]), spacing_m, values)
    none = np.zeros((0, 3))
    return RigidCore(grid, none, none.astype(np.int32), 4 / 3 * np.pi * radius_m**3, "ball")


@pytest.fixture(scope="session")
def block() -> Shell:
    return make_block


@pytest.fixture(scope="session")
def shell() -> Shell:
    return make_shell


@pytest.fixture(scope="session")
def ball() -> Callable[..., RigidCore]:
    return make_ball


@pytest.fixture(scope="session")
def assembled() -> Callable[..., Floats]:
    """Dense matrix of all unknowns from blocks (C, k, 3, k, 3) of cells (C, k)."""

    def assemble(cells: Ints, blocks: Floats, nodes: int) -> Floats:
        unknowns = (3 * cells[:, :, None] + np.arange(3)).reshape(len(cells), -1)
        matrix = np.zeros((3 * nodes, 3 * nodes))
        for rows, block in zip(unknowns, blocks.reshape(*unknowns.shape, -1), strict=True):
            matrix[np.ix_(rows, rows)] += block
        return matrix

    return assemble


@pytest.fixture(scope="session")
def dense() -> Callable[[EquilibriumSystem], Floats]:
    """The symmetric tangent of a system's last balance, over its free unknowns."""

    def tangent(system: EquilibriumSystem) -> Floats:
        pattern, size = system.pattern, len(system.pattern.free)
        upper = np.zeros((size, size))
        rows = np.repeat(np.arange(size), np.diff(pattern.indptr))
        upper[rows, pattern.indices] = system.tangent_values()
        return np.asarray(upper + np.triu(upper, 1).T)

    return tangent


@pytest.fixture(scope="session")
def finger_geometry() -> FingertipGeometry:
    """Half a sphere of skin, the other half held, about a ball: 1,900 unknowns."""
    mesh = make_shell(8, 2, 3e-3, 4.5e-3)
    held = np.flatnonzero(mesh.nodes[:, 2] > 0.2e-3).astype(np.int32)
    return FingertipGeometry(replace(mesh, fixed=held, name="half sphere"), make_ball(2.5e-3))


@pytest.fixture(scope="session")
def fill(finger_geometry: FingertipGeometry) -> Fill:
    """The same finger, filled, with other settings and parameters."""

    def make(settings: SolverSettings | None = None, **parameters: float) -> Fingertip:
        parameters = {"fluid_volume_m3": 61e-9, **parameters}
        return Fingertip.pressurised(finger_geometry, FingertipParameters(**parameters), settings)

    return make


@pytest.fixture(scope="session")
def finger(fill: Fill) -> Fingertip:
    """The small finger for all tests that leave it as it was."""
    return fill()


@pytest.fixture(scope="session")
def settled() -> SolverSettings:
    """The mortar correction of contact comes to rest, so that a state does not know its way."""
    return SolverSettings(newton=NewtonSettings(mortar_updates=30))
