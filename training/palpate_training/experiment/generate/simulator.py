"""Settings of an experiment, and what it needs of a simulation.

Training must not import the finite elements. These protocols are what it needs of them, and deploy
passes an implementation in. Arrays are in the sensor frame, SI.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from palpate.cluster import RayCluster
from palpate.rigid import path_lengths
from palpate_training.experiment.plan import PlannedManipulation, PlannedTrajectory

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Counts = npt.NDArray[np.uint16]

OnProgress = Callable[[int, int, str], None]
"""Called with how many are done, of how many, and a word on them."""

FLUID_VOLUME_M3 = 6.0e-7
"""Fill of the twin [m^3]: docs/adr/0016 explains why it is less than 15.1 mm of thickness needs."""

EDGE_M = 0.6e-3
"""Edge of the mesh on the pad [m]; the mesh study puts its force error below 1 %."""

LAYERS = 2
"""Elements through the skin."""

SKIN = ("skin_thickness_m", "shear_modulus_pa", "strain_stiffening", "friction_coefficient")
"""Settings of an experiment that say what its skin is."""

_STRAIGHT_M = 1e-9
"""A path that is longer than the distance of its ends by no more than this is straight [m]."""

OVERTRAVEL_M = 0.6e-3
"""How much deeper than the paper's depths paths go [m]: robots stand wrong by up to that."""


@dataclass(frozen=True, slots=True)
class ExperimentSpec:
    """Everything that decides the rows of the data sets.

    Attributes:
        points: Points for each indenter.
        angled: Angled paths at each point.
        seed: Of points, registration and noise.
        edge_m: Edge of the mesh on the pad [m].
        fluid_volume_m3: Fill [m^3].
        overtravel_m: How much deeper than the paper's depths the paths go [m].
        indenters: Names; empty = all nine.
        paths: Further paths at each point, in words of segments (``palpate fem run --path``), whose
            direction and length are as written: no overtravel.
        presses: Presses at random instead of points, angles and paths; 0 = none.
        units_each: Specimens that execute each trajectory, drawn by its name; 0 = all.
        skin_thickness_m: Of the unpressurised skin [m]; None = the simulator's own, as below.
        shear_modulus_pa: Of the skin [Pa].
        strain_stiffening: Of the skin, as `palpate_fem.config.FingertipParameters` has it.
        friction_coefficient: Between indenter and skin.
        registration_seed: Of the robots' registration; None = ``seed``. Experiments of the same
            specimens with the same one are by robots that stand equally wrong.
        exact_labels: Contact locations are where the tip truly was, not where robots that stand
            wrong believe it; they press as deep all the same.
        layers: Elements through the skin.
    """

    points: int = 10
    angled: int = 4
    seed: int = 0
    edge_m: float = EDGE_M
    fluid_volume_m3: float = FLUID_VOLUME_M3
    overtravel_m: float = OVERTRAVEL_M
    indenters: tuple[str, ...] = ()
    paths: tuple[str, ...] = ()
    presses: int = 0
    units_each: int = 0
    skin_thickness_m: float | None = None
    shear_modulus_pa: float | None = None
    strain_stiffening: float | None = None
    friction_coefficient: float | None = None
    registration_seed: int | None = None
    exact_labels: bool = False
    layers: int = LAYERS

    def content(self) -> dict[str, Any]:
        """As plain values; those that came later only where they are used."""
        values = asdict(self)
        later = {
            "paths": (),
            "presses": 0,
            "units_each": 0,
            "exact_labels": False,
            "layers": LAYERS,
            **dict.fromkeys((*SKIN, "registration_seed")),
        }
        return {
            key: value for key, value in values.items() if key not in later or value != later[key]
        }


class SimulatedStep(Protocol):
    """One converged step of a simulated trajectory."""

    @property
    def pose(self) -> Floats:
        """Of the indenter: position [m] and quaternion w x y z, shape (7,)."""

    @property
    def displacement(self) -> npt.NDArray[np.floating[Any]]:
        """Of every node from the pressurised state [m], shape (V, 3)."""

    @property
    def indenter_force(self) -> npt.NDArray[np.floating[Any]]:
        """Force of the indenter on every node [N], shape (V, 3)."""

    @property
    def force(self) -> Floats:
        """Net force on the BioTac [N], shape (3,)."""

    @property
    def torque(self) -> Floats:
        """Its moment about the origin [N m], shape (3,)."""

    @property
    def fluid_pressure_pa(self) -> float:
        """Above ambient [Pa]."""


class SimulatedPath(Protocol):
    """What was asked of a simulated trajectory."""

    @property
    def indenter(self) -> str:
        """Name of the indenter."""

    @property
    def path(self) -> Floats:
        """Requested poses, the first one clear of the skin, shape (K + 1, 7)."""


class SimulatedTrajectory(SimulatedPath, Protocol):
    """A simulated trajectory; what converged of it."""

    @property
    def steps(self) -> Sequence[SimulatedStep]:
        """Converged steps, in order of the path."""


def travelled(trajectory: SimulatedPath, steps: Sequence[SimulatedStep]) -> Floats:
    """Travel from the first pose of a trajectory to each of its first steps [m], shape (S,).

    Of a straight press it is the distance, which stored data sets hold to the last bit; of any
    other path its length, turns included.
    """
    path = trajectory.path
    whole = float(np.linalg.norm(path[-1, :3] - path[0, :3]))
    if path_lengths(path)[-1] <= whole + _STRAIGHT_M:
        poses = np.array([step.pose[:3] for step in steps])
        return np.asarray(np.linalg.norm(poses - path[0, :3], axis=1))
    return path_lengths(np.array([path[0], *(step.pose for step in steps)]))[1:]


class SkinSolid(Protocol):
    """The skin's mesh."""

    @property
    def outer_faces(self) -> Ints:
        """Triangles or quadrilaterals of the outer surface, outward."""

    @property
    def inner_faces(self) -> Ints:
        """Likewise of the inner surface."""

    @property
    def outer_nodes(self) -> Ints:
        """Ids of the nodes of the outer surface."""

    @property
    def sha256(self) -> bytes:
        """Content hash."""


class SimulatedFingertip(Protocol):
    """The pressurised, untouched fingertip that all trajectories share."""

    @property
    def mesh(self) -> SkinSolid:
        """The skin."""

    @property
    def pressurised_nodes(self) -> Floats:
        """Positions from which displacements count [m], shape (V, 3)."""

    @property
    def fluid_pressure_pa(self) -> float:
        """Above ambient [Pa]."""

    @property
    def key(self) -> str:
        """Digest, hex, of mesh, parameters and settings."""


class IndentationStore(Protocol):
    """Simulated trajectories on disk."""

    @property
    def path(self) -> Path:
        """Where it is."""

    def ids(self) -> Collection[str]:
        """Ids of the trajectories that are there."""

    def fingertip(self) -> SimulatedFingertip:
        """What was pressed."""

    def trajectory(self, trajectory: str, /) -> SimulatedTrajectory:
        """A trajectory with its fields."""

    def summary(self, trajectory: str, /) -> SimulatedPath:
        """A trajectory without its fields."""


ElectrodeStream = Callable[[Floats, Floats, Floats, Floats], Counts]
"""The electrodes of one specimen over time, with creep, noise and rounding: counts that are read,
each electrode at its own instant of the frame. Takes the ideal counts at the starts of frames,
shape (T, 19), those starts [s], the time since the frame before [s], and ln of the fluid's
conductivity over that of the ideal counts, each shape (T,)."""


@dataclass(frozen=True, slots=True)
class Specimen:
    """One simulated BioTac; can be pickled.

    Attributes:
        name: E.g. ``biotac-1``.
        overtravel_m: How much deeper it is pressed than planned [m].
        temperature_coefficient: Change of ln conductivity with temperature [1/K].
        parameters: Its electrical parameters, of the simulator's own type.
        parameters_json: The same as text, as a tape holds them.
        content: All that decides its rows, as plain values; kept in the experiment's file.
        pressed_with: Whether it meets an indenter, by name.
        stream: Its electrodes over time, from the ideal counts of the untouched state, shape (19,),
            and a seed: same seed, same noise.
        warming: Ln of the conductivity at ages since power-on [s], shape (T,).
    """

    name: str
    overtravel_m: float
    temperature_coefficient: float
    parameters: Any
    parameters_json: str
    content: Mapping[str, Any]
    pressed_with: Callable[[str], bool]
    stream: Callable[[Floats, int], ElectrodeStream]
    warming: Callable[[Floats], Floats]


class PressedSpecimens(Protocol):
    """Electrodes of specimens of one fingertip: expensive to make, so a process makes them once."""

    rest_counts: Mapping[str, Floats]
    """Ideal counts of each untouched specimen, by name, shape (19,)."""

    def counts(
        self, steps: Sequence[SimulatedStep], names: Collection[str]
    ) -> Mapping[str, Floats]:
        """Ideal counts of the named specimens at each step, by name, shape (S, 19)."""


MakeSpecimens = Callable[[], PressedSpecimens]
"""Makes them on a worker: hashable and equal by what it makes; can be pickled."""


class TwinSimulator(Protocol):
    """Finite elements and film electrodes, as the experiment uses them; can be pickled.

    Hashable, and equal to what does the same: workers know by it what they have opened already.
    """

    @property
    def clearance_m(self) -> float:
        """How far from the skin the path of a simulated trajectory starts [m]."""

    def __hash__(self) -> int: ...

    def fingertip(self, spec: ExperimentSpec) -> SimulatedFingertip:
        """Pressurise the fingertip of an experiment, in this process."""

    def plans(
        self, spec: ExperimentSpec, fingertip: SimulatedFingertip
    ) -> Sequence[PlannedTrajectory]:
        """All presses of an experiment, first points first, each for the arm on its side."""

    def manipulations(
        self, spec: ExperimentSpec, fingertip: SimulatedFingertip
    ) -> Sequence[PlannedManipulation]:
        """Its other paths, or presses at random, likewise."""

    def simulate(
        self,
        spec: ExperimentSpec,
        store: Path,
        *,
        workers: int,
        threads: int,
        stop: threading.Event,
        on_progress: OnProgress,
        devices: tuple[str, ...] = (),
        slots: int | None = None,
        cluster: RayCluster | None = None,
    ) -> bool:
        """Fill a store; what it holds is not run again.

        Args:
            spec: The experiment.
            store: The store; made if it is not there.
            workers: Processes.
            threads: Threads of each.
            stop: Set it to end early.
            on_progress: Called with the progress.
            devices: Devices that solve ``slots`` trajectories at once each, instead of ``workers``
                that solve one.
            slots: None = as many as the simulator thinks best.
            cluster: Whose machines simulate instead of this host; ``devices`` are then its.

        Returns:
            Whether all is there; False = stopped.

        Raises:
            SimulationError: Some failed; run again, it goes on.
            DatasetError: Another process has claimed some, or the store is damaged.
        """

    def open_store(self, path: Path) -> IndentationStore:
        """Open a store.

        Raises:
            DatasetError: There is none, or it is damaged.
        """

    def make_specimens(
        self, fingertip: SimulatedFingertip, specimens: Iterable[Specimen]
    ) -> MakeSpecimens:
        """What makes the specimens' electrodes in a worker process."""

    def clear_steps(self, indentation: SimulatedTrajectory, fingertip: SimulatedFingertip) -> int:
        """How many steps there are before the indenter bears on what holds the finger."""
