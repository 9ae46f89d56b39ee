"""What an experiment on the twin is made of; saved beside its data, compared when it goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from palpate.errors import ConfigError
from palpate_fem.config import FingertipParameters
from palpate_fem.population.member import Member

FILE = "experiment.json"
SCHEMA = "palpate.twin-experiment/1"

FLUID_VOLUME_M3 = 6.0e-7
"""Fill of the twin [m^3]: docs/adr/0016 says why not what 15.1 mm of thickness would need."""

EDGE_M = 0.6e-3
"""Edge of the mesh on the pad [m]; the mesh study puts its force error below 1 %."""

OVERTRAVEL_M = 0.6e-3
"""How much deeper than the paper's depths paths go [m]: robots stand wrong by up to that."""

INCREMENT_M = 1e-4
"""Step of a path [m]; paper, "Experimental testing procedure"."""

SOLVER: dict[str, bool | int | float | str] = {"smallest_increment": 0.125}
"""A pinched skin that needs finer increments than an eighth seldom converges at all."""


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
    """

    points: int = 10
    angled: int = 4
    seed: int = 0
    edge_m: float = EDGE_M
    fluid_volume_m3: float = FLUID_VOLUME_M3
    overtravel_m: float = OVERTRAVEL_M
    indenters: tuple[str, ...] = ()

    @property
    def parameters(self) -> FingertipParameters:
        """Of the fingertip."""
        return FingertipParameters(fluid_volume_m3=self.fluid_volume_m3)

    @property
    def mesh_options(self) -> dict[str, object]:
        """For the factory of fingertips."""
        return {"layers": 2, "edge_m": self.edge_m, "solver": dict(SOLVER)}


def provenance_sha256(spec: ExperimentSpec, members: Sequence[Member], fingertip: str) -> str:
    """Digest, hex, of all that decides the rows: spec, units and the fingertip's own digest."""
    content = {
        "spec": asdict(spec),
        "members": [asdict(member) for member in members],
        "fingertip": fingertip,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def keep_spec(folder: Path, spec: ExperimentSpec, members: Sequence[Member]) -> None:
    """Write the spec into the experiment's folder, or see that it is the one that is there.

    Raises:
        ConfigError: The folder holds another experiment; says what differs.
    """
    wanted: dict[str, Any] = {
        "schema": SCHEMA,
        "spec": asdict(spec),
        "members": [asdict(member) for member in members],
    }
    wanted = json.loads(json.dumps(wanted))  # tuples become lists, as in the file
    path = folder / FILE
    try:
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            partial = path.with_name(f".{FILE}.part")
            partial.write_text(json.dumps(wanted, indent=1) + "\n", encoding="utf-8")
            partial.replace(path)
            return
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: {error}", remedy="name another folder, or remove the damaged file"
        ) from error
    differs = [key for key in wanted if found.get(key) != wanted[key]]
    if "spec" in differs:
        theirs, mine = found.get("spec") or {}, wanted["spec"]
        differs = [
            f"{key} {mine.get(key)} is not {theirs.get(key)}"
            for key in sorted(mine.keys() | theirs.keys())
            if mine.get(key) != theirs.get(key)
        ]
    if differs:
        raise ConfigError(
            f"{folder} holds another experiment: {'; '.join(differs)}",
            remedy="go on with the options it was begun with, or name another folder",
        )
