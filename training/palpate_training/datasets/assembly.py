"""Experiment and simulation at the same displacements.

Paper, section "Experimental and simulation data processing".

Trials put together to the data sets, in an order that does not depend on who finished first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from palpate.errors import DatasetError
from palpate_training.datasets.basis import FieldEncoder
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.experiment import (
    ExperimentDataset,
    FieldBasis,
    FloatArray,
    MixedDataset,
    SimulatedContact,
    SkinMesh,
)
from palpate_training.datasets.features import ELECTRODES
from palpate_training.datasets.processing import (
    THRESHOLD_N,
    Floats,
    Values,
    from_threshold,
)
from palpate_training.datasets.trials import MixedRows, SimulatedTrial, TrialRows, trial_name

INCREMENTS = 20
"""Evenly spaced displacements of a mixed trial (paper, step 5)."""


def common_trajectories(
    trials: Iterable[TrialRows], simulated: Collection[str]
) -> tuple[list[TrialRows], list[tuple[str, str]]]:
    """Trials whose trajectory was simulated; names and reasons of the others (paper, step 1)."""
    both, dropped = [], []
    for rows in trials:
        if rows.header.trajectory in simulated:
            both.append(rows)
        else:
            dropped.append((trial_name(rows.header), "its trajectory was not simulated"))
    return both, dropped


def mix(rows: TrialRows, simulated: SimulatedTrial, count: int = INCREMENTS) -> MixedRows:
    """Bring a trial and its simulation to the same displacements (paper, steps 2 to 5).

    The simulation is cut where it diverged, begins at exactly 0.5 N like the experiment, and both
    end at the smaller of their final displacements, counted from 0.5 N.

    Args:
        rows: Processed trial; begins at exactly 0.5 N.
        simulated: Its trajectory in finite elements; its first step is below 0.5 N.
        count: Rows of the result, from 0.5 N to the common final displacement.

    Raises:
        DatasetError: They are of different trajectories, the simulation begins above 0.5 N or never
            reaches it before it diverges, or nothing but one row is common.
    """
    name = trial_name(rows.header)
    if rows.header.trajectory != simulated.trajectory:
        raise DatasetError(
            f"{name}: the simulation is of {simulated.trajectory}",
            remedy="mix a trial with the simulation of its own trajectory",
        )
    travel_m, force, displacement, contact_force, shares = _aligned(name, simulated)
    final_m = min(float(rows.travel_m[-1]), float(travel_m[-1]))
    if final_m <= 0.0:
        short = "experiment" if len(rows.travel_m) < 2 else "simulation"
        raise DatasetError(
            f"{name}: the {short} has one row at {THRESHOLD_N} N and none beyond",
            remedy="press deeper, or drop the trial",
        )
    at_m = np.linspace(0.0, final_m, count)
    measured = replace(
        rows,
        travel_m=at_m,
        tared=interpolate(at_m, rows.travel_m, rows.tared),
        force=interpolate(at_m, rows.travel_m, rows.force),
        location=interpolate(at_m, rows.travel_m, rows.location),
    )
    return MixedRows(
        rows=measured,
        simulated_force=interpolate(at_m, travel_m, force),
        displacement=interpolate(at_m, travel_m, displacement),
        contact_force=None if contact_force is None else interpolate(at_m, travel_m, contact_force),
        shares=interpolate(at_m, travel_m, shares),
    )


def interpolate(at: Floats, where: Floats, values: Values) -> Values:
    """Linear interpolation along the first axis, in the type of ``values``; shape (Q, ...).

    Args:
        at: Where to, within ``where``, shape (Q,).
        where: Increasing, shape (R,), two or more.
        values: Shape (R, ...).
    """
    after = np.clip(np.searchsorted(where, at), 1, len(where) - 1)
    low, high = where[after - 1], where[after]
    share = ((at - low) / (high - low)).reshape(-1, *[1] * (values.ndim - 1))
    first, second = values[after - 1], values[after]
    return np.asarray(first + share * (second - first), values.dtype)


def _aligned(
    name: str, simulated: SimulatedTrial
) -> tuple[Floats, Floats, FloatArray, FloatArray | None, Floats]:
    """Travel since 0.5 N, force, fields and shares of the steps before the divergence."""
    believed = slice(0, simulated.converged)
    force = simulated.force[believed]
    if not (np.isfinite(force).all() and np.isfinite(simulated.displacement[believed]).all()):
        raise DatasetError(
            f"{name}: a step counted as converged is not finite",
            remedy="let converged count the steps before the divergence",
        )
    start = from_threshold(force)
    if start is None:
        largest = float(np.linalg.norm(force, axis=1).max(initial=0.0))
        first = float(np.linalg.norm(force[0])) if len(force) else 0.0
        if first >= THRESHOLD_N:
            raise DatasetError(
                f"{name}: the simulation begins at {first:.3g} N, above {THRESHOLD_N} N",
                remedy="give the step at first touch too, where the force is zero",
            )
        raise DatasetError(
            f"{name}: the simulation reaches {largest:.3g} N in its {len(force)} converged steps",
            remedy="press deeper, or in smaller steps if it diverged; else drop the trial",
        )
    travel_m = start.rows(simulated.travel_m[believed])
    if (np.diff(travel_m) <= 0).any():
        raise DatasetError(
            f"{name}: travel of the simulation does not increase",
            remedy="give its steps in order of travel",
        )
    displacement = start.rows(simulated.displacement[believed])
    contact = simulated.contact_force
    contact_force = None if contact is None else start.rows(contact[believed])
    shares = start.rows(np.eye(len(force)))
    return travel_m - travel_m[0], start.rows(force), displacement, contact_force, shares


def assemble_experiment(
    trials: Iterable[TrialRows], provenance: Provenance, *, unit_names: tuple[str, ...] = ()
) -> ExperimentDataset:
    """The purely experimental data set, sorted by unit and trajectory.

    Args:
        trials: Processed trials, in any order.
        provenance: Where they come from.
        unit_names: Names and order of the units; those of the trials, sorted, if not given.

    Raises:
        DatasetError: A trial is there twice, has wrong shapes, values that are not finite or a unit
            that is not named; or one trajectory has two indenters. Names the trial.
    """
    return _experiment(list(trials), provenance, unit_names)[0]


def assemble_mixed(
    mixed: Iterable[MixedRows],
    basis: FieldBasis,
    mesh: SkinMesh,
    provenance: Provenance,
    *,
    contact_basis: FieldBasis | None = None,
    unit_names: tuple[str, ...] = (),
) -> MixedDataset:
    """The mixed data set; fields are compressed one by one, so ``mixed`` may be a stream.

    With ``contact_basis`` it says how the indenter bears on the skin; every trial must know that.

    Raises:
        DatasetError: As in ``assemble_experiment``, or a field is of another mesh.
    """
    encoder = TrialEncoder(mesh, basis, contact_basis)
    return assemble_encoded(
        (encoder(one) for one in mixed),
        basis,
        mesh,
        provenance,
        contact_basis=contact_basis,
        unit_names=unit_names,
    )


@dataclass(frozen=True, slots=True)
class EncodedTrial:
    """What the mixed data set holds of a trial, R rows: small, so it travels between processes.

    Attributes:
        rows: The experiment.
        simulated_force: [N], shape (R, 3).
        coefficients: Of the displacement [m], shape (R, K).
        contact: Centre of pressure [m], shape (R, 3), contact normal, shape (R, 3), and
            coefficients of the contact forces [N], shape (R, F); None where they are left out.
    """

    rows: TrialRows
    simulated_force: FloatArray
    coefficients: FloatArray
    contact: tuple[FloatArray, FloatArray, FloatArray] | None


@dataclass(frozen=True, slots=True)
class ExactCoefficients:
    """Coefficients of both fields of some rows or steps, not rounded.

    Attributes:
        displacement: Shape (R, K).
        contact_force: Shape (R, F); None where these are left out.
    """

    displacement: Floats
    contact_force: Floats | None

    def between(self, shares: Floats) -> ExactCoefficients:
        """Those of rows to which these contribute shares, shape (Q, R)."""
        contact = None if self.contact_force is None else shares @ self.contact_force
        return ExactCoefficients(shares @ self.displacement, contact)


class TrialEncoder:
    """Trials with fields to trials with coefficients; made once for many, as `FieldEncoder` is.

    Attributes:
        displacement: Encoder of the displacement.
        contact_force: Of the contact forces; None = these are left out.
    """

    def __init__(
        self, mesh: SkinMesh, basis: FieldBasis, contact_basis: FieldBasis | None = None
    ) -> None:
        self._mesh = mesh
        self.displacement = FieldEncoder(basis)
        self.contact_force = None if contact_basis is None else FieldEncoder(contact_basis)

    def steps(self, simulated: SimulatedTrial) -> ExactCoefficients:
        """Coefficients of a simulation's steps, of which those of its trials' rows are made.

        Raises:
            DatasetError: Its fields are of another mesh.
        """
        found, expected = simulated.displacement.shape[1:], self._mesh.nodes.shape
        if found != expected:
            raise DatasetError(
                f"{simulated.trajectory}: displacement has shape {found}, expected {expected}",
                remedy="simulate with the mesh that the data set names",
            )
        contact = simulated.contact_force
        return self._exact(
            simulated.displacement[: simulated.converged],
            None if contact is None else contact[: simulated.converged],
        )

    def __call__(self, mixed: MixedRows, steps: ExactCoefficients | None = None) -> EncodedTrial:
        """Check and encode a trial.

        Args:
            mixed: The trial.
            steps: Of its simulation, which saves most of the work: rows lie between steps, and so
                do their coefficients.

        Raises:
            DatasetError: A field is of another mesh or not finite, or a row is not in contact.
        """
        _check_fields(mixed, self._mesh, contact=self.contact_force is not None)
        if steps is None or mixed.shares is None:
            exact = self._exact(mixed.displacement, mixed.contact_force)
        else:
            exact = steps.between(mixed.shares)
        contact = None
        if self.contact_force is not None and exact.contact_force is not None:
            assert mixed.contact_force is not None
            contact = (
                *contact_of(self._mesh, mixed.displacement, mixed.contact_force),
                self.contact_force.stored(exact.contact_force),
            )
        return EncodedTrial(
            mixed.rows,
            mixed.simulated_force.astype(np.float32),
            self.displacement.stored(exact.displacement),
            contact,
        )

    def _exact(
        self, displacement: FloatArray, contact_force: FloatArray | None
    ) -> ExactCoefficients:
        contact = None
        if self.contact_force is not None and contact_force is not None:
            contact = self.contact_force.exact(contact_force)
        return ExactCoefficients(self.displacement.exact(displacement), contact)


def assemble_encoded(
    trials: Iterable[EncodedTrial],
    basis: FieldBasis,
    mesh: SkinMesh,
    provenance: Provenance,
    *,
    contact_basis: FieldBasis | None = None,
    unit_names: tuple[str, ...] = (),
) -> MixedDataset:
    """The mixed data set of encoded trials, in any order; ``TrialEncoder`` had the same bases.

    Raises:
        DatasetError: As in ``assemble_experiment``.
    """
    encoded = list(trials)
    experiment, order = _experiment([one.rows for one in encoded], provenance, unit_names)
    held = [encoded[i] for i in order]
    contact = None
    if contact_basis is not None:
        parts = [one.contact for one in held if one.contact is not None]
        centre, normal, forces = (np.concatenate([part[i] for part in parts]) for i in range(3))
        contact = SimulatedContact(centre, normal, forces, contact_basis)
    return MixedDataset(
        experiment=experiment,
        simulated_force=np.concatenate([one.simulated_force for one in held]),
        coefficients=np.concatenate([one.coefficients for one in held]),
        basis=basis,
        mesh=mesh,
        contact=contact,
    )


def contact_of(
    mesh: SkinMesh, displacement: FloatArray, contact_force: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Centre of pressure [m] and contact normal, each of shape (R, 3), of a trial's rows.

    Both are means over the touched nodes, weighted with the part of the nodal force along the
    deformed skin's normal: friction moves neither.

    Args:
        mesh: The skin.
        displacement: Of every node [m], shape (R, V, 3).
        contact_force: On the nodes of the outer surface [N], shape (R, O, 3); each row has some.
    """
    # Of the skin, only triangles at a node that is touched in some row have a part in it.
    touched = np.zeros(len(mesh.nodes), np.bool_)
    outer = mesh.outer_nodes
    touched[outer] = contact_force.any(axis=(0, 2))
    around, faces = np.unique(
        mesh.outer_faces[touched[mesh.outer_faces].any(axis=1)], return_inverse=True
    )
    points = mesh.nodes[around] + displacement[:, around]  # (R, A, 3)
    normal = _normals(points, faces.reshape(-1, 3))
    force = contact_force[:, np.searchsorted(outer, around)]
    pressed = np.maximum(0.0, -np.sum(force * normal, axis=2))[:, None]  # (R, 1, A)
    centre = (pressed @ points)[:, 0] / pressed.sum(axis=2)
    mean = (pressed @ normal)[:, 0]
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    return centre.astype(np.float32), mean.astype(np.float32)


def _normals(points: Floats, faces: npt.NDArray[np.int64]) -> Floats:
    """Outward unit normals, shape (R, A, 3), of the nodes of triangles (F, 3) in R states."""
    rows, count, _ = points.shape
    a, b, c = (points[:, faces[:, corner]] for corner in range(3))
    area = np.cross(b - a, c - a)  # twice the area, outward, (R, F, 3)
    node = (faces.T.ravel() + count * np.arange(rows)[:, None]).ravel()  # of each state and corner
    sums = [
        np.bincount(node, np.tile(area[..., axis], 3).ravel(), minlength=rows * count)
        for axis in range(3)
    ]
    normal = np.stack(sums, axis=1).reshape(points.shape)
    return np.asarray(normal / np.linalg.norm(normal, axis=2, keepdims=True))


def _check_fields(mixed: MixedRows, mesh: SkinMesh, *, contact: bool) -> None:
    """Check shapes and values of a trial's fields."""
    count, name = len(mixed.rows.travel_m), trial_name(mixed.rows.header)
    wanted: list[tuple[str, npt.NDArray[np.floating], tuple[int, ...]]] = [
        ("displacement", mixed.displacement, (count, *mesh.nodes.shape)),
        ("simulated force", mixed.simulated_force, (count, 3)),
    ]
    if contact:
        if mixed.contact_force is None:
            raise DatasetError(
                f"{name}: its simulation does not say how the indenter bears on the skin",
                remedy="simulate it again, or leave the contact out of all trials",
            )
        outer = (count, len(mesh.outer_nodes), 3)
        wanted.append(("contact force", mixed.contact_force, outer))
    for what, values, expected in wanted:
        if values.shape != expected:
            raise DatasetError(
                f"{name}: {what} has shape {values.shape}, expected {expected}",
                remedy="simulate with the mesh that the data set names",
            )
        _check_finite(mixed.rows, what, values)
    if contact and not np.any(wanted[-1][1], axis=(1, 2)).all():
        raise DatasetError(
            f"{name}: no node is touched in a row", remedy="leave out what is not in contact"
        )


def _experiment(
    trials: list[TrialRows], provenance: Provenance, unit_names: tuple[str, ...]
) -> tuple[ExperimentDataset, list[int]]:
    """The data set, and the order in which it holds the trials."""
    indenter = _checked(trials)
    units = unit_names or tuple(sorted({rows.header.unit for rows in trials}))
    for rows in trials:
        if rows.header.unit not in units:
            raise DatasetError(
                f"{trial_name(rows.header)}: its unit is not among {', '.join(units)}",
                remedy="name all units",
            )
    trajectories = tuple(sorted(indenter))
    place = {trajectory: i for i, trajectory in enumerate(trajectories)}
    keys = [(units.index(rows.header.unit), place[rows.header.trajectory]) for rows in trials]
    order = sorted(range(len(trials)), key=keys.__getitem__)
    held = [trials[i] for i in order]
    experiment = ExperimentDataset(
        unit_names=units,
        trajectories=trajectories,
        indenters=tuple(indenter[trajectory] for trajectory in trajectories),
        trial_unit=np.array([keys[i][0] for i in order], np.int32),
        trial_trajectory=np.array([keys[i][1] for i in order], np.int32),
        trial_rest=np.array([rows.rest for rows in held], np.float32),
        trial=np.repeat(
            np.arange(len(held), dtype=np.int32), [len(rows.travel_m) for rows in held]
        ),
        travel_m=np.concatenate([rows.travel_m for rows in held]).astype(np.float32),
        tared=np.concatenate([rows.tared for rows in held]).astype(np.float32),
        force=np.concatenate([rows.force for rows in held]).astype(np.float32),
        location=np.concatenate([rows.location for rows in held]).astype(np.float32),
        provenance=provenance,
    )
    return experiment, order


def _checked(trials: list[TrialRows]) -> dict[str, str]:
    """Check every trial; the indenter of each unique trajectory."""
    if not trials:
        raise DatasetError("no trials", remedy="process or ingest at least one")
    seen: set[tuple[str, str]] = set()
    indenter: dict[str, str] = {}
    for rows in trials:
        name = trial_name(rows.header)
        key = (rows.header.unit, rows.header.trajectory)
        if key in seen:
            raise DatasetError(
                f"{name} is there twice",
                remedy="a unit executes a trajectory once; remove one of the trials",
            )
        seen.add(key)
        known = indenter.setdefault(rows.header.trajectory, rows.header.indenter)
        if known != rows.header.indenter:
            raise DatasetError(
                f"{name}: indenter {rows.header.indenter}, on another unit {known}",
                remedy="give each trajectory one indenter; its id begins with it",
            )
        _check_trial(rows)
    return indenter


def _check_trial(rows: TrialRows) -> None:
    count = len(rows.travel_m)
    for what, values, shape in (
        ("rest", rows.rest, (ELECTRODES,)),
        ("travel_m", rows.travel_m, (count,)),
        ("tared", rows.tared, (count, ELECTRODES)),
        ("force", rows.force, (count, 3)),
        ("location", rows.location, (count, 3)),
    ):
        if values.shape != shape or count == 0:
            raise DatasetError(
                f"{trial_name(rows.header)}: {what} has shape {values.shape}, expected {shape}"
                " with at least one row",
                remedy="give one row of every quantity for each displacement",
            )
        if what != "rest":  # NaN there means that the source does not hold it
            _check_finite(rows, what, values)


def _check_finite(rows: TrialRows, what: str, values: npt.NDArray[np.floating]) -> None:
    bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
    if bad.size:
        raise DatasetError(
            f"{trial_name(rows.header)}: {what} is not finite in row {bad[0]}",
            remedy="drop the row or the trial",
        )
