"""The command: help, exit codes, errors in two lines without a traceback."""

from __future__ import annotations

import errno
import importlib.util
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from palpate.bus import Session
from palpate.config import TLS_FILES, LinkConfig, TlsConfig, endpoint_host_port
from palpate.errors import (
    BundleError,
    ConfigError,
    DeviceLost,
    LinkError,
    MissingExtraError,
    PalpateError,
    RecordingError,
    StreamTimeout,
)
from palpate_deploy.cli import WIDE
from palpate_deploy.cli import data as training
from palpate_deploy.cli.app import app
from palpate_deploy.cli.options import DEFAULT_CONNECT, DEFAULT_STATION, station_link
from palpate_deploy.diagnose import doctor
from palpate_deploy.station import status, tare
from palpate_deploy.station.host import check_free, free_endpoint
from palpate_deploy.station.logs import exit_code
from palpate_deploy.station.profile import changed, load_profile
from palpate_fem.cli.app import EXTRA_MODULES

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

TRAINING = {"train", "data"}  # their commands come from another room, and need its extra


def _commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    inner = getattr(command, "commands", None)
    if inner is None:
        yield path, command
        return
    for name in inner.keys() - TRAINING if not path else inner.keys():
        sub = inner[name]
        yield from _commands(sub, (*path, name))


COMMANDS = dict(_commands(typer.main.get_command(app)))


def _assert_said(result: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    assert result.returncode == code, result.stderr
    assert "Traceback" not in result.stderr
    problem, fix = result.stderr.splitlines()[-2:]
    assert problem.startswith("error: ")
    assert fix.startswith("  fix: ")
    for word in words:
        assert word in result.stderr


@pytest.mark.parametrize("path", sorted(COMMANDS), ids=" ".join)
def test_help_has_a_runnable_example(path: tuple[str, ...]) -> None:
    result = CliRunner().invoke(app, [*path, "--help"])
    assert result.exit_code == 0
    assert f"Example: palpate {' '.join(path)}" in " ".join(result.output.split())


def test_help_imports_nothing_heavy() -> None:
    heavy = ("numpy", "zenoh", "pydantic", "onnxruntime", "rerun", "torch", "matplotlib", "mcap")
    program = (
        "import sys; from palpate_deploy.cli.app import app\n"
        "from typer.testing import CliRunner\n"
        "assert CliRunner().invoke(app, ['--help']).exit_code == 0\n"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ConfigError("a", remedy="b"), 2),
        (MissingExtraError("torch", extra="training"), 2),
        (DeviceLost("a", remedy="b"), 3),
        (RecordingError("a", remedy="b"), 3),
        (LinkError("a", remedy="b"), 1),
        (BundleError("a", remedy="b"), 1),
    ],
)
def test_exit_codes(error: PalpateError, code: int) -> None:
    assert exit_code(error) == code


def test_unknown_option_is_a_usage_error(palpate: Palpate) -> None:
    assert palpate("up", "--nonsense").returncode == 2


def test_unknown_profile(palpate: Palpate) -> None:
    _assert_said(palpate("up", "--profile", "virtaul"), 2, "virtaul", "'virtual'")


def test_unknown_key_in_a_profile(palpate: Palpate, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('[recorder]\nuot = "x"\n', encoding="utf-8")
    _assert_said(palpate("up", "--profile", path), 2, str(path), "recorder.uot", "'out'")


def test_print_config_is_toml_and_starts_nothing(palpate: Palpate, tmp_path: Path) -> None:
    result = palpate("up", "--profile", "virtual", "--print-config")
    assert result.returncode == 0
    assert "[features]" in result.stdout
    again = tmp_path / "again.toml"
    again.write_text(result.stdout, encoding="utf-8")
    assert palpate("up", "--profile", again, "--print-config").stdout == result.stdout


def test_port_in_use_is_said_before_anything_starts(palpate: Palpate, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        path = tmp_path / "mine.toml"
        path.write_text(f'[router]\nlisten = ["tcp/127.0.0.1:{port}"]\n', encoding="utf-8")
        result = palpate("up", "--profile", path)
    _assert_said(result, 1, f"127.0.0.1:{port} is in use", "palpate status", "[router] listen")
    assert not list((Path(os.environ["XDG_STATE_HOME"])).rglob("supervisord.conf"))


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_another_port_is_said_as_a_router_listens(protocol: str, host: str) -> None:
    with socket.socket(socket.AF_INET6 if "[" in host else socket.AF_INET) as taken:
        try:
            taken.bind((host.strip("[]"), 0))
        except OSError:
            pytest.skip("this host has no IPv6")
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match="in use") as told:
            check_free([f"{protocol}/{host}:{port}"])
    (said,) = re.findall(r"LISTEN='\[\"(.*)\"\]'", told.value.remedy)
    assert said.startswith(f"{protocol}/{host}:")
    assert endpoint_host_port(said)[1] != port


def test_address_of_another_host_cannot_be_listened_at() -> None:
    with pytest.raises(LinkError, match="cannot listen"):
        check_free(["tcp/192.0.2.1:7447"])  # TEST-NET-1: nobody's address


def test_no_router() -> None:
    """Each waits for the router for a while, so they wait together."""
    endpoint = free_endpoint()
    commands = (
        ("status",),
        ("topic", "list"),
        ("topic", "hz", "electrodes"),
        ("topic", "echo", "features"),
        ("record",),
        ("tare", "finger"),
    )
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "palpate_deploy", *command, "--connect", endpoint],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for command in commands
    ]
    for process in running:
        output, errors = process.communicate(timeout=60)
        done = subprocess.CompletedProcess(process.args, process.returncode, output, errors)
        _assert_said(done, 1, endpoint, "palpate up")


def test_endpoint_that_is_none(palpate: Palpate) -> None:
    _assert_said(palpate("status", "--connect", "localhost"), 2, "localhost")


def test_unknown_topic(palpate: Palpate) -> None:
    _assert_said(palpate("topic", "hz", "electrode"), 2, "'electrode'", "'electrodes'")


def test_unknown_service(palpate: Palpate) -> None:
    _assert_said(palpate("run", "gatway"), 2, "gatway", "gateway")


def test_missing_file(palpate: Palpate) -> None:
    _assert_said(palpate("replay", "nowhere.btd"), 2, "nowhere.btd")


def test_unknown_bundle(palpate: Palpate, text_log: Path) -> None:
    _assert_said(palpate("replay", text_log, "--bundle", "nonsense"), 2, "nonsense")


def test_missing_extra_gives_the_install_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def not_installed(room: str) -> typer.Typer:
        raise MissingExtraError("torch", extra="training")

    monkeypatch.setattr(training, "_app", not_installed)
    result = CliRunner().invoke(app, ["train", "--help"])
    assert result.exit_code == 2
    assert 'pip install "palpate[training]"' in result.stderr


def test_training_commands_are_mounted(palpate: Palpate) -> None:
    pytest.importorskip("torch", reason="palpate[training] is not installed")
    result = palpate("train", "--help")
    assert result.returncode == 0
    assert "palpate train" in result.stdout


def test_doctor_names_what_is_wrong(palpate: Palpate, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('[features]\nbundle = "nonsense"\n', encoding="utf-8")
    result = palpate("doctor", "--profile", path, "--json")
    assert result.returncode == 1
    lines = {line["what"]: line for line in json.loads(result.stdout)}
    assert lines["bundle"]["grade"] == "fail"
    assert "nonsense" in lines["bundle"]["found"]
    assert lines["python"]["grade"] == "ok"


def test_doctor_names_what_an_extra_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    lacking = {"warp": "warp-lang", "pymetis": "pymetis"}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name in lacking else found(name)
    )
    lines = {line.found: line for line in doctor._packages()}
    for distribution in lacking.values():
        line = lines[f"{distribution} is not installed"]
        assert (line.grade, line.fix) == ("warn", 'pip install "palpate[fem]"')


def test_doctor_fails_if_a_process_of_the_profile_lacks_its_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "onnxruntime" else found(name)
    )
    lines = {line.what: line for line in doctor._all("bench")}
    assert lines["extras"].grade == "fail"
    assert "'onnxruntime'" in lines["extras"].found
    assert lines["extras"].fix == 'install it: pip install "palpate[services]"'


def test_doctor_warns_where_the_disk_cannot_hold_what_is_kept(tmp_path: Path) -> None:
    base = load_profile("virtual")
    limit = shutil.disk_usage(tmp_path).free * 2
    keys = {"out": str(tmp_path), "min_free_bytes": 0}
    grade, found, fix = doctor._disk(changed(base, recorder={**keys, "keep_bytes": limit}))
    assert grade == "warn"
    assert "pause" in found
    assert "keep_bytes" in fix
    grade, _, _ = doctor._disk(changed(base, recorder={**keys, "keep_bytes": 0}))
    assert grade == "ok"


def test_doctor_tells_a_folder_that_it_may_not_look_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shut = tmp_path / "shut"

    def look(path: Path) -> bool:
        if shut in path.parents:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return os.path.exists(path)

    monkeypatch.setattr(Path, "exists", look)  # root may look everywhere
    profile = tmp_path / "mine.toml"
    profile.write_text(f'[recorder]\nout = "{shut}/runs"\n', "utf-8")
    lines = {line.what: line for line in doctor._all(str(profile))}
    assert lines["disk"].grade == "fail"
    assert lines["disk"].found == f"{shut}/runs: Permission denied"


def test_doctor_finds_no_room_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    profile = changed(load_profile("virtual"), recorder={"out": str(tmp_path / "file/runs")})
    assert doctor._disk(profile)[:2] == ("fail", f"{tmp_path}/file is no folder")


def test_doctor_warns_of_sensors_that_no_gateway_has() -> None:
    base = load_profile("virtual")
    assert doctor._sensors(base)[0] == "ok"
    strange = changed(base, features={"sensors": ["finger", "thumb"], "bundles": {"toe": "a"}})
    grade, found, fix = doctor._sensors(strange)
    assert grade == "warn"
    assert "thumb ([features]), toe ([features])" in found
    assert fix
    alone = strange.model_copy(update={"processes": ("router", "gateway")})
    assert doctor._sensors(alone)[0] == "ok"


@pytest.mark.parametrize(
    ("given", "variables", "where"),
    [
        ([], {}, ("tcp/127.0.0.1:7555", "mine")),
        (["--connect", DEFAULT_CONNECT], {}, (DEFAULT_CONNECT, "mine")),
        (["--station", DEFAULT_STATION], {}, ("tcp/127.0.0.1:7555", DEFAULT_STATION)),
        ([], {"PALPATE_CONNECT": DEFAULT_CONNECT}, (DEFAULT_CONNECT, "mine")),
    ],
)
def test_what_is_given_beside_a_profile_holds(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    given: list[str],
    variables: dict[str, str],
    where: tuple[str, str],
) -> None:
    """Although it is what would hold without the profile."""
    path = tmp_path / "mine.toml"
    path.write_text('station = "mine"\n[router]\nlisten = ["tcp/127.0.0.1:7555"]\n', "utf-8")
    asked = []

    def show_status(link: LinkConfig, station: str, **_: object) -> int:
        asked.append((*link.connect, station))
        return 0

    monkeypatch.setattr(status, "show_status", show_status)
    for profile in (["--profile", str(path)], []):
        done = CliRunner().invoke(app, ["status", *profile, *given], env=variables)
        assert done.exit_code == 0, done.output
    assert asked[0] == where
    assert asked[1] == (DEFAULT_CONNECT, DEFAULT_STATION)


@pytest.mark.parametrize("router", ["tls/192.168.1.2:7447", "tcp/192.168.1.2:7447"])
def test_certificates_are_used_beside_a_profile_that_has_none(tmp_path: Path, router: str) -> None:
    for name in TLS_FILES.values():
        (tmp_path / name).touch()
    path = tmp_path / "mine.toml"
    path.write_text(f'[link]\nconnect = ["{router}"]\n', "utf-8")
    if router.startswith("tcp/"):
        with pytest.raises(ConfigError, match="is not encrypted, although certificates are given"):
            station_link(str(path), None, None, tmp_path)
        return
    link, _ = station_link(str(path), None, None, tmp_path)
    assert link.connect == (router,)
    assert link.tls == TlsConfig.of_folder(tmp_path)


@pytest.mark.parametrize(
    ("driver", "grade"),
    [("ros_bag", "ok"), ("text_log", "fail"), ("record", "fail"), ("pose_file", "fail")],
)
def test_doctor_takes_a_folder_for_a_bag_only(tmp_path: Path, driver: str, grade: str) -> None:
    """A bag of ROS 2 is one."""
    there = {"position_m": [0.0, 0.0, 0.0], "orientation_wxyz": [1.0, 0.0, 0.0, 0.0]}
    options: dict[str, object] = {}
    if driver == "pose_file":
        options = {"indenter": "sphere_7mm", "base_sensor": there, "flange_indenter": there}
    for path, expected, says in (
        (tmp_path, grade, "is a folder"),
        (tmp_path / "gone", "fail", "does not exist"),
    ):
        sensor = {"name": "finger", "driver": driver, "options": {**options, "path": str(path)}}
        profile = changed(load_profile("virtual"), gateway={"sensors": [sensor]})
        found = doctor._sensors(profile)
        assert found[0] == expected
        assert expected == "ok" or says in found[1]


def test_a_tare_over_many_frames_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[int, float] = {}

    class Joined:
        def __enter__(self) -> Joined:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def serves(self, *_: object, **__: object) -> bool:
            return False

    insisted: set[bool] = set()

    def ask(_: object, sensor: str, *, frames: int, timeout_s: float, anyway: bool) -> None:
        given[frames] = timeout_s
        insisted.add(anyway)
        raise StreamTimeout("silent", remedy="ask again")

    monkeypatch.setattr(Session, "open", lambda *_, **__: Joined())
    monkeypatch.setattr(tare, "ask_tare", ask)
    for frames in ("0", "800"):
        CliRunner().invoke(app, ["tare", "--frames", frames])
    assert given == {0: 5.0, 800: 25.0}  # 800 frames at 100 Hz take 8 s
    CliRunner().invoke(app, ["tare", "--frames", "800", "--timeout-s", "3"])
    assert given[800] == 3.0
    assert insisted == {False}
    CliRunner().invoke(app, ["tare", "--anyway"])
    assert insisted == {False, True}
    refused = CliRunner().invoke(app, ["tare", "--frames", "-3"])
    assert refused.exit_code == 2
    assert "--frames" in refused.output


def test_a_roll_back_has_no_dry_run() -> None:
    refused = CliRunner().invoke(app, ["install", "virtual", "--dry-run", "--rollback"])
    assert refused.exit_code == 2
    assert "--dry-run" in refused.output


def test_doctor_looks_for_all_that_simulations_need() -> None:
    looked_for = {module for module, _, _ in doctor._PACKAGES}
    assert set(EXTRA_MODULES) <= looked_for


def test_json_logs(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    path = tmp_path / "mine.toml"
    path.write_text(
        f'[router]\nlisten = ["{endpoint}"]\n[log]\nformat = "json"\n', encoding="utf-8"
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate_deploy", "run", "router", "--profile", str(path)],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stderr is not None
        first = json.loads(process.stderr.readline())
        process.send_signal(signal.SIGTERM)
        _, rest = process.communicate(timeout=20)
    finally:
        process.kill()
    assert list(first)[:4] == ["time", "level", "logger", "message"]
    assert first["service"] == "router"
    assert first["pid"] == process.pid
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", first["time"])
    assert first["level"] == "info"
    assert first["logger"] == "palpate_deploy.station.processes"
    assert "router starts" in first["message"]
    assert process.returncode == 0
    assert "router ends" in rest


FEW_RESOURCES = """
import sys, types
from palpate_deploy.cli import app

def run_service(*_):
    import ctypes, threading
    import numpy, threadpoolctl
    print([pool["num_threads"] for pool in threadpoolctl.threadpool_info()])
    # In a pool of its own a thread's block lies 64 MB or more from the others'.
    malloc = ctypes.CDLL(None).malloc
    malloc.restype = ctypes.c_void_p
    places, together = set(), threading.Barrier(8)
    def take():
        together.wait()
        places.add(malloc(1000) >> 26)
        together.wait()
    threads = [threading.Thread(target=take) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(len(places) <= 2)

processes = types.ModuleType("palpate_deploy.station.processes")
processes.service_named, processes.run_service = str, run_service
sys.modules[processes.__name__] = processes
app.run("gateway", "virtual")
"""


def test_a_process_of_a_station_uses_few_threads_and_memory_pools() -> None:
    """A second thread of NumPy kept a core busy with waiting; with many pools memory grew."""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", FEW_RESOURCES], env=environment, capture_output=True, text=True
    )
    assert done.stdout.split() == ["[1]", "True"], done.stderr


@pytest.mark.parametrize("command", [["topic", "echo", "features"], ["tare", "finger"]])
def test_a_negative_wait_is_refused(command: list[str]) -> None:
    result = CliRunner().invoke(app, [*command, "--timeout-s", "-1"])
    assert result.exit_code == 2
    assert "--timeout-s" in result.output


@pytest.mark.parametrize("number", ["inf", "nan"])
@pytest.mark.parametrize(
    "command",
    [
        ["top", "--period-s"],
        ["tare", "finger", "--timeout-s"],
        ["new-station", "--look-s"],
        ["demo", "--seconds"],
        ["topic", "list", "--seconds"],
        ["topic", "hz", "--seconds"],
        ["topic", "echo", "--timeout-s"],
        ["record", "--duration-s"],
        ["bench", "soak", "--minutes"],
    ],
)
def test_a_time_without_end_is_refused(command: list[str], number: str) -> None:
    result = CliRunner().invoke(app, [*command, number])
    assert result.exit_code == 2
    assert f"Invalid value for '{command[-1]}'" in result.output


@pytest.mark.parametrize("columns", ["", "90"])
def test_tables_in_a_file_are_not_cut(
    palpate: Palpate, monkeypatch: pytest.MonkeyPatch, columns: str
) -> None:
    monkeypatch.delenv("COLUMNS")
    if columns:
        monkeypatch.setenv("COLUMNS", columns)
    width = "from rich.console import Console; atexit.register(lambda: print(Console().width))"
    done = palpate("--version", first=f"import atexit; {width}")
    assert done.stdout.splitlines()[-1] == (columns or WIDE)
