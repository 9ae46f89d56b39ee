"""How open a unit is, by ``systemd-analyze security``: 0 = closed, 10 = open."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from tests.install.cases import PROFILES

from palpate_deploy.install.needs import needs_of
from palpate_deploy.install.units import ServicePlan
from palpate_deploy.station.profile import parse_profile, read_toml

SCORE_MAX = 1.5
"""What a unit of ours may score; a bare one scores 9.6."""

PROGRAM = "/opt/palpate/bin/palpate"


def analyse() -> str | None:
    """The program; None if it is not installed."""
    return shutil.which("systemd-analyze")


def score(unit: Path) -> float:
    """The score of a unit file, without a running systemd."""
    result = subprocess.run(
        [str(analyse()), "security", "--offline=true", str(unit)],
        capture_output=True,
        text=True,
        check=False,
    )
    found = re.search(r": ([0-9]+\.[0-9]+) ", result.stdout)
    if found is None:
        raise ValueError(f"no score of {unit}: {result.stdout}{result.stderr}")
    return float(found[1])


def plan_of_case(case: str) -> ServicePlan:
    """The plan of a profile of ``PROFILES``."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lab.toml"
        path.write_text(PROFILES[case], encoding="utf-8")
        profile = parse_profile(read_toml(path), where=case)
    return ServicePlan("lab", profile, needs_of(profile), PROGRAM)


def scores() -> dict[str, dict[str, float]]:
    """Scores of every unit, by the profile and by the unit's kind."""
    found: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for case in PROFILES:
            for path, text in plan_of_case(case).files().items():
                if path.endswith(".service"):
                    unit = Path(folder) / Path(path).name
                    unit.write_text(text, encoding="utf-8")
                    found.setdefault(case, {})[unit.name.partition("@")[0]] = score(unit)
        bare = Path(folder) / "bare.service"
        bare.write_text(f"[Service]\nExecStart={PROGRAM} up\n", encoding="utf-8")
        found["bare"] = {"palpate": score(bare)}
    return found
