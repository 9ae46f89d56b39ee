"""What should run: by a profile, and by the runs of this host."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from palpate.bus import Session
from palpate.bus.no_router import RouterAbsent
from palpate.census import SUPERVISOR, ProcessReport
from palpate.config import LinkConfig, endpoint_host_port
from palpate.errors import ConfigError, DeviceLost, LinkError, PalpateError
from palpate.health import Health, HealthReporter
from palpate.messages import ServiceState, Status, SupervisedProcess
from palpate.process import state_folder
from palpate_deploy.station import supervision
from palpate_deploy.station.host import (
    KEPT_RUNS,
    RUN_LOCK,
    RunDiskError,
    end_run,
    free_endpoint,
    names_taken,
    new_run_folder,
    private_profile,
    running_folders,
    write_profile,
    write_run_file,
)
from palpate_deploy.station.logs import FAILED, exit_code
from palpate_deploy.station.processes import FiniteRun
from palpate_deploy.station.profile import Profile, parse_profile
from palpate_deploy.station.status import show_status
from palpate_deploy.station.troubles import (
    Expectation,
    ask_through_router,
    expectation,
    expectation_here,
    expectation_of,
    lifeless,
    troubles,
)

PROCESSES = ["router", "gateway", "features"]


def a_run(listen: str, *, station: str = "lab", supervised: bool = True) -> Path:
    profile = parse_profile(
        {"station": station, "processes": PROCESSES, "router": {"listen": [listen]}}, where="test"
    )
    folder = new_run_folder("mine")
    write_profile(profile, folder)
    if supervised:
        (folder / "supervisord.conf").touch()
    return folder


def names(*more: str) -> set[tuple[str, str]]:
    return {(name, name) for name in (*PROCESSES, *more)}


def test_a_profile_says_what_it_starts() -> None:
    said = expectation_of("virtual")
    assert {name for name, _ in said.processes} >= {"router", "gateway", "features", "recorder"}
    assert said.source == "profile virtual"
    with pytest.raises(ConfigError, match="does not exist"):
        expectation_of("virtaul")


def test_a_run_of_this_host_is_found_by_router_and_station() -> None:
    here = free_endpoint()
    folder = a_run(here)
    said = expectation_here([here], "lab")
    assert said is not None
    assert said.processes == names("supervisor")
    assert folder.name in said.source
    assert expectation_here([here.replace("127.0.0.1", "localhost")], "lab") is not None
    assert expectation_here([here], "elsewhere") is None
    assert expectation_here([free_endpoint()], "lab") is None
    assert expectation_here(["tcp/10.1.2.3:7447"], "lab") is None


def test_the_newest_run_counts_and_one_that_has_ended_does_not() -> None:
    here = free_endpoint()
    ended = a_run(here)
    (ended / RUN_LOCK).unlink()
    (ended / RUN_LOCK).touch()
    ended.rename(ended.with_name(f"99999999-999999-mine-{os.getpid()}"))
    assert expectation_here([here], "lab") is None
    finite = a_run(here, supervised=False)
    finite.rename(finite.with_name(f"20990101-000000-replay-{os.getpid()}"))
    said = expectation_here([here], "lab")
    assert said is not None
    assert said.processes == names()


def test_folders_of_ended_runs_go_although_a_process_has_their_id() -> None:
    """In a container every start has the same one."""
    runs = state_folder() / "runs"
    for number in range(2 * KEPT_RUNS):
        ended = runs / f"20260101-{number:06d}-lab-{os.getpid()}"
        ended.mkdir(parents=True)
        (ended / RUN_LOCK).touch()
    running = new_run_folder("lab")
    running = running.rename(runs / f"20250101-000000-lab-{2**22 + 5}")
    other = runs / "0-somebody-elses"
    other.mkdir()
    for _ in range(2):
        new_run_folder(f"lab{_}")
    assert {running, other} < {*runs.iterdir()}
    assert len([*runs.iterdir()]) == KEPT_RUNS + 2
    assert running in running_folders()
    made = "from palpate_deploy.station.host import new_run_folder; print(new_run_folder('lab'))"
    done = subprocess.run([sys.executable, "-c", made], capture_output=True, text=True, check=True)
    assert Path(done.stdout.strip()).is_dir()
    assert Path(done.stdout.strip()) not in running_folders()


def test_a_run_that_was_stopped_is_over_though_its_process_goes_on() -> None:
    with FiniteRun("a") as run:
        assert run.folder in running_folders()
    assert run.folder.exists()
    assert run.folder not in running_folders()
    run.stop()


@pytest.mark.parametrize("refused", ["write_profile", "write_run_file", "start_child"])
def test_a_start_that_is_refused_leaves_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: str
) -> None:
    def full(*_: object) -> None:
        raise ConfigError("no space left on device", remedy="free some")

    monkeypatch.setattr(supervision, "_MEMORY", tmp_path)
    monkeypatch.setattr(supervision, refused, full)
    before = running_folders()
    with pytest.raises(ConfigError, match="no space"):
        supervision.Supervisor(private_profile("virtual"), "refused")
    assert running_folders() == before
    assert not [*tmp_path.glob("palpate-*")]


def test_a_damaged_folder_is_passed_over() -> None:
    here = free_endpoint()
    (a_run(here) / "profile.toml").write_text("not = [toml", encoding="utf-8")
    assert expectation_here([here], "lab") is None


def test_a_router_that_should_answer_is_not_said_to_be_absent() -> None:
    here = free_endpoint()
    link = LinkConfig(connect=(here,), wait_for_router_s=0.3)
    with pytest.raises(LinkError, match="no router") as absent:
        ask_through_router(link, "lab", None)
    assert "palpate up" in absent.value.remedy
    a_run(here)
    with pytest.raises(LinkError, match="does not answer, but should") as hangs:
        ask_through_router(link, "lab", expectation_here([here], "lab"))
    assert "by itself" in hangs.value.remedy


def test_a_station_that_only_a_profile_knows_does_not_run() -> None:
    here = free_endpoint()
    link = LinkConfig(connect=(here,), wait_for_router_s=0.3)
    with pytest.raises(RouterAbsent, match="the station of profile virtual does not run") as absent:
        ask_through_router(link, "lab", expectation(link, "lab", "virtual"))
    assert "palpate up" in absent.value.remedy
    assert "systemctl start" in absent.value.remedy
    with socket.create_server(("127.0.0.1", endpoint_host_port(here)[1])):
        with pytest.raises(LinkError, match="something listens"):
            ask_through_router(link, "lab", expectation(link, "lab", "virtual"))
        a_run(here)
        with pytest.raises(LinkError, match="does not answer, but should"):
            ask_through_router(link, "lab", expectation(link, "lab", "virtual"))


def test_a_listener_with_certificates_is_not_said_to_hang() -> None:
    here = free_endpoint()
    link = LinkConfig(connect=(here,), wait_for_router_s=0.3)
    path = a_run(here) / "profile.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("tcp/", "tls/"), encoding="utf-8")
    with (
        socket.create_server(("127.0.0.1", endpoint_host_port(here)[1])),
        pytest.raises(LinkError, match="something listens") as told,
    ):
        ask_through_router(link, "lab", expectation(link, "lab", None))
    assert "connect to tls/127.0.0.1:" in told.value.remedy


def test_a_supervisor_that_is_stopped_runs() -> None:
    here = free_endpoint()
    census = [ProcessReport(*SUPERVISOR, alive=False, ready=False, status=None)]
    (gone,) = troubles(census)
    assert gone.problem == "does not run"
    a_run(here)
    (stopped,) = troubles(census, expectation(LinkConfig(connect=(here,)), "lab", "virtual"))
    assert stopped.problem == f"runs as process {os.getpid()} and cannot be reached"
    assert f"kill -CONT {os.getpid()}" in stopped.remedy


def test_a_supervisor_that_hangs_is_missed_beside_a_named_profile() -> None:
    here = free_endpoint()
    link = LinkConfig(connect=(here,))
    said = expectation(link, "lab", "virtual")
    assert said is not None
    assert SUPERVISOR not in said.processes
    a_run(here)
    said = expectation(link, "lab", "virtual")
    assert said is not None
    assert said.source == "profile virtual"
    assert said.processes == expectation_of("virtual").processes | {SUPERVISOR}


def test_a_health_check_fails_only_for_what_is_missing_or_mute(
    link: LinkConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A lost sensor is no reason to end the station that waits for it."""
    profile = tmp_path / "lab.toml"
    profile.write_text('processes = ["gateway"]\n', encoding="utf-8")
    health = Health("gateway", "gateway")
    with Session.open(link, station="lab") as session:
        presence = session.presence("gateway", instance="gateway")
        with HealthReporter(session, health):
            presence.ready()
            health.fail(DeviceLost("sensor 'thumb' is silent", remedy="plug it in"))
            look = {"as_json": False, "profile": str(profile), "timeout_s": 1.0}
            assert show_status(link, "lab", **look) == 1  # type: ignore[arg-type]
            assert show_status(link, "lab", alive=True, **look) == 0  # type: ignore[arg-type]
            assert capsys.readouterr().out.count("sensor 'thumb' is silent") >= 2, "it is told"
            profile.write_text('processes = ["gateway", "recorder"]\n', encoding="utf-8")
            assert show_status(link, "lab", alive=True, **look) == 1  # type: ignore[arg-type]


def test_a_process_that_is_started_again_or_is_elsewhere_is_not_for_a_health_check() -> None:
    gone = [ProcessReport(name, name, False, False, None) for name in ("web", "features", "fem")]
    processes = (
        SupervisedProcess("web", "web", "backoff", 0, 3, 0.0),
        SupervisedProcess("features", "features", "starting", 4711, 0, 1.0),
    )
    state = ServiceState.DEGRADED
    status = Status(*SUPERVISOR, state, 10**12, 0, 60.0, "1", processes=processes)
    census = [*gone, ProcessReport(*SUPERVISOR, True, True, status)]
    assert {one.service for one in troubles(census)} == {"web", "features", "fem", "supervisor"}
    assert {one.service for one in lifeless(census)} == {"features", "fem"}
    own = Expectation("profile lab", frozenset((name, name) for name in ("web", "features")))
    assert {one.service for one in lifeless(census, own)} == {"features"}


def test_a_full_disk_of_state_is_told_with_a_remedy() -> None:
    """And not as a mistake in the profile, after which systemd does not try again."""
    with pytest.raises(RunDiskError, match=r"No space left.*XDG_STATE_HOME") as caught:
        write_run_file(Path("/dev/full"), "a profile")
    assert exit_code(caught.value) == FAILED


@pytest.mark.parametrize(
    ("number", "refusal"), [(errno.ENOSPC, RunDiskError), (errno.EACCES, ConfigError)]
)
def test_a_full_disk_is_no_forbidden_folder(
    monkeypatch: pytest.MonkeyPatch, number: int, refusal: type[PalpateError]
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(refusal, match="XDG_STATE_HOME"):
        new_run_folder("lab")


@pytest.mark.parametrize("refuses", ["open", "flock"])
def test_a_start_that_a_full_disk_refuses_is_no_run(
    monkeypatch: pytest.MonkeyPatch, refuses: str
) -> None:
    """It had a folder without a lock, and counted as one that runs while this process does."""
    call = os.open if refuses == "open" else fcntl.flock

    def refuse(on: Any, *rest: Any, **keys: Any) -> Any:
        if refuses == "flock" or Path(on).name == RUN_LOCK:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return call(on, *rest, **keys)

    with monkeypatch.context() as full:
        full.setattr(os if refuses == "open" else fcntl, refuses, refuse)
        with pytest.raises(RunDiskError):
            new_run_folder("lab")
    assert running_folders() == []
    assert list((state_folder() / "runs").iterdir()) == []


def test_a_start_that_is_refused_leaves_the_run_whose_name_it_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(time, "strftime", lambda _: "20260101-000000")
    running = new_run_folder("lab")
    with pytest.raises(ConfigError, match="File exists"):
        new_run_folder("lab")
    assert running_folders() == [running]
    end_run(running)


def test_two_stations_of_one_name_do_not_run_on_one_host(tmp_path: Path) -> None:
    """Each would overwrite what the other remembers of its models."""

    def station(**keys: object) -> Profile:
        return parse_profile({"processes": ["features", "fem"], **keys}, where="test")

    with names_taken(station()):
        with pytest.raises(LinkError, match="station 'lab' runs already on this host") as told:
            with names_taken(station(link={"connect": ["tcp/127.0.0.1:7448"]})):
                pass
        assert "station in the profile" in told.value.remedy
        others = ({"replica": "b"}, {"station": "arm2"}, {"processes": ["gateway"]})
        for other in (*others, {"models": {"state": str(tmp_path / "elsewhere")}}):
            with names_taken(station(**other)):
                pass
    with names_taken(station()):
        pass


def test_a_run_of_an_older_palpate_is_told_by_its_process() -> None:
    """It locks no file."""
    runs = state_folder() / "runs"
    going_on, ended = (runs / f"20260101-000000-lab-{pid}" for pid in (os.getpid(), 2**22 + 5))
    for folder in (going_on, ended):
        folder.mkdir(parents=True)
    assert running_folders() == [going_on]
