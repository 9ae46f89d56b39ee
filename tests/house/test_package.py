"""What is installed is what is here: sdist, wheel, and a station that runs from the wheel alone."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "palpate", "palpate_gateway", "palpate_fem", "palpate_training", "palpate_services",
    "palpate_deploy",
}  # fmt: skip


def _build(source: Path, target: str, out: Path) -> Path:
    """Build with the tools of this environment, so that nothing is downloaded."""
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(out)],
        cwd=source,
        capture_output=True,
        check=True,
        timeout=120,
    )
    (built,) = out.glob("*.whl" if target == "wheel" else "*.tar.gz")
    return built


def test_make_build_builds_it_as_the_test_does() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    recipe = re.search(r"^build:.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    assert recipe
    assert recipe[1].splitlines()[-1] == "\t@$(BIN)/python -m hatchling build -d dist"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this tree."""
    pytest.importorskip("hatchling", reason="hatchling not installed (extra dev)")
    return _build(ROOT, "wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ``palpate`` command of an environment outside the checkout that holds the wheel.

    Its dependencies are those of this environment: a path file that names a folder of packages does
    not run the path files in it, so the editable install of the checkout stays invisible.
    """
    home = tmp_path_factory.mktemp("elsewhere") / "env"
    venv.create(home, with_pip=False)
    (packages,) = home.glob("lib/python*/site-packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    command = home / "bin" / "palpate"
    command.write_text(
        f"#!{home / 'bin' / 'python'}\nfrom palpate_deploy.cli import main\n\nmain()\n"
    )
    command.chmod(0o755)
    return command


def _run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    # What the user's own stations have served must not decide what the wheel serves.
    environment |= {"XDG_STATE_HOME": str(folder / "state"), "XDG_DATA_HOME": str(folder / "data")}
    return subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )


def _contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_wheel_holds_every_file_of_the_packages_and_nothing_else(
    wheel: Path, project_files: list[Path]
) -> None:
    there = {name for name in _contents(wheel) if ".dist-info/" not in name}
    expected = {
        "/".join(path.relative_to(ROOT).parts[1:])
        for path in project_files
        if len(path.relative_to(ROOT).parts) > 2 and path.relative_to(ROOT).parts[1] in PACKAGES
    }
    assert there == expected


def test_wheel_of_the_sdist_is_the_wheel_of_the_tree(wheel: Path, tmp_path: Path) -> None:
    with tarfile.open(_build(ROOT, "sdist", tmp_path / "sdist")) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    assert _contents(_build(source, "wheel", tmp_path / "wheel")) == _contents(wheel)


@pytest.mark.parametrize("target", ["wheel", "sdist"])
def test_the_same_tree_gives_the_same_bytes(
    target: str, project_files: list[Path], tmp_path: Path
) -> None:
    """In another folder, at another time, with other rights of the files."""
    built = []
    for number, name in enumerate(("one", "two")):
        source = tmp_path / name
        for path in project_files:
            copy = source / path.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
            os.utime(copy, (10**9 + number, 10**9 + number))
            copy.chmod(0o600 if number else 0o644)
        built.append(_build(source, target, tmp_path / f"{name}-out").read_bytes())
        shutil.rmtree(source)
    assert built[0] == built[1]


def test_one_version_is_told_everywhere() -> None:
    facts = tomllib.loads((ROOT / "pyproject.toml").read_text())
    version = facts["project"]["version"]
    assert facts["tool"]["towncrier"]["version"] == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def test_robot_needs_one_name(installed: Path, tmp_path: Path) -> None:
    program = "import palpate; from palpate import Client; print(palpate.__file__, Client.__name__)"
    result = _run([str(installed.parent / "python"), "-c", program], tmp_path)
    assert result.returncode == 0, result.stderr
    file, name = result.stdout.split()
    assert name == "Client"
    assert not Path(file).is_relative_to(ROOT), "the checkout was imported, not the wheel"


@pytest.mark.slow
def test_demo_runs_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    """Package data (profiles, bundles, the tape) and worker processes are found outside, too."""
    result = _run([str(installed), "demo", "--seconds", "3", "--out", "demo"], tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    assert {path.suffix for path in (tmp_path / "demo").rglob("*")} >= {".mcap", ".rrd", ".png"}
