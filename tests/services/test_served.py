"""Bundles of a service: what serves which sensor, changes of it, and what outlasts a restart."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpate.config import parse_config
from palpate.errors import BundleError, ConfigError, ErrorCode, PalpateError, RemoteError
from palpate.files.bundle import Bundle, read_bundle
from palpate.messages import ModelAction, ModelCommand, ModelInventory
from palpate_services.config import FeaturesServiceConfig
from palpate_services.inference import served
from palpate_services.inference.remembered import RememberedFile
from palpate_services.inference.repository import Repository
from palpate_services.inference.served import ServedModels

LOAD, UNLOAD, ROLL_BACK = ModelAction.LOAD, ModelAction.UNLOAD, ModelAction.ROLL_BACK

Make = Callable[..., Path]


@pytest.fixture(autouse=True)
def trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials of bundles have tests of their own, and take a process each."""
    monkeypatch.setattr(served, "proven", lambda bundle, task: bundle)


@pytest.fixture
def models(tmp_path: Path, make_bundle: Make) -> Path:
    """A repository with x:1 to x:3 and y:1 for features."""
    folder = tmp_path / "models"
    for name, version in (("x", 1), ("x", 2), ("x", 3), ("y", 1)):
        made = make_bundle(name=name, version=version)
        (folder / name).mkdir(parents=True, exist_ok=True)
        shutil.copytree(made, folder / name / str(version))
    return folder


Service = Callable[..., ServedModels]


@pytest.fixture
def service(models: Path, tmp_path: Path) -> Service:
    """Starts the models of a features service; each start is one of the same station."""

    def start(**config: Any) -> ServedModels:
        settings = FeaturesServiceConfig(**{"bundle": "x:1", **config})
        repository = Repository(models, packaged=tmp_path / "none")
        return ServedModels(
            "features", settings, repository, RememberedFile(tmp_path / "served.json")
        )

    return start


def do(
    service: ServedModels, action: ModelAction, bundle: str = "", sensor: str = ""
) -> ModelInventory:
    command = ModelCommand(action, "lab", "features", bytes(16), time.time_ns(), "", bundle, sensor)
    return service.obey(command, "features")


def of(service: ServedModels, sensor: str = "any") -> str:
    runtime = service.of(sensor)
    return "none" if runtime is None else runtime.label


def refused(service: ServedModels, *command: Any) -> PalpateError:
    with pytest.raises(PalpateError) as caught:
        do(service, *command)
    return caught.value


def test_the_profile_chooses_for_all_and_for_single_sensors(service: Service) -> None:
    started = service(bundle="x", bundles={"thumb": "y", "ring": "x:1"})
    assert (of(started), of(started, "thumb"), of(started, "ring")) == ("x:3", "y:1", "x:1")
    assert started.describe() == "serving x:3, ring x:1, thumb y:1"
    entries = started.metadata().served
    assert [(e.sensor, e.name, e.version) for e in entries] == [
        ("", "x", 3), ("ring", "x", 1), ("thumb", "y", 1),
    ]  # fmt: skip
    assert started.metadata().version == 3


def test_a_sensor_with_the_bundle_of_another_finger_is_told(
    service: Service, models: Path, make_bundle: Make
) -> None:
    for name, serials in (("mine", ("BT-A",)), ("many", ("BT-A", "BT-B", "BT-C")), ("old", ())):
        shutil.copytree(make_bundle(name=name, sensor_serials=serials), models / name / "1")
    started = service(bundles={"thumb": "mine"})
    assert not started.meet("finger", "BT-X"), "it has no bundle of its own"
    assert started.meet("thumb", "BT-B")
    assert not started.meet("thumb", "BT-B")
    assert started.describe() == "serving x:1, thumb mine:1 (made for BT-A; this is BT-B)"
    do(started, LOAD, "many", "thumb")
    assert started.describe() == "serving x:1, thumb many:1"
    assert started.meet("thumb", "BT-X")
    assert "many:1 (made for BT-A and 2 more; this is BT-X)" in started.describe()
    do(started, LOAD, "old", "thumb")
    assert started.describe() == "serving x:1, thumb old:1", "it names nobody"
    do(started, UNLOAD, sensor="thumb")
    assert started.describe() == "serving x:1"


def test_a_profile_that_names_a_bundle_of_another_task_is_wrong() -> None:
    settings = FeaturesServiceConfig(bundle="field-twin")
    with pytest.raises(
        ConfigError, match=r"'field-twin'.* is for the task 'field', not 'features'"
    ):
        ServedModels("features", settings, Repository(None))


def test_load_and_roll_back_and_forth(service: Service, models: Path) -> None:
    started = service()
    before = started.of("any")
    inventory = do(started, LOAD, "x:2")
    assert of(started) == "x:2"
    assert inventory.served[0].previous == "x:1"
    assert inventory.served[0].bundle_sha256 == read_bundle(models / "x" / "2").sha256
    assert inventory.available == ("x:1", "x:2", "x:3", "y:1")
    assert inventory.change_s > 0
    do(started, ROLL_BACK)
    assert started.of("any") is before, "the one from before was kept in memory"
    do(started, ROLL_BACK)
    assert of(started) == "x:2"


def test_one_sensor_changes_and_the_others_do_not(service: Service) -> None:
    started = service()
    do(started, LOAD, "y", "thumb")
    assert (of(started), of(started, "thumb")) == ("x:1", "y:1")
    do(started, LOAD, "x:2")
    assert (of(started), of(started, "thumb")) == ("x:2", "y:1")
    inventory = do(started, UNLOAD, "", "thumb")
    assert of(started, "thumb") == "x:2"
    assert [(one.version, one.previous) for one in inventory.served] == [(2, "x:1"), (2, "y:1")]
    do(started, ROLL_BACK, "", "thumb")
    assert of(started, "thumb") == "y:1"
    do(started, ROLL_BACK, "", "thumb")
    assert of(started, "thumb") == "x:2"


def test_unload_leaves_sensors_without_a_bundle_until_one_is_loaded(service: Service) -> None:
    started = service(bundles={"thumb": "y"})
    do(started, UNLOAD)
    assert (of(started), of(started, "thumb")) == ("none", "y:1")
    assert started.metadata().name == "y"
    do(started, UNLOAD, "", "thumb")
    with pytest.raises(RemoteError, match="no bundle serves"):
        started.metadata()
    assert started.describe() == "serving no bundle"
    do(started, ROLL_BACK)
    assert of(started, "thumb") == "x:1"


def test_what_is_refused_changes_nothing(service: Service, models: Path, make_bundle: Make) -> None:
    started = service()
    serving = started.of("any")
    with open(models / "x" / "2" / "model.onnx", "ab") as model:
        model.write(b"\0")
    shutil.copytree(make_bundle(name="z", golden_shift=0.01), models / "z" / "1")
    shutil.copytree(models / "y" / "1", models / "y" / "7")
    assert isinstance(refused(started, LOAD, "x:2"), BundleError)
    assert "deviates from golden" in refused(started, LOAD, "z").problem
    assert "holds y:1" in refused(started, LOAD, "y:7").problem
    assert isinstance(refused(started, LOAD, "x:9"), ConfigError)
    assert "not by path" in refused(started, LOAD, str(models / "y" / "1")).problem
    assert "not by path" in refused(started, LOAD, "../y").problem
    assert "no bundle from before" in refused(started, ROLL_BACK).problem
    assert "no bundle to unload" in refused(started, UNLOAD, "", "thumb").problem
    assert started.of("any") is serving


def test_what_serves_already_is_not_loaded_again(service: Service) -> None:
    started = service()
    serving = started.of("any")
    assert do(started, LOAD, "x:1").change_s == 0
    assert started.of("any") is serving
    do(started, LOAD, "x:1", "thumb")
    assert started.of("thumb") is serving, "two sensors share one bundle in memory"
    do(started, ModelAction.LIST)


def test_a_roll_back_does_not_wait_for_a_load_and_counts(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = service()
    do(started, LOAD, "x:2")
    begun, go = threading.Event(), threading.Event()
    refusals: list[PalpateError] = []

    def slow(bundle: Bundle, task: str) -> Bundle:
        begun.set()
        assert go.wait(20)
        return bundle

    monkeypatch.setattr(served, "proven", slow)
    loading = threading.Thread(target=lambda: refusals.append(refused(started, LOAD, "x:3")))
    loading.start()
    assert begun.wait(20)
    second = refused(started, LOAD, "y", "thumb")
    assert second.code is ErrorCode.RESOURCE_EXHAUSTED
    assert second.retry_after_s > 0
    do(started, ModelAction.LIST)
    do(started, ROLL_BACK)
    go.set()
    loading.join(20)
    assert of(started) == "x:1", "the roll back was the newer order"
    assert "another command" in refusals[0].problem
    do(started, LOAD, "x:3")
    assert of(started) == "x:3"


def test_caps(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served, "SENSORS_MOST", 2)
    monkeypatch.setattr(served, "LOADED_MOST", 2)
    started = service()
    for sensor in ("a", "b"):
        do(started, LOAD, "x:2", sensor)
    error = refused(started, LOAD, "x:2", "c")
    assert error.code is ErrorCode.RESOURCE_EXHAUSTED
    error = refused(started, LOAD, "x:3")
    assert error.code is ErrorCode.RESOURCE_EXHAUSTED
    assert of(started) == "x:1"


def test_room_that_others_only_keep_for_a_roll_back_is_given(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the error says: unload some. It freed nothing."""
    monkeypatch.setattr(served, "LOADED_MOST", 2)
    started = service()
    do(started, LOAD, "x:2", "thumb")
    assert "unload some" in refused(started, LOAD, "x:3", "ring").remedy
    do(started, UNLOAD, "", "thumb")
    do(started, LOAD, "x:3", "ring")
    assert (of(started), of(started, "thumb"), of(started, "ring")) == ("x:1", "x:1", "x:3")
    assert "2 bundles are loaded" in refused(started, ROLL_BACK, "", "thumb").problem
    do(started, UNLOAD, "", "ring")
    do(started, ROLL_BACK, "", "thumb")
    assert of(started, "thumb") == "x:2", "it is loaded again"
    do(started, LOAD, "x:1", "thumb")
    do(started, LOAD, "y", "thumb")  # in place of the one that it kept itself
    assert of(started, "thumb") == "y:1"


def test_a_profile_with_more_bundles_than_can_be_loaded_is_refused() -> None:
    """The service ended with the advice to unload some, at each start."""
    bundles = {f"f{number}": f"b:{number}" for number in range(1, 33)}
    with pytest.raises(ConfigError, match=r"lab: bundles .*33 different ones.* loads 32"):
        parse_config(FeaturesServiceConfig, {"bundle": "b:33", "bundles": bundles}, where="lab")
    config = {"bundle": "b:1", "bundles": {**bundles, "more": "b:1"}}
    assert len(parse_config(FeaturesServiceConfig, config, where="lab").bundles) == 33


def test_a_restart_serves_what_was_served(service: Service, models: Path) -> None:
    started = service(bundles={"thumb": "y"})
    do(started, LOAD, "x:2")
    do(started, UNLOAD, "", "thumb")
    again = service(bundles={"thumb": "y"})
    assert (of(again), of(again, "thumb")) == ("x:2", "x:2")
    assert again.problem is None
    do(again, ROLL_BACK)
    assert of(again) == "x:1", "what came before is remembered too"
    do(again, ROLL_BACK, "", "thumb")
    assert of(again, "thumb") == "y:1"


def test_a_restart_does_not_try_again_what_has_served(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    do(service(), LOAD, "x:2")
    tried: list[str] = []

    def trial(bundle: Bundle, task: str) -> Bundle:
        tried.append(f"{bundle.manifest.name}:{bundle.manifest.version}")
        return bundle

    monkeypatch.setattr(served, "proven", trial)
    again = service()
    do(again, ROLL_BACK)
    assert (of(again), tried) == ("x:1", [])
    do(again, LOAD, "x:3")
    assert tried == ["x:3"]


def test_a_new_version_waits_until_somebody_loads_it(
    service: Service, models: Path, make_bundle: Make
) -> None:
    service(bundle="x")
    shutil.copytree(make_bundle(name="x", version=4), models / "x" / "4")
    assert of(service(bundle="x")) == "x:3"


def test_a_profile_that_names_another_bundle_counts(service: Service) -> None:
    do(service(), LOAD, "x:2")
    assert of(service(bundle="x:3")) == "x:3"
    assert of(service()) == "x:1"


@pytest.mark.parametrize("how", ["gone", "changed"])
def test_nobody_else_serves_for_a_bundle_that_cannot_be_had_again(
    service: Service, models: Path, make_bundle: Make, how: str
) -> None:
    started = service()
    do(started, LOAD, "y", "thumb")
    kept = models / "kept"
    (models / "y" / "1").rename(kept)
    if how == "changed":
        shutil.copytree(make_bundle(name="y", trained_on="other data"), models / "y" / "1")
    again = service()
    assert (of(again), of(again, "thumb")) == ("x:1", "none")
    assert again.problem is not None
    assert "y:1 does not serve sensor 'thumb' again: " in again.problem.problem
    assert "palpate model unload --service features --sensor thumb" in again.problem.remedy
    entry = do(again, ModelAction.LIST).served[1]
    assert (entry.sensor, entry.name) == ("thumb", "")
    # Where it comes back, it serves after the next start; else another is chosen for the sensor.
    shutil.rmtree(models / "y" / "1", ignore_errors=True)
    kept.rename(models / "y" / "1")
    assert of(service(), "thumb") == "y:1"
    do(again, LOAD, "x:2", "thumb")
    assert again.problem is None
    assert of(again, "thumb") == "x:2"


@pytest.mark.parametrize("how", ["gone", "changed"])
def test_after_an_upgrade_the_profile_counts_again(
    service: Service, models: Path, make_bundle: Make, how: str
) -> None:
    """Unlike a bundle that somebody has loaded, the profile's is replaced by its newest version."""
    assert of(service(bundle="x")) == "x:3"
    shutil.rmtree(models / "x" / "3")
    if how == "changed":
        shutil.copytree(
            make_bundle(name="x", version=3, trained_on="more data"), models / "x" / "3"
        )
    again = service(bundle="x")
    assert again.problem is None
    assert of(again) == ("x:2" if how == "gone" else "x:3")
    shutil.rmtree(models / "x")
    with pytest.raises(ConfigError, match="'x' is not in the repository"):
        service(bundle="x")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 2}', '{"format": 1, "profile": {}}'])
def test_a_damaged_memory_is_a_problem_and_no_other_bundle(
    service: Service, tmp_path: Path, text: str
) -> None:
    (tmp_path / "served.json").write_text(text)
    started = service()
    assert of(started) == "none"
    assert isinstance(started.problem, ConfigError)
    do(started, LOAD, "x:1")
    assert started.problem is None
    assert of(service()) == "x:1"


def test_after_a_damaged_memory_the_profile_counts_for_all_others(
    service: Service, tmp_path: Path
) -> None:
    (tmp_path / "served.json").write_text("{")
    do(service(bundle="x:1", bundles={"thumb": "x:2"}), LOAD, "y:1", "finger")
    again = service(bundle="x:1", bundles={"thumb": "x:2"})
    assert again.problem is None
    assert [of(again, sensor) for sensor in ("finger", "thumb", "any")] == ["y:1", "x:2", "x:1"]
    do(again, UNLOAD, "", "thumb")
    assert of(service(bundle="x:1", bundles={"thumb": "x:2"}), "thumb") == "x:1"


def test_a_change_that_cannot_be_remembered_says_so(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = service()
    monkeypatch.setattr(Path, "mkdir", lambda *_, **__: (_ for _ in ()).throw(OSError(28, "full")))
    error = refused(started, LOAD, "x:2")
    assert "a restart would serve what was served before" in error.problem
    assert of(started) == "x:2"


@pytest.mark.parametrize(
    ("command", "serves"),
    [
        ((LOAD, "x:3"), "x:3"),
        ((LOAD, "x"), "x:3"),
        ((ROLL_BACK,), "x:1"),
        ((UNLOAD,), "none"),
        ((LOAD, "y", "any"), "y:1"),
        ((UNLOAD, "", "any"), "x:2"),
    ],
)
def test_a_command_given_again_is_remembered_and_takes_effect_once(
    service: Service, monkeypatch: pytest.MonkeyPatch, command: Any, serves: str
) -> None:
    """As the error says: a second roll back undid the first, and a load only said all is well."""
    started = service()
    do(started, LOAD, "x:2")
    if command == (UNLOAD, "", "any"):
        do(started, LOAD, "x:1", "any")
    with monkeypatch.context() as full:
        full.setattr(Path, "mkdir", lambda *_, **__: (_ for _ in ()).throw(OSError(28, "full")))
        for _ in range(2):
            assert "then give the command again" in refused(started, *command).remedy
            assert of(started) == serves
    do(started, *command)
    again = service()
    assert of(started) == of(again) == serves


def test_memory_is_written_whole(service: Service, tmp_path: Path) -> None:
    started = service()
    do(started, LOAD, "x:2")
    values = json.loads((tmp_path / "served.json").read_text())
    assert values["served"][""]["bundle"] == "x:2"
    assert values["served"][""]["previous"] == "x:1"
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".served")] == []
