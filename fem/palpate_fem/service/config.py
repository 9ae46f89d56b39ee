"""Configuration of the finite-element service: table ``[fem]`` of a profile."""

from __future__ import annotations

import os
from typing import Any

from pydantic import Field

from palpate.config import Name, StrictConfig
from palpate_fem.config import FingertipParameters

DEFAULT_FACTORY = "palpate_fem.service.biotac:biotac"

WORKERS_MOST = 64
"""Solver processes of a service."""


class FingertipTable(StrictConfig):
    """Default parameters of requests; None = the paper's, see ``FingertipParameters``."""

    skin_thickness_m: float | None = None
    shear_modulus_pa: float | None = None
    friction_coefficient: float | None = None
    total_thickness_m: float | None = None
    fluid_volume_m3: float | None = None
    bulk_ratio: float | None = None
    strain_stiffening: float | None = None

    def parameters(self) -> FingertipParameters:
        """As parameters of the solver.

        Raises:
            ConfigError: One is out of range.
        """
        return FingertipParameters(**self.model_dump(exclude_none=True))


class FemConfig(StrictConfig):
    """How simulations are served.

    Attributes:
        sensor: Name under which the service answers, where others have the name of a sensor.
        workers: Solver processes; each solves one trajectory at a time.
        threads: Threads of each process; 0 = share the cores of this host evenly.
        waiting: Most requests that wait for a worker; further ones are refused.
        max_steps: Most steps of a request.
        max_deadline_s: Longest time for a request, waiting included [s].
        grace_s: Time after its deadline at which a solver that still runs is killed [s].
        device: Device that solves many requests at once, e.g. ``cuda:0``, if their indenter is one
            of the nine and their parameters are those of ``fingertip``; ``auto`` = the first GPU if
            there is one; None = workers alone.
        slots: Requests at once on it; as many as ``waiting`` more may wait for it.
        keep: Number of pressurised fingertips that each worker keeps.
        fingertip: Default parameters of requests.
        factory: ``module:function`` that makes fingertips.
        options: Its keyword arguments.
    """

    sensor: Name = "twin"
    workers: int = Field(default=2, ge=1, le=WORKERS_MOST)
    threads: int = Field(default=0, ge=0, le=256)
    waiting: int = Field(default=8, ge=0, le=1000)
    max_steps: int = Field(default=200, ge=1, lt=10_000)
    max_deadline_s: float = Field(default=600.0, gt=0, le=86_400)
    grace_s: float = Field(default=5.0, ge=0.1, le=60)
    device: str | None = None
    slots: int = Field(default=16, ge=1, le=1024)
    keep: int = Field(default=2, ge=1, le=32)
    fingertip: FingertipTable = FingertipTable()
    factory: str = DEFAULT_FACTORY
    options: dict[str, Any] = Field(default_factory=dict)

    def threads_each(self) -> int:
        """Threads of each worker."""
        return self.threads or max(1, (os.cpu_count() or 1) // self.workers)
