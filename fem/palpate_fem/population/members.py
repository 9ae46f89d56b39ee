"""Members of a population: three specimens like the paper's, fitted to what it publishes of them.

The file (schema ``palpate.population/1``) calls a specimen ``unit`` and a published range
``wanted``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

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
        published: What it was fitted to.
        overtravel_m: How much deeper it was pressed than planned [m]: the share of the robot's
            registration error that points into the skin.
        found: Result of the fit: ``low``, ``high``, ``max_force_n``, ``states``.
    """

    specimen: SpecimenParameters
    published: PublishedRange
    overtravel_m: float
    found: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """As stored, with the stored names."""
        return {
            "unit": asdict(self.specimen),
            "wanted": asdict(self.published),
            "overtravel_m": self.overtravel_m,
            "found": dict(self.found),
        }


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
    try:
        members = tuple(_member(entry) for entry in content["members"])
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{where}: a member lacks or misplaces {error}", remedy=_REMEDY
        ) from error
    names = [member.specimen.name for member in members]
    if not names or len(set(names)) != len(names):
        raise ConfigError(
            f"{where}: members are called {', '.join(names) or 'nothing'}",
            remedy="give at least one member, and each a different name",
        )
    return members


def _member(entry: dict[str, Any]) -> Member:
    published = PublishedRange(
        **{**entry["wanted"], "indenters": tuple(entry["wanted"]["indenters"])}
    )
    overtravel = float(entry["overtravel_m"])
    if not math.isfinite(overtravel):
        raise ValueError(f"overtravel_m = {overtravel}")
    specimen = SpecimenParameters.from_json(json.dumps(entry["unit"]))
    return Member(specimen, published, overtravel, dict(entry["found"]))
