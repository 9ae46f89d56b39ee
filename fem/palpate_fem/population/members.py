"""Members of a population: specimens fitted to what the paper publishes of its three, or drawn.

The file (schema ``palpate.population/1``) calls a specimen ``unit`` and a published range
``wanted``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import ConfigError
from palpate.files.atomic import written_whole
from palpate_fem.electrodes.specimen import SpecimenParameters

SCHEMA = "palpate.population/1"
SHIPPED = "three.json"
_REMEDY = "make it with: palpate fem units fit STORE --out FILE"


@dataclass(frozen=True, slots=True)
class PublishedRange:
    """What the paper publishes of one of its BioTacs ("Experimental data processing", figures).

    Attributes:
        name: Of the specimen.
        low: Smallest tared value over full scale.
        high: Largest.
        max_force_n: Largest net force [N].
        indenters: Prefixes of the names of its indenters; empty = all.
    """

    name: str
    low: float
    high: float
    max_force_n: float
    indenters: tuple[str, ...] = ()

    def pressed_with(self, indenter: str) -> bool:
        """Whether this specimen was pressed with an indenter."""
        return not self.indenters or indenter.startswith(self.indenters)


PAPER = (
    PublishedRange("biotac-1", -0.65, 0.13, 23.4, ("sphere_",)),
    PublishedRange("biotac-2", -0.78, 0.11, 32.1),
    PublishedRange("biotac-3", -0.51, 0.17, 29.0),
)


@dataclass(frozen=True, slots=True)
class Member:
    """One BioTac of the experiment.

    Attributes:
        specimen: Its electrical parameters.
        published: What it was fitted to; None = it was drawn, or fitted to a real sensor.
        overtravel_m: How much deeper it was pressed than planned [m]: the share of the robot's
            registration error that points into the skin.
        found: Result of the fit: ``low``, ``high``, ``max_force_n``, ``states``; to a real sensor:
            ``touches``, ``rest_error_counts``, ``spread_counts``, ``warmth``.
    """

    specimen: SpecimenParameters
    published: PublishedRange | None
    overtravel_m: float
    found: dict[str, float] = field(default_factory=dict)

    def pressed_with(self, indenter: str) -> bool:
        """Whether this specimen was pressed with an indenter; a drawn one is with all."""
        return self.published is None or self.published.pressed_with(indenter)

    def to_dict(self) -> dict[str, Any]:
        """As stored, with the stored names."""
        return {
            "unit": asdict(self.specimen),
            "wanted": None if self.published is None else asdict(self.published),
            "overtravel_m": self.overtravel_m,
            "found": dict(self.found),
        }


# Wider than the priors of the learning notes (`SpecimenParameters.drawn`), because real sensors lie
# outside of what those give (docs/results/twin/units.md); pairs are the ends of uniform ones.
SIGMA_S_M, SIGMA_LOG_SD = 0.3, 0.7
SERIES_OHM = (0.0, 1000.0)
CLAMP_CLOSING = (0.0, 1.0)
SIDE_CLOSING_M = (0.0, 0.5e-3)
CORE_FORWARD_M = (-0.8e-3, 1.2e-3)
CORE_SIDEWAYS_SD_M = 0.08e-3
CORE_UP_M = (-1.0e-3, 0.3e-3)
NOISE_COUNTS = (0.25, 8.0)  # uniform in its logarithm
HEATING_K = (5.0, 25.0)  # cores at 35 and at 46 to 49 degrees C in rooms of 25 (section 4.5)
HEATING_TAU_S = (150.0, 1200.0)  # uniform in its logarithm


def draw_members(count: int, seed: int) -> tuple[Member, ...]:
    """Specimens drawn from priors that bracket real sensors; core and discs are nominal.

    The first ones of a larger draw are those of a smaller one.

    Args:
        count: How many; they are called ``unit-001`` and so on.
        seed: The same seed gives the same specimens.

    Raises:
        ConfigError: Fewer than one.
    """
    if count < 1:
        raise ConfigError(f"{count} specimens", remedy="draw at least one")
    return tuple(_drawn(seed, number) for number in range(1, count + 1))


def _drawn(seed: int, number: int) -> Member:
    rng = np.random.default_rng([seed, number])
    nominal = SpecimenParameters()
    offset = (
        rng.uniform(*CORE_FORWARD_M),
        CORE_SIDEWAYS_SD_M * rng.standard_normal(),
        rng.uniform(*CORE_UP_M),
    )
    specimen = replace(
        nominal.drawn(rng),
        name=f"unit-{number:03d}",
        disc_diameter_m=nominal.disc_diameter_m,
        sigma_s_m=SIGMA_S_M * math.exp(SIGMA_LOG_SD * rng.standard_normal()),
        series_ohm=rng.uniform(*SERIES_OHM),
        clamp_closing=rng.uniform(*CLAMP_CLOSING),
        side_closing_m=rng.uniform(*SIDE_CLOSING_M),
        core_offset_m=tuple(float(one) for one in offset),
        noise_counts=math.exp(rng.uniform(*np.log(NOISE_COUNTS))),
        heating_k=rng.uniform(*HEATING_K),
        heating_tau_s=math.exp(rng.uniform(*np.log(HEATING_TAU_S))),
    )
    return Member(specimen, None, 1e-4 * int(rng.integers(0, 7)))


def write_population(path: Path, members: Sequence[Member], *, source: str) -> None:
    """Write members as JSON; ``source`` describes the data that they were fitted on."""
    content = {
        "schema": SCHEMA,
        "source": source,
        "members": [member.to_dict() for member in members],
    }
    with written_whole(path) as partial:
        partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_population(path: Path | None = None) -> tuple[Member, ...]:
    """Read members.

    Args:
        path: File of `write_population`; None = the three that come with palpate.

    Raises:
        ConfigError: The file does not exist or is not a population; names the file.
    """
    where = "the shipped population" if path is None else str(path)
    try:
        text = (
            resources.files(__package__).joinpath(SHIPPED).read_text(encoding="utf-8")
            if path is None
            else path.read_text(encoding="utf-8")
        )
        content: Any = json.loads(text)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{where} cannot be read: {error}", remedy=_REMEDY) from error
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise ConfigError(f"{where} does not have the schema {SCHEMA}", remedy=_REMEDY)
    entries = content.get("members")
    if not isinstance(entries, list):
        raise ConfigError(f"{where}: members is not a list", remedy=_REMEDY)
    members = tuple(_member(entry, f"{where}: member {k}") for k, entry in enumerate(entries, 1))
    names = [member.specimen.name for member in members]
    if not names or len(set(names)) != len(names):
        raise ConfigError(
            f"{where}: members are called {', '.join(names) or 'nothing'}",
            remedy="give at least one member, and each a different name",
        )
    return members


def _member(entry: Any, where: str) -> Member:
    try:
        return Member(
            SpecimenParameters.from_json(json.dumps(entry["unit"])),
            None if entry["wanted"] is None else _published(_object("wanted", entry["wanted"])),
            _number("overtravel_m", entry["overtravel_m"]),
            {
                key: _number(f"found.{key}", one)
                for key, one in _object("found", entry["found"]).items()
            },
        )
    except ConfigError as error:
        raise ConfigError(f"{where}: {error.problem}", remedy=error.remedy) from error
    except KeyError as error:
        raise ConfigError(f"{where} lacks {error}", remedy=_REMEDY) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{where}: {error}", remedy=_REMEDY) from error


def _object(label: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{label} = {value!r} is not a JSON object", remedy=_REMEDY)
    return value


def _published(wanted: dict[str, Any]) -> PublishedRange:
    indenters = wanted["indenters"]
    if not (isinstance(indenters, list) and all(isinstance(one, str) for one in indenters)):
        raise ConfigError(
            f"wanted.indenters = {indenters!r} is not a list of names",
            remedy='give a list, such as ["sphere_"]; an empty one means all',
        )
    numbers = {key: _number(f"wanted.{key}", wanted[key]) for key in ("low", "high", "max_force_n")}
    return PublishedRange(**{**wanted, **numbers, "indenters": tuple(indenters)})


def _number(label: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{label} = {value!r} is not a finite number", remedy=_REMEDY)
    return float(value)
