"""The fingertip of a command line: mesh, parameters, and the processes that press it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from palpate.config import looking_at
from palpate.errors import ConfigError
from palpate_fem.config import FingertipParameters
from palpate_fem.mesh.solid import check_limits
from palpate_fem.service.batch import SimulationBatch, TrajectoryBatch
from palpate_fem.service.config import DEFAULT_FACTORY
from palpate_fem.service.device_batch import SLOTS, DeviceBatch, threads_and_packers
from palpate_fem.service.jobs import WorkerSetup
from palpate_fem.service.ray_batch import cluster_packers, ray_batch

PARAMETRIC = "biotac"


@dataclass(frozen=True, slots=True)
class FingertipModel:
    """The fingertip that the options of a command describe.

    Attributes:
        factory: ``module:function`` that makes fingertips.
        options: Its keyword arguments.
        parameters: Parameters of the fingertip.
    """

    factory: str
    options: Mapping[str, object]
    parameters: FingertipParameters

    def setup(self, *, keep: int = 1) -> WorkerSetup:
        """Setup of worker processes."""
        return WorkerSetup(self.factory, self.options, self.parameters, keep)

    def batch(
        self,
        workers: int,
        *,
        jobs: int | None,
        limit_s: float,
        indenters: tuple[str, ...],
        devices: Sequence[str] = (),
        slots: int | None = None,
        ray: str | None = None,
    ) -> tuple[Callable[[], AbstractContextManager[TrajectoryBatch]], int]:
        """What starts the processes that run trajectories, and how many make files of them.

        Args:
            workers: Requested number, as in `workers_for`; with devices or a cluster, of those that
                make files.
            jobs: Number of trajectories, if it is known.
            limit_s: Longest time for one [s].
            indenters: Names of all that trajectories may have.
            devices: Warp devices that solve many trajectories at once; none = the CPU.
            slots: Trajectories at once on each device; None = the usual number.
            ray: Address of a cluster on which they run; ``devices`` are then its.
        """
        setup = self.setup()
        if ray is not None:
            device = devices[0] if devices else None
            make = partial(ray_batch, ray, setup, device=device, slots=slots or SLOTS)
            return partial(make, limit_s=limit_s, indenters=indenters), cluster_packers(workers)
        if devices:
            threads, packers = threads_and_packers(devices, workers)
            batch = partial(DeviceBatch, setup, devices, slots=slots or SLOTS, indenters=indenters)
            return partial(batch, threads=threads, limit_s=limit_s), packers
        count, threads = workers_for(workers, jobs)
        return partial(SimulationBatch, setup, workers=count, threads=threads, limit_s=limit_s), 0


def model_of(
    *,
    mesh: str,
    edge_mm: float | None,
    layers: int,
    fit: Path | None = None,
    skin_thickness_mm: float | None = None,
    shear_modulus_kpa: float | None = None,
    strain_stiffening: float | None = None,
    friction: float | None = None,
    fill_ml: float | None = None,
) -> FingertipModel:
    """Check the options and convert their units.

    Raises:
        ConfigError: A value is out of range, or a file does not exist or is closed.
    """
    # Here, for a worker would report it as a failure of its own.
    check_limits(layers=layers, **({} if edge_mm is None else {"edge_m": edge_mm * 1e-3}))
    options: dict[str, object] = {"layers": layers}
    if mesh != PARAMETRIC:
        with looking_at(Path(mesh)):
            is_folder = Path(mesh).is_dir()
        if not is_folder:
            raise ConfigError(
                f"--mesh {mesh}: there is no such folder",
                remedy=f"give the folder that holds meshes/biotac, or {PARAMETRIC!r}",
            )
        if edge_mm is not None:
            raise ConfigError(
                "--edge-mm is for the parametric mesh", remedy="leave it out, or --mesh biotac"
            )
        options["mesh"] = str(Path(mesh).resolve())
    elif edge_mm is not None:
        options["edge_m"] = edge_mm * 1e-3
    base = FingertipParameters()
    if fit is not None:
        from palpate_fem.calibration.result import read_parameters

        base = read_parameters(fit)
    given = {
        "skin_thickness_m": None if skin_thickness_mm is None else skin_thickness_mm * 1e-3,
        "shear_modulus_pa": None if shear_modulus_kpa is None else shear_modulus_kpa * 1e3,
        "strain_stiffening": strain_stiffening,
        "friction_coefficient": friction,
        "fluid_volume_m3": None if fill_ml is None else fill_ml * 1e-6,
    }
    wanted = {name: value for name, value in given.items() if value is not None}
    return FingertipModel(DEFAULT_FACTORY, options, replace(base, **wanted))


def workers_for(wanted: int, jobs: int | None = None) -> tuple[int, int]:
    """Number of workers, and of threads for each, on this host.

    Args:
        wanted: Requested number; 0 = one for each core.
        jobs: Number of jobs, if it is known.
    """
    cores = os.cpu_count() or 1
    workers = wanted or cores
    if jobs is not None:
        workers = max(1, min(workers, jobs))
    return workers, max(1, cores // workers)
