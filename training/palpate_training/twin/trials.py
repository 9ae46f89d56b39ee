"""One trial from robot to data set: raw streams, then rows, then rows with a simulated field.

Everything is in the sensor frame (x distal, y lateral, z dorsal), SI; force is the force on the
BioTac. A *trajectory* is planned once and has an id; a *trial* is its execution on one unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.uint16]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TrialHeader:
    """What a trial is.

    Attributes:
        unit: Name of the BioTac, e.g. ``biotac-1``.
        trajectory: Id of the planned trajectory, ``<indenter>/<point>/<normal|angled-k>``; the same
            on every unit.
        indenter: Name of the indenter.
        arm: ``left`` or ``right``: which arm of the robot executed it.
    """

    unit: str
    trajectory: str
    indenter: str
    arm: str


@dataclass(frozen=True, slots=True)
class RawTrial:
    """Streams of one trial on one clock, at 100 Hz or more, from 3 mm before contact on.

    Attributes:
        header: What it is.
        time_s: Of each sample [s], shape (T,), increasing.
        electrodes: Raw counts [counts], shape (T, 19).
        force: Of the force/torque sensor, not tared [N], shape (T, 3).
        tip: Indenter's tip by the robot's kinematics and the registration [m], shape (T, 3).
        travel_m: Commanded travel along the path [m], shape (T,); 0 where it starts.
        increment_end: Index of the last sample of each increment, shape (I,), increasing; the first
            is before any contact.
    """

    header: TrialHeader
    time_s: Floats
    electrodes: Counts
    force: Floats
    tip: Floats
    travel_m: Floats
    increment_end: Indices


@dataclass(frozen=True, slots=True)
class SimulatedTrial:
    """What finite elements say of a trajectory, step by step, from first contact on.

    Attributes:
        trajectory: Its id.
        travel_m: Indenter's travel along the path at each step [m], shape (S,), increasing, on any
            origin.
        force: Net force on the BioTac [N], shape (S, 3).
        displacement: Of every node from the pressurised state [m], shape (S, V, 3), float32.
        converged: How many of the steps are to be believed: those before a divergence.
    """

    trajectory: str
    travel_m: Floats
    force: Floats
    displacement: npt.NDArray[np.float32]
    converged: int


@dataclass(frozen=True, slots=True)
class TrialRows:
    """Rows of one trial after the paper's processing, in order of travel.

    Attributes:
        header: What it is.
        rest: Untouched counts that were subtracted [counts], shape (19,).
        travel_m: Indenter's travel since the row at exactly 0.5 N [m], shape (R,); starts at 0.
        tared: Electrodes minus rest, over full scale [1], shape (R, 19).
        force: Tared, filtered force on the BioTac [N], shape (R, 3).
        location: Contact location: the indenter's tip as measured [m], shape (R, 3).
    """

    header: TrialHeader
    rest: Floats
    travel_m: Floats
    tared: Floats
    force: Floats
    location: Floats


@dataclass(frozen=True, slots=True)
class MixedRows:
    """Experiment and simulation of one trial at the same displacements, 20 of them.

    Attributes:
        rows: The experiment, interpolated; its ``travel_m`` is evenly spaced from 0.
        simulated_force: Net force of the simulation there [N], shape (R, 3).
        displacement: Nodal displacement there [m], shape (R, V, 3), float32.
    """

    rows: TrialRows
    simulated_force: Floats
    displacement: npt.NDArray[np.float32]
