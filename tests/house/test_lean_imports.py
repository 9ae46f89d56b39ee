"""Heavy packages are imported only by those who need them: a robot's client stays light."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import pytest

HEAVY = ("torch", "onnxruntime", "onnx", "rerun", "matplotlib", "h5py", "scipy", "warp", "pyarrow")
LIST_PROTOS = (
    "import pkgutil, importlib, palpate as protos\n"
    "for module in pkgutil.walk_packages(protos.__path__, 'palpate.'):\n"
    "    importlib.import_module(module.name)"
)


def _heavy_after(program: str) -> set[str]:
    """Which heavy packages a fresh interpreter has loaded after running ``program``."""
    result = subprocess.run(
        [sys.executable, "-c", f"{program}\nimport sys, json\nprint(json.dumps([*sys.modules]))"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    loaded = {name.partition(".")[0] for name in json.loads(result.stdout.splitlines()[-1])}
    return loaded & set(HEAVY)


def test_protos_load_nothing_heavy() -> None:
    assert not _heavy_after(LIST_PROTOS)


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
    try:
        spec = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        spec = None
    if spec is None:
        pytest.skip(f"{module} does not exist")
    assert _heavy_after(f"import {module}") <= set(may_load)
