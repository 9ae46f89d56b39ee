"""Heavy packages are imported only by those who need them: a robot's client stays light."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from importlib.metadata import distribution, packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("torch", "onnxruntime", "onnx", "rerun", "matplotlib", "h5py", "scipy", "warp", "pyarrow")
LIST_PROTOS = (
    "import pkgutil, importlib, palpate as protos\n"
    "for module in pkgutil.walk_packages(protos.__path__, 'palpate.'):\n"
    "    importlib.import_module(module.name)"
)
BASE_ONLY = """
import sys
class Refuses:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {lacking!r}:
            raise ModuleNotFoundError(f"the base install lacks {{name}}", name=name)
sys.meta_path.insert(0, Refuses())
"""


def _after(program: str) -> set[str]:
    """Which packages a fresh interpreter has loaded after running ``program``."""
    result = subprocess.run(
        [sys.executable, "-c", f"{program}\nimport sys, json\nprint(json.dumps([*sys.modules]))"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return {name.partition(".")[0] for name in json.loads(result.stdout.splitlines()[-1])}


def _beyond_base() -> set[str]:
    """Packages that are not there where palpate was installed without extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = {project["name"]}
    asked = [Requirement(text) for text in project["dependencies"]]
    while asked:
        one = asked.pop()
        name = canonicalize_name(one.name)
        if name in found or (one.marker and not one.marker.evaluate({"extra": ""})):
            continue
        found.add(name)
        asked += map(Requirement, distribution(name).requires or ())
    return {
        package
        for package, owners in packages_distributions().items()
        if not found & {canonicalize_name(owner) for owner in owners}
    }


def test_protos_load_nothing_heavy() -> None:
    assert not _after(LIST_PROTOS) & set(HEAVY)


@pytest.mark.parametrize("program", [LIST_PROTOS, "import palpate_deploy.cli.app"])
def test_the_base_install_has_all_that_is_imported(program: str) -> None:
    lacking = _beyond_base()
    assert {"pytest", "hypothesis"} <= lacking
    _after(BASE_ONLY.format(lacking=lacking) + program)


@pytest.mark.parametrize(
    ("module", "may_load"),
    [
        ("palpate.client", ()),
        ("palpate_deploy.cli.app", ()),
        ("palpate_gateway.service.node", ()),
        ("palpate_services.inference.services", ("onnxruntime",)),
        ("palpate_services.recorder.service", ("rerun", "pyarrow")),
    ],
)
def test_module_loads_only_what_it_needs(module: str, may_load: tuple[str, ...]) -> None:
    assert _after(f"import {module}") & set(HEAVY) <= set(may_load)
