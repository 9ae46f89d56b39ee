"""``palpate model``: import a bundle, serve it, and find it served after a crash."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from palpate.bus import Session
from palpate.config import LinkConfig
from palpate.errors import (
    ConfigError,
    ErrorCode,
    LinkError,
    PalpateError,
    RemoteError,
    StreamTimeout,
)
from palpate.files.bundle import read_bundle, write_bundle
from palpate.messages import ModelAction, ModelInventory, ServedModel
from palpate_deploy.diagnose import doctor
from palpate_deploy.station import models
from palpate_deploy.station.profile import load_profile, parse_profile
from palpate_services.inference import remembered
from palpate_services.inference.remembered import Remembered, RememberedFile
from palpate_services.inference.repository import resolve

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def imported(tmp_path: Path, bundle: str) -> Path:
    """A bundle as its maker has it: the one that ships, as version 7 of another name."""
    shipped = read_bundle(resolve(bundle))
    folder = tmp_path / "made" / "bundle"
    write_bundle(
        folder,
        model=shipped.model,
        golden=shipped.golden,
        manifest=dataclasses.replace(shipped.manifest, name="mine", version=7),
        known_inputs=shipped.known_inputs,
    )
    return folder


@pytest.fixture
def run(station: tuple[Path, LinkConfig]) -> Iterator[Callable[[str], subprocess.Popen[bytes]]]:
    """Start a process of the station, as its supervisor does."""
    started = []

    def start(service: str) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-m", "palpate_deploy", "run", service, "--profile"]
        started.append(subprocess.Popen([*words, str(station[0])]))
        return started[-1]

    yield start
    for process in reversed(started):
        process.kill()
        process.wait()


def ready(link: LinkConfig, *, timeout_s: float = 60.0) -> None:
    """Wait until the features service of the station is ready."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        try:
            with Session.open(link.model_copy(update={"wait_for_router_s": 5.0})) as session:
                while time.monotonic() < deadline:
                    if any(one.ready for one in session.alive(station="*")):
                        return
                    time.sleep(0.05)
        except LinkError:
            time.sleep(0.1)
    raise AssertionError("features is not ready")


def test_import_load_and_roll_back(
    palpate: Palpate,
    run: Callable[[str], subprocess.Popen[bytes]],
    station: tuple[Path, LinkConfig],
    imported: Path,
    bundle: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    profile, link = station
    shipped = read_bundle(resolve(bundle)).manifest.version
    run("router")
    features = run("features")
    ready(link)

    def told(*words: str | Path) -> Any:
        done = palpate("model", *words, "--profile", profile, "--json")
        assert done.returncode == 0, done.stderr
        (inventory,) = json.loads(done.stdout)["features"]
        return [(one["name"], one["version"], one["sensor"]) for one in inventory["served"]]

    done = palpate("model", "load", "mine:7", "--profile", profile)
    assert done.returncode != 0
    assert "'mine:7' is not in the repository" in done.stderr
    done = palpate("model", "import", imported)
    assert done.returncode == 0, done.stderr
    assert "mine:7" in palpate("model", "list").stdout
    assert palpate("model", "verify", "mine").returncode == 0
    assert told("served") == [(bundle, shipped, "")], "an import changes nothing that serves"
    assert told("load", "mine") == [("mine", 7, "")]
    served = [("mine", 7, ""), (bundle, shipped, "thumb")]
    assert told("load", bundle, "--sensor", "thumb") == served
    again = palpate("model", "load", bundle, "--sensor", "thumb", "--profile", profile)
    assert "no gateway has sensor 'thumb'" in again.stderr, "it may come, or be misspelt"
    features.send_signal(signal.SIGKILL)
    features.wait()
    run("features")
    ready(link)
    assert told("served") == served
    assert told("rollback") == [(bundle, shipped, ""), (bundle, shipped, "thumb")]
    assert told("unload", "--sensor", "thumb")[0] == (bundle, shipped, "")
    # Another user has another state folder, and no token there.
    monkeypatch.setenv("XDG_STATE_HOME", str(imported))
    done = palpate("model", "unload", "--profile", profile)
    assert done.returncode == 2
    assert "admin token" in done.stderr


def test_a_station_that_trusts_a_key_imports_what_it_has_signed(
    palpate: Palpate, imported: Path, station: tuple[Path, LinkConfig], tmp_path: Path
) -> None:
    profile, _ = station
    key = tmp_path / "lab-signing.key"
    assert palpate("model", "key", key).returncode == 0
    trusting = tmp_path / "trusting.toml"
    trusting.write_text(f'{profile.read_text()}\n[models]\ntrusted_keys = ["{key}.pub"]\n')
    refused = palpate("model", "import", imported, "--profile", trusting)
    assert refused.returncode != 0
    assert "sign" in refused.stderr
    assert "mine" in palpate("model", "card", imported).stdout
    signed = palpate("model", "sign", imported, "--key", key)
    assert signed.returncode == 0, signed.stderr
    done = palpate("model", "import", imported, "--profile", trusting)
    assert done.returncode == 0, done.stderr
    assert "mine:7" in palpate("model", "list").stdout


def test_doctor_names_the_finger_that_the_remembered_bundle_was_made_for(
    bundle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The profile names the shipped one; a command chose another, which is what will serve."""
    shipped = read_bundle(resolve(bundle))
    folder = tmp_path / "models" / "mine" / "1"
    folder.parent.mkdir(parents=True)
    write_bundle(
        folder,
        model=shipped.model,
        golden=shipped.golden,
        manifest=dataclasses.replace(
            shipped.manifest, name="mine", version=1, sensor_serials=("BT-A",)
        ),
        known_inputs=shipped.known_inputs,
    )

    def found(serial: str) -> tuple[str, str]:
        sensor = {"name": "finger", "driver": "biotac_can", "options": {"serial": serial}}
        profile = parse_profile(
            {
                "features": {"bundle": bundle},
                "gateway": {"sensors": [sensor]},
                "models": {"folder": str(tmp_path / "models"), "state": str(tmp_path)},
            },
            where="test",
        )
        file = RememberedFile(profile.models.served_file("lab", "features", "features"))
        assert file.recall({"": bundle}) in (None, chosen)
        file.keep(chosen)
        grade, said, _ = doctor._bundle(profile)
        return grade, said

    chosen = {
        "": Remembered(bundle, shipped.sha256),
        "finger": Remembered("mine:1", b"", changed=True),
    }
    assert found("BT-A") == ("ok", f"{bundle}:{shipped.manifest.version}, mine:1 reproduce their "
                             "golden vectors")  # fmt: skip
    grade, said = found("BT-B")
    assert grade == "warn"
    assert "finger has mine:1 (made for BT-A; this is BT-B)" in said
    chosen["finger"] = Remembered("", b"", "mine:1", b"", changed=True)  # it was unloaded
    (tmp_path / "stations/lab/features.features.json").unlink()
    assert found("BT-B")[0] == "ok"
    refused = OSError(errno.EACCES, "Permission denied")
    monkeypatch.setattr(remembered, "read_regular", MagicMock(side_effect=refused))
    assert doctor._served(load_profile("virtual"), "features", {"": "x"}) == {"": "x"}


def test_a_broken_bundle_is_not_imported(palpate: Palpate, imported: Path) -> None:
    with open(imported / "model.onnx", "ab") as model:
        model.write(b"\0")
    done = palpate("model", "import", imported)
    assert done.returncode != 0
    assert "digest differs" in done.stderr
    assert "mine" not in palpate("model", "list").stdout


def test_a_printed_profile_names_no_folder_of_who_printed_it(palpate: Palpate) -> None:
    """It is printed by root, and run by the user of the unit (deploy/README.md)."""
    printed = palpate("up", "--print-config")
    assert printed.returncode == 0
    assert "share/palpate" not in printed.stdout
    assert "XDG" not in printed.stdout
    assert os.environ["XDG_STATE_HOME"] not in printed.stdout


class Services:
    """Stands for the services with models: what each of them answers to the question what serves.

    A service that is not named does not run. ``ordered`` says which got an order.
    """

    def __init__(self, **answers: PalpateError | tuple[ModelInventory, ...]) -> None:
        self._answers = answers
        self.ordered: list[str] = []

    def served(self, service: str) -> tuple[ModelInventory, ...]:
        gone = LinkError(f"no service {service!r} answers", remedy="start it")
        answer = self._answers.get(service, gone)
        if isinstance(answer, PalpateError):
            raise answer
        return answer

    def unload(self, service: str, *, sensor: str = "") -> tuple[ModelInventory, ...]:
        self.ordered.append(service)
        return ()

    roll_back = unload


@pytest.fixture
def give(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., None]:
    """Give a command to services that are made up."""
    token = tmp_path / "token"
    token.write_text("ab" * 32)
    token.chmod(0o600)
    monkeypatch.setattr(Session, "open", MagicMock())

    def give(services: Services, action: ModelAction, service: str | None = None) -> None:
        monkeypatch.setattr(models, "ModelAdmin", lambda *_: services)
        models.change_model(
            LinkConfig(), "lab", action, token=token, profile=None, service=service, as_json=True
        )

    return give


@pytest.mark.parametrize("action", [ModelAction.UNLOAD, ModelAction.ROLL_BACK])
def test_where_several_services_have_models_one_is_named(
    give: Callable[..., None], action: ModelAction
) -> None:
    """It was features that lost its bundle, whatever had been loaded last."""
    hangs = StreamTimeout("field did not answer", remedy="look")
    for field in ((), hangs):
        both = Services(features=(), field=field)
        with pytest.raises(ConfigError, match=r"--service features \| field"):
            give(both, action)
        assert both.ordered == []
        give(both, action, "field")
        assert both.ordered == ["field"]
    alone = Services(synthesis=())
    give(alone, action)
    assert alone.ordered == ["synthesis"]
    refused = RemoteError("no", remedy="x", code=ErrorCode.PERMISSION_DENIED)
    with pytest.raises(RemoteError):
        give(Services(features=refused, field=refused), action)


def test_a_service_that_hangs_hides_no_other(
    give: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    hangs = StreamTimeout("features did not answer", remedy="look")
    with pytest.raises(StreamTimeout):
        give(Services(features=hangs, field=()), ModelAction.LIST)
    assert json.loads(capsys.readouterr().out) == {"field": []}
    with pytest.raises(StreamTimeout):
        give(Services(features=hangs), ModelAction.LIST)
    assert capsys.readouterr().out == ""


def test_no_service_is_named_that_the_station_may_not_have(give: Callable[..., None]) -> None:
    for action in (ModelAction.LIST, ModelAction.UNLOAD):
        with pytest.raises(LinkError, match="none of the services features, field, synthesis ans"):
            give(Services(), action)
    with pytest.raises(LinkError, match="no service 'field' answers"):
        give(Services(), ModelAction.LIST, "field")


def test_the_name_of_a_bundle_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    served = ServedModel("", "x[/]", 1, bytes(32), 0, "y[red]:2")
    models._show({"features": (ModelInventory("features", (served,), ()),)}, as_json=False)
    shown = capsys.readouterr().out
    assert "x[/]:1" in shown
    assert "y[red]:2" in shown
