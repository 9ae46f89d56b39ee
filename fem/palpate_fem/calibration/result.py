"""Result of a calibration, and its file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import ConfigError
from palpate.files.atomic import written_whole
from palpate_fem.calibration.alignment import AlignedCurves, axis_rms_n
from palpate_fem.calibration.local import ParameterEstimate
from palpate_fem.config import FingertipParameters

SCHEMA = "palpate.calibration"
SCHEMA_VERSION = 1


@dataclass(frozen=True, slots=True)
class Evaluation:
    """One evaluation of the cost that took runs.

    Attributes:
        stage: ``scan``, ``start`` or ``step``.
        parameters: Parameters there, with the best modulus.
        cost: Total cost [N]; infinite if a trajectory could not be compared.
        axis_rms_n: RMS force error of each axis [N].
        thickness_m: Total thickness [m].
        fluid_volume_m3: Fluid [m^3].
        simulations: Number of runs so far.
        failures: Reason by trajectory, for those that could not be compared.
    """

    stage: str
    parameters: FingertipParameters
    cost: float
    axis_rms_n: tuple[float, ...]
    thickness_m: float
    fluid_volume_m3: float
    simulations: int
    failures: dict[str, str]


@dataclass(frozen=True, slots=True)
class TrajectoryFit:
    """Fit of one trajectory at the optimum; ``pair`` has the curves.

    ``rms_n`` was minimised; ``paper_rms_n`` uses the paper's alignment at 0.5 N.
    """

    name: str
    indenter: str
    sensor: str
    rms_n: float
    paper_rms_n: float
    depth_offset_m: float
    coverage: float
    pair: AlignedCurves


@dataclass(frozen=True, slots=True)
class Calibration:
    """Calibrated parameters, their uncertainty, and the quality of the fit.

    Attributes:
        parameters: For the solver; its fluid volume is None unless the volume was free.
        estimates: Each free parameter with uncertainty, sensitivity and bounds.
        fluid_volume_m3: Fluid between skin and core [m^3].
        fluid_volume_sd_m3: One standard deviation [m^3].
        thickness_m: Total thickness that was reached [m].
        cost: Total cost [N].
        axis_rms_n: RMS force error of each axis [N], as minimised.
        paper_axis_rms_n: The same with the paper's alignment at 0.5 N.
        trajectories: Each compared trajectory.
        history: Every evaluation that took runs, in order.
        simulations: Number of runs.
        converged: Whether the last step was small enough.
        excluded: Trajectories that were not compared, with the reason.
        notes: Remarks, such as runs that ended early.
        self_test: Whether the "measurements" are simulations themselves.
    """

    parameters: FingertipParameters
    estimates: tuple[ParameterEstimate, ...]
    fluid_volume_m3: float
    fluid_volume_sd_m3: float
    thickness_m: float
    cost: float
    axis_rms_n: tuple[float, ...]
    paper_axis_rms_n: tuple[float, ...]
    trajectories: tuple[TrajectoryFit, ...]
    history: tuple[Evaluation, ...]
    simulations: int
    converged: bool
    excluded: dict[str, str]
    notes: tuple[str, ...]
    self_test: bool

    def value(self, name: str) -> float:
        """Value of a calibrated parameter [SI], the fluid volume included."""
        if name == "fluid_volume_m3":
            return self.fluid_volume_m3
        return float(getattr(self.parameters, name))

    def rows(self) -> list[tuple[str, ...]]:
        """Parameter, value, standard deviation, force per 1 %, bounds, remark; for a table."""
        rows: list[tuple[str, ...]] = []
        for item in self.estimates:
            remark = "at its bound" if item.at_bound else ""
            if math.isinf(item.sd):
                remark = "not determined by these trajectories"
            rows.append(
                (
                    item.name,
                    f"{item.value:.4g}",
                    f"{item.sd:.2g}",
                    f"{item.sensitivity_n:.3f} N",
                    f"{item.lower:g} .. {item.upper:g}",
                    remark,
                )
            )
        if not any(item.name == "fluid_volume_m3" for item in self.estimates):
            volume = f"{self.fluid_volume_m3:.4g}"
            follows = f"follows from {self.parameters.total_thickness_m * 1e3:g} mm thickness"
            rows.append(
                ("fluid_volume_m3", volume, f"{self.fluid_volume_sd_m3:.2g}", "", "", follows)
            )
        return rows


def axis_rms(pairs: Sequence[AlignedCurves]) -> tuple[float, ...]:
    """RMS force error of each axis [N]; NaN if nothing was compared."""
    return tuple(axis_rms_n(pairs).tolist()) if pairs else (math.nan,) * 3


def write_json(path: Path, content: object) -> None:
    """Write JSON with null for NaN and infinity; the file appears complete or not at all.

    Raises:
        DatasetError: The disk refused.
    """
    with written_whole(path) as partial:
        partial.write_text(
            json.dumps(without_nan(content), indent=1, allow_nan=False) + "\n", "utf-8"
        )


def without_nan(value: Any) -> Any:
    """A value for JSON: arrays as lists, None for NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [without_nan(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


def write_calibration(path: Path, result: Calibration) -> None:
    """Write a calibration as JSON, for ``read_parameters``.

    Raises:
        DatasetError: The disk refused.
    """
    write_json(path, {"schema": SCHEMA, "schema_version": SCHEMA_VERSION} | asdict(result))


def read_parameters(path: Path) -> FingertipParameters:
    """Parameters of a calibration file.

    Raises:
        ConfigError: The file does not exist, is not a calibration, or has values out of range.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
        if (content["schema"], content["schema_version"]) != (SCHEMA, SCHEMA_VERSION):
            raise KeyError("schema")
        return FingertipParameters(**content["parameters"])
    except ConfigError as error:  # of a value
        raise ConfigError(f"{path}: {error.problem}", remedy=error.remedy) from error
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path}: not a calibration of schema {SCHEMA} {SCHEMA_VERSION} ({error!r})",
            remedy="make it with `palpate fem calibrate`",
        ) from error
