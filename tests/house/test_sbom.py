"""`make sbom` names everything that palpate declares and this environment has."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

pytest.importorskip("cyclonedx_py")

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _declared() -> set[str]:
    """Names of all direct dependencies in ``pyproject.toml``."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"]]
    for extra in project["optional-dependencies"].values():
        lines += extra
    names = {_plain(re.split(r"[\s\[<>=!~;]", line)[0]) for line in lines}
    return names - {"palpate"}


def _is_installed(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def test_the_sbom_names_every_declared_dependency(tmp_path: Path) -> None:
    makefile = (ROOT / "Makefile").read_text()
    recipe = re.search(r"^sbom:.*\n((?:\t.*\n)+)", makefile.replace("\\\n", " "), re.MULTILINE)
    assert recipe
    line = next(one for one in recipe[1].splitlines() if "cyclonedx-py" in one)
    words = line.replace("$(BIN)/cyclonedx-py", "").replace("$(BIN)/python", sys.executable)
    out = tmp_path / "palpate.cdx.json"
    subprocess.run(
        [
            sys.executable,
            "-m",
            "cyclonedx_py",
            *words.replace("dist/palpate.cdx.json", str(out)).split(),
        ],
        cwd=ROOT,
        check=True,
        capture_output=True,
        timeout=300,
    )
    bill = json.loads(out.read_text())
    versions = {_plain(one["name"]): one["version"] for one in bill["components"]}
    wanted = {name for name in _declared() if _is_installed(name)}
    assert len(wanted) >= 25
    assert not wanted - set(versions)
    for name in wanted:
        assert versions[name] == metadata.version(name)
    assert bill["metadata"]["component"]["name"] == "palpate"


def test_an_audit_that_could_not_look_something_up_fails() -> None:
    lines = [line for line in (ROOT / "Makefile").read_text().splitlines() if "pip-audit" in line]
    assert any("--strict" in line for line in lines)
