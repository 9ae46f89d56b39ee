"""Container files come from the same plan as the units; those in the repository are fresh."""

from __future__ import annotations

import configparser
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.install.debian import EXTRAS, stages
from tests.install.scores import plan_of_case
from tests.install.service_manager import UnitFile

from palpate.errors import ConfigError
from palpate_deploy.install.containers import USER, container_files, write_containers
from palpate_deploy.install.plan import InstallOrder
from palpate_deploy.station.processes import _NEEDED
from palpate_deploy.station.profile import parse_profile

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "deploy" / "containers"
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]


def test_files_of_the_repository_are_fresh(tmp_path: Path) -> None:
    """Otherwise: palpate install virtual --containers deploy/containers."""
    write_containers(InstallOrder("virtual"), tmp_path)
    written = {file.name: file.read_text("utf-8") for file in tmp_path.iterdir()}
    kept = {f.name: f.read_text("utf-8") for f in FOLDER.iterdir() if f.name != "Dockerfile"}
    assert kept == written
    assert f"palpate:{VERSION}" in written["compose.yaml"]


def test_files_of_somebody_else_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "compose.yaml").write_text("services: {}\n")
    with pytest.raises(ConfigError, match="another one"):
        write_containers(InstallOrder("virtual"), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["compose.yaml"]


def _services(case: str) -> dict[str, Any]:
    files = container_files(plan_of_case(case), "", VERSION)
    services: dict[str, Any] = yaml.safe_load(files["compose.yaml"])["services"]
    return services


def _units(case: str, tmp_path: Path) -> dict[str, UnitFile]:
    found = {}
    for path, text in plan_of_case(case).files().items():
        if path.endswith(".service"):
            file = tmp_path / Path(path).name
            file.write_text(text, encoding="utf-8")
            found[file.name.partition("@")[0] + "-lab"] = UnitFile.read(file)
    return found


def test_compose_runs_what_the_units_run(case: str, tmp_path: Path) -> None:
    services, units = _services(case), _units(case, tmp_path)
    assert services.keys() == units.keys()
    for name, service in services.items():
        unit = units[name]
        assert service["command"] == unit.command[1:]
        assert service["mem_limit"] == unit.one("MemoryMax").lower()
        assert service["stop_grace_period"] == unit.one("TimeoutStopSec") + "s"
        assert service["pids_limit"] == int(unit.one("TasksMax"))
        if "PALPATE_PROCESSES" in unit.environment:
            mine = service["environment"]["PALPATE_PROCESSES"]
            assert mine == unit.environment["PALPATE_PROCESSES"]
        assert ("devices" in service) == bool(unit.settings.get("DeviceAllow"))


def test_compose_is_closed(case: str) -> None:
    for service in _services(case).values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["user"] == f"{USER}:{USER}"
        assert "privileged" not in service


def test_an_unplugged_finger_ends_no_station(case: str) -> None:
    for service in _services(case).values():
        assert service["healthcheck"]["test"][1:4] == ["palpate", "status", "--alive"]


def test_quadlets_say_the_same_as_compose(case: str) -> None:
    files = container_files(plan_of_case(case), "", VERSION)
    for name, service in _services(case).items():
        text = files[f"{name}.container"]
        # Keys may come several times: the last one is enough here.
        parser = configparser.RawConfigParser(strict=False, delimiters=("=",))
        parser.optionxform = str  # type: ignore[assignment]
        parser.read_string(text)
        container = parser["Container"]
        assert shlex.split(container["Exec"]) == service["command"]
        assert shlex.split(container["HealthCmd"]) == service["healthcheck"]["test"][1:]
        assert container["Image"] == f"localhost/{service['image']}"
        assert f"{container['User']}:{container['Group']}" == service["user"]
        assert container["ReadOnly"] == container["NoNewPrivileges"] == "true"
        assert container["DropCapability"] == "all"
        assert container["PidsLimit"] == str(service["pids_limit"])
        assert container["PodmanArgs"] == f"--memory={service['mem_limit']}"
        assert f"{container['StopTimeout']}s" == service["stop_grace_period"]
        for key, value in service["environment"].items():
            assert f"Environment={shlex.quote(f'{key}={value}')}\n" in text
        for device in service.get("devices", []):
            assert f"AddDevice=-{device.partition(':')[0]}\n" in text


def test_certificates_are_not_put_into_files() -> None:
    plan = plan_of_case("virtual")
    profile = parse_profile(
        {"link": {"certificates": "/pki"}, "router": {"listen": ["tls/127.0.0.1:7447"]}},
        where="test",
    )
    with pytest.raises(ConfigError, match="certificates in containers"):
        container_files(type(plan)("lab", profile, plan.needs, plan.program), "", VERSION)


def test_image_has_what_every_process_needs() -> None:
    build, final = stages((FOLDER / "Dockerfile").read_text("utf-8"))
    (pip,) = [words for word, words in build if word == "RUN" and "pip install" in words]
    extras = pip.partition("[")[2].partition("]")[0].split(",")
    assert ",".join(extras) == EXTRAS
    assert {extra for extra, _ in _NEEDED.values()} | {"gateway"} <= set(extras)
    users = [words for word, words in final if word == "USER"]
    assert users == [f"{USER}:{USER}"]
    assert final[-1][0] == "CMD"
    text = (FOLDER / "Dockerfile").read_text("utf-8")
    assert f"palpate:{VERSION}" in text
