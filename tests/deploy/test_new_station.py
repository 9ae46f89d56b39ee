"""``palpate new-station``: what it asks, what it writes, and what it refuses to write."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from palpate.errors import (
    ConfigError,
    ErrorCode,
    LinkError,
    PalpateError,
    RemoteError,
    StreamTimeout,
)
from palpate.messages import ModelInventory, QualityFlag, ServedModel
from palpate_deploy.cli.app import app
from palpate_deploy.station import first_hour, new_station
from palpate_deploy.station import tare as tare_module
from palpate_deploy.station.profile import load_profile
from palpate_gateway.emulators.biotac_can import BiotacCanEmulator
from palpate_gateway.emulators.kms40 import Kms40Emulator
from palpate_gateway.emulators.robot import RobotEmulator, above_the_pad

PATIENCE_S = 60.0
NEW_STATION = [sys.executable, "-m", "palpate_deploy", "new-station"]
VIRTUAL = "virtual model=formula seed=3"
OK, USAGE, DEVICE = 0, 2, 3


@pytest.fixture(autouse=True)
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to make a station in; a short look at each device."""
    folder = tmp_path / "lab"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(new_station, "_PROBE_S", 0.3)
    return folder


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Say what this host has: channels of socketcan, and serial ports."""

    def has(*, can: Sequence[str] = (), ports: Sequence[str] = ()) -> None:
        buses = [{"interface": "socketcan", "channel": name, "more": ""} for name in can]
        lines = [{"by_id": "", "port": name, "what": ""} for name in ports]
        monkeypatch.setattr(new_station, "can_buses", lambda: buses)
        monkeypatch.setattr(new_station, "serial_ports", lambda: lines)

    return has


def run(*words: str) -> Any:
    """The command without a terminal."""
    return CliRunner().invoke(app, ["new-station", *words])


def on_can(port: int, more: str = "") -> str:
    where = f"interface=udp_multicast channel=239.74.163.2 bus_options.port={port}"
    return f"biotac_can {where} fingers=1 {more}".strip()


def test_what_is_written_is_a_profile_of_what_was_probed(lab: Path) -> None:
    with Kms40Emulator() as emulator:
        host, _, port = emulator.address.rpartition(":")
        wrench = f"wrench_kms40 host={host} port={port} mount.carries=indenter"
        done = run("--name", "left", "--biotac", VIRTUAL, "--wrench", wrench)
    assert done.exit_code == OK, done.output
    path = lab / "left.toml"
    assert list(lab.iterdir()) == [path]
    profile = load_profile(path)
    assert profile.station == "left"
    finger, wrench_sensor = profile.gateway.sensors
    assert (finger.name, finger.driver) == ("finger", "virtual")
    assert (finger.options["model"], finger.options["seed"]) == ("formula", 3)
    assert (wrench_sensor.driver, wrench_sensor.of) == ("wrench_kms40", "finger")
    assert wrench_sensor.options["mount"] == {"carries": "indenter"}
    text = path.read_text(encoding="utf-8")
    assert "serial number 310042" in text, "what the device said of itself stands beside it"
    assert text.count("#") > 5
    kept = profile.recorder
    assert f"after {kept.keep_bytes / 2**30:g} GiB or {kept.keep_s / 86400:g} days" in text
    assert "palpate up --profile left.toml" in done.output
    assert "palpate tare wrench --station left" in done.output


def test_the_mount_is_written_out_where_none_is_given(lab: Path) -> None:
    with Kms40Emulator() as emulator:
        host, _, port = emulator.address.rpartition(":")
        run("--biotac", VIRTUAL, "--wrench", f"wrench_kms40 host={host} port={port}")
    (_, wrench) = load_profile(lab / "lab.toml").gateway.sensors
    assert wrench.options["mount"]["orientation_wxyz"] == [1, 0, 0, 0]


POSE = (
    "pose_zenoh robot=arm indenter=sphere_7mm "
    "base_sensor.position_m=[0,0,0] base_sensor.orientation_wxyz=[1,0,0,0] "
    "flange_indenter.position_m=[0,0,0.1] flange_indenter.orientation_wxyz=[1,0,0,0]"
)


def test_a_robot_on_the_stations_own_bus_is_written_unseen(lab: Path) -> None:
    """Its poses come over a router that does not run yet."""
    done = run("--biotac", VIRTUAL, "--pose", POSE)
    assert done.exit_code == OK, done.output
    assert "it is seen once that runs" in done.output
    (_, pose) = load_profile(lab / "lab.toml").gateway.sensors
    assert (pose.name, pose.driver, pose.of) == ("indenter", "pose_zenoh", "finger")
    assert pose.options["flange_indenter"]["position_m"] == [0, 0, 0.1]


def test_a_robot_on_a_bus_of_its_own_is_probed(lab: Path, new_port: Callable[[], int]) -> None:
    with RobotEmulator(above_the_pad) as robot:
        done = run("--biotac", VIRTUAL, "--pose", f"{POSE} connect={robot.address}")
    assert done.exit_code == OK, done.output
    assert "sphere_7mm, contact not known" in done.output
    (lab / "lab.toml").unlink()
    done = run("--biotac", VIRTUAL, "--pose", f"{POSE} connect=tcp/127.0.0.1:{new_port()}")
    assert done.exit_code == DEVICE, done.output
    assert not list(lab.iterdir())


class TestNothingIsWritten:
    def test_without_any_device(self, lab: Path, host: Callable[..., None]) -> None:
        host()
        done = run("--yes")
        assert done.exit_code == USAGE
        assert "no CAN interface" in done.output
        assert "ip link set can0" in done.output
        assert not list(lab.iterdir())

    def test_where_a_serial_port_could_be_anything(
        self, lab: Path, host: Callable[..., None]
    ) -> None:
        host(ports=["/dev/ttyACM3"])
        done = run("--yes")
        assert done.exit_code == USAGE
        assert "biotac_bridge line=/dev/ttyACM3" in done.output
        assert not list(lab.iterdir())

    def test_where_two_could_be_meant(self, lab: Path, host: Callable[..., None]) -> None:
        host(can=["can0", "can1"])
        done = run("--yes")
        assert done.exit_code == USAGE
        assert "can0, socketcan can1" in done.output
        assert "--biotac 'biotac_can channel=can0'" in done.output
        assert not list(lab.iterdir())

    def test_of_a_silent_device_unless_it_is_wanted_anyway(
        self, lab: Path, new_port: Callable[[], int]
    ) -> None:
        words = ("--biotac", on_can(new_port()))
        done = run(*words)
        assert done.exit_code == DEVICE
        assert "BioTac: no answer as it should be, so nothing is written" in done.output
        assert "check power, wiring and bit rate" in done.output
        assert not list(lab.iterdir())
        done = run(*words, "--anyway")
        assert done.exit_code == OK, done.output
        assert "# Not as it should be:" in (lab / "lab.toml").read_text(encoding="utf-8")

    def test_of_one_silent_device_beside_a_sound_one(
        self, lab: Path, new_port: Callable[[], int]
    ) -> None:
        done = run(
            "--biotac", VIRTUAL, "--wrench", f"wrench_kms40 host=127.0.0.1 port={new_port()}"
        )
        assert done.exit_code == DEVICE
        assert "force/torque sensor: no answer" in done.output
        assert not list(lab.iterdir())

    def test_of_a_device_in_the_wrong_place(self, lab: Path) -> None:
        with Kms40Emulator() as emulator:
            host, _, port = emulator.address.rpartition(":")
            done = run("--biotac", f"wrench_kms40 host={host} port={port}")
        assert done.exit_code == DEVICE
        assert "gives no electrodes, but wrench" in done.output
        assert not list(lab.iterdir())

    @pytest.mark.parametrize(
        ("fault", "said"),
        [("dead", "range: E5"), ("saturated", "range: E5"), ("invalid", "not valid: E5")],
    )
    def test_of_implausible_counts(self, lab: Path, fault: str, said: str) -> None:
        faults = f"""faults='[{{ kind = "{fault}", at_s = 0, electrode = 5 }}]'"""
        done = run("--biotac", f"{VIRTUAL} {faults}")
        assert done.exit_code == DEVICE
        assert said in done.output
        assert not list(lab.iterdir())

    def test_of_a_rate_that_is_another(self, lab: Path, new_port: Callable[[], int]) -> None:
        """The finger's frames come at 100 Hz, and the options say half of it; a slow one may."""
        options = {"port": new_port()}
        half = on_can(options["port"], "slot_rate_hz=2200")
        with BiotacCanEmulator("udp_multicast", "239.74.163.2", fingers=1, options=options):
            done = run("--biotac", half)
        assert done.exit_code == DEVICE
        assert "slots come each second, not 2200" in done.output
        assert not list(lab.iterdir())
        slow = BiotacCanEmulator(
            "udp_multicast", "239.74.163.2", fingers=1, slot_rate_hz=2200, options=options
        )
        with slow:
            done = run("--biotac", half)
        assert done.exit_code == OK, done.output

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            ("biotac_cna channel=can0", "did you mean 'biotac_can'?"),
            ("biotac_can chanel=can0", "did you mean 'channel'"),
            ("biotac_can can0", "is not KEY=VALUE"),
            ("", "names no device"),
            ("'", "names no device"),
        ],
    )
    def test_of_words_that_name_no_device(self, lab: Path, words: str, said: str) -> None:
        done = run("--biotac", words)
        assert done.exit_code == USAGE
        assert said in done.output
        assert not list(lab.iterdir())

    @pytest.mark.parametrize("variable", ["", '["tcp/127.0.0.1:7449"]'])
    @pytest.mark.parametrize(
        ("listen", "said"),
        [
            ("nonsense", "is not tcp/HOST:PORT"),
            ("tcp/0.0.0.0:7448", "without mutual TLS"),
            ("tcp/127.0.0.1:0", "no port that others could know"),
        ],
    )
    def test_of_an_address_that_no_router_would_take(
        self, lab: Path, monkeypatch: pytest.MonkeyPatch, variable: str, listen: str, said: str
    ) -> None:
        """The profile outlives a variable that would hide what it says."""
        if variable:
            monkeypatch.setenv("PALPATE_ROUTER__LISTEN", variable)
        done = run("--biotac", VIRTUAL, "--listen", listen)
        assert done.exit_code == USAGE
        assert said in done.output
        assert "is read for" not in done.output, "it is refused before any device is tried"
        assert not list(lab.iterdir())

    @pytest.mark.parametrize("serial", ["ünï çode", "x" * 65, "a\nb"])
    def test_of_a_serial_number_that_would_be_changed(self, lab: Path, serial: str) -> None:
        done = run("--biotac", VIRTUAL, "--serial", serial)
        assert done.exit_code == USAGE
        assert "serial" in done.output
        assert not list(lab.iterdir())

    def test_where_there_is_no_folder(self, lab: Path) -> None:
        done = run("--biotac", VIRTUAL, "--out", "nowhere/lab.toml")
        assert done.exit_code == USAGE
        assert "there is no folder nowhere" in done.output

    def test_by_a_name_that_no_command_would_take(self, lab: Path) -> None:
        done = run("--biotac", VIRTUAL, "--out", "mine")
        assert done.exit_code == USAGE
        assert "--out mine.toml" in done.output
        assert not list(lab.iterdir())

    def test_by_a_disk_that_is_full(self, lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(*_: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "link", full)
        done = run("--biotac", VIRTUAL)
        assert done.exit_code == USAGE
        assert "No space left" in done.output
        assert not list(lab.iterdir())


class TestAProfileThatIsThere:
    def test_stays_and_is_gone_on_with(self, lab: Path) -> None:
        words = ("--biotac", VIRTUAL)
        assert run(*words).exit_code == OK
        path = lab / "lab.toml"
        by_hand = path.read_text(encoding="utf-8").replace('out = "runs"', 'out = "mine"')
        path.write_text(by_hand, encoding="utf-8")
        for again in (words, ()):
            done = run(*again)
            assert done.exit_code == OK, done.output
            assert "it stays as it is" in done.output
        assert path.read_text(encoding="utf-8") == by_hand

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            (("--biotac", "virtual model=formula seed=4"), "'finger' with seed = 3"),
            (("--biotac", "biotac_can channel=can0"), "'finger' with driver 'virtual'"),
            (("--wrench", "wrench_kms40 host=10.0.0.7"), "no sensor 'wrench'"),
            (("--name", "right", "--out", "lab.toml"), "station 'lab'"),
            (("--biotac", VIRTUAL, "--serial", "BT02"), "'finger' with serial = None"),
            (("--serial", "BT02"), "'finger' with serial = None"),
            (("--listen", "tcp/127.0.0.1:7448"), "a router that listens at tcp/127.0.0.1:7447"),
        ],
    )
    def test_of_other_devices_is_not_written_over(
        self, lab: Path, words: tuple[str, ...], said: str
    ) -> None:
        assert run("--biotac", VIRTUAL).exit_code == OK
        before = (lab / "lab.toml").read_bytes()
        done = run(*words)
        assert done.exit_code == USAGE
        assert said in done.output
        assert (lab / "lab.toml").read_bytes() == before

    def test_is_compared_as_it_is_written(self, lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        listen = ("--listen", "tcp/127.0.0.1:7448", "--serial", "BT02")
        assert run("--biotac", VIRTUAL, *listen).exit_code == OK
        monkeypatch.setenv("PALPATE_ROUTER__LISTEN", '["tcp/127.0.0.1:7449"]')
        assert run(*listen).exit_code == OK
        assert run("--listen", "tcp/127.0.0.1:7449").exit_code == USAGE

    def test_that_appears_meanwhile_is_not_written_over(self, lab: Path) -> None:
        path = lab / "lab.toml"
        path.write_text("somebody else's", encoding="utf-8")
        with pytest.raises(ConfigError, match="is there already"):
            new_station.write_new(path, "mine")
        assert path.read_text(encoding="utf-8") == "somebody else's"
        assert list(lab.iterdir()) == [path]


class TestQuestions:
    def test_nobody_can_be_asked(self, lab: Path) -> None:
        """An open pipe that says nothing must not be waited for, either."""
        process = subprocess.Popen(
            NEW_STATION,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            assert process.wait(PATIENCE_S) == USAGE
        finally:
            process.kill()
            said, _ = process.communicate()
        assert "standard input is no terminal" in said
        assert "--biotac 'biotac_can channel=can0'" in said
        assert not list(lab.iterdir())

    def test_answers_make_a_profile(self, lab: Path) -> None:
        """The words of probe for the finger, no force/torque sensor, no robot."""
        said, status = answered(b"99\n", b"0\n", f"{VIRTUAL}\n".encode(), b"\n", b"\n")
        assert status == OK, said
        assert "A number from 1 to" in said
        assert "Which force/torque sensor?" in said
        (finger,) = load_profile(lab / "lab.toml").gateway.sensors
        assert finger.options == {"model": "formula", "seed": 3}

    def test_choices_are_what_the_host_has(
        self, lab: Path, host: Callable[..., None], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        host(can=["can7", "can8"], ports=["/dev/ttyACM3"])
        terminal = SimpleNamespace(stdin=SimpleNamespace(isatty=lambda: True))
        monkeypatch.setattr(new_station, "sys", terminal)
        finger, wrench, pose, serial = "2\n1\n", "6\n127.0.0.1\n", "1\n", "BT09\n"
        answers = finger + wrench + pose + serial
        done = CliRunner().invoke(app, ["new-station", "--anyway"], input=answers)
        assert done.exit_code == OK, done.output
        assert "3  behind our bridge: /dev/ttyACM3" in done.output
        (biotac, force) = load_profile(lab / "lab.toml").gateway.sensors
        assert biotac.driver == "biotac_can"
        assert biotac.options == {"channel": "can8", "port": 1, "serial": "BT09"}
        assert (force.driver, force.options["host"]) == ("wrench_kms40", "127.0.0.1")

    def test_ctrl_c_leaves_nothing(self, lab: Path) -> None:
        said, status = answered(b"\x03")
        assert status not in (OK, None), said
        assert "Traceback" not in said
        assert not list(lab.iterdir())


def answered(*answers: bytes) -> tuple[str, int | None]:
    """Run the command in a terminal, and type; ``0`` stands for the last choice of a question."""
    pid, terminal = pty.fork()
    if pid == 0:
        # A test run in the background ignores it, and a test before this one may have blocked it.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        os.execv(NEW_STATION[0], NEW_STATION)
    said, left, answered_to = b"", list(answers), 0
    while True:
        if not select.select([terminal], [], [], PATIENCE_S)[0]:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            pytest.fail(f"it waits for ever after: {said.decode()}")
        try:
            said += os.read(terminal, 1024)
        except OSError:  # it has ended
            break
        # A question ends in ": " and waits.
        if left and said[answered_to:].endswith(b": "):
            answer = left.pop(0)
            if answer == b"\x03":
                # Python loses a signal between the prompt and its first look at the keyboard.
                time.sleep(0.5)
            if answer == b"0\n":
                numbers = [line.split()[0] for line in said.splitlines() if line[:2] == b"  "]
                answer = numbers[-1] + b"\n"
            answered_to = len(said) + len(answer)
            os.write(terminal, answer)
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return said.decode(), status


@pytest.fixture
def emulated(new_port: Callable[[], int]) -> Any:
    port = new_port()
    with BiotacCanEmulator("udp_multicast", "239.74.163.2", fingers=1, options={"port": port}):
        yield on_can(port)


@pytest.mark.slow
def test_without_a_force_sensor_it_says_so_and_all_ends_with_it(
    emulated: str,
    lab: Path,
    new_port: Callable[[], int],
    bundle: str,
    process_ids: Callable[[Path], dict[str, int]],
    wait_until: Callable[[Callable[[], bool], float, str], float],
) -> None:
    words = ["--biotac", emulated, "--listen", f"tcp/127.0.0.1:{new_port()}", "--look-s", "0.5"]
    with open(lab / "said", "wb") as output:
        process = subprocess.Popen(
            [*NEW_STATION, *words, "--start"],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        wait_until(
            lambda: b"Ctrl-C stops it" in (lab / "said").read_bytes() or process.poll() is not None,
            PATIENCE_S,
            "the station runs",
        )
        said = (lab / "said").read_text(encoding="utf-8")
        assert "not calibrated: no force/torque sensor" in said, said
        runs = Path(os.environ["XDG_STATE_HOME"])
        assert {"gateway", "features", "supervisord"} <= process_ids(runs).keys()
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    wait_until(lambda: not process_ids(runs), PATIENCE_S, "every process of the station ended")


def test_a_narrow_terminal_shows_every_stream_and_value() -> None:
    """Only the last column folds; before, the others had no room at all at 80 columns."""
    seen = first_hour._Seen(MagicMock())
    seen.counts["features"] = 1000
    said = "+1.00 -2.00 +3.00 N, how far off is not known, by features-twin:12, UNCALIBRATED"
    seen.texts["features"] = said
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(seen.table(10.0))
    shown = console.export_text()
    assert "…" not in shown
    assert {"electrodes", "wrench", "pose", "features", "100", *said.split()} <= set(shown.split())


@pytest.mark.parametrize(
    ("flags", "calibrated"), [((), True), ((QualityFlag.UNCALIBRATED,), False)]
)
def test_only_a_bundle_that_was_made_for_this_finger_keeps_it_from_being_calibrated(
    lab: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flags: tuple[QualityFlag, ...],
    calibrated: bool,
) -> None:
    """The station remembers the bundle of a finger that was exchanged since."""
    run("--biotac", VIRTUAL)
    own = ServedModel("finger", "features-bt-a", 1, bytes(32), 0)
    estimate = SimpleNamespace(message=SimpleNamespace(quality=flags))
    session = MagicMock()
    session.subscriber().__enter__().next.return_value = estimate
    tare = SimpleNamespace(sensor_serial="BT-B", frames_averaged=9, electrodes_sd=np.ones(19))
    stubs: dict[str, Any] = {
        "_running": lambda *_: contextlib.nullcontext(),
        "join": lambda *_, **__: contextlib.nullcontext(session),
        "tare_at_rest": lambda *_, **__: tare,
        "look": MagicMock(),
        "read_token": MagicMock(),
        "ModelAdmin": lambda *_: MagicMock(
            served=lambda _: [ModelInventory("features", [own], ())]
        ),
        "_tell_estimate": MagicMock(),
        "calibrate_finger": MagicMock(),
    }
    for name, stub in stubs.items():
        monkeypatch.setattr(first_hour, name, stub)
    first_hour.walk(first_hour.WalkOrder(lab / "lab.toml", 6, 0.0, lab))
    assert stubs["calibrate_finger"].called is not calibrated
    said = capsys.readouterr().out
    assert ("calibrated already: features-bt-a:1" in said) is calibrated
    assert ("features-bt-a:1 was not made for this finger, BT-B" in said) is not calibrated


class TestZero:
    """The force/torque sensor is zeroed again if the finger was touched while it was."""

    @pytest.fixture
    def tare(self) -> Any:
        return SimpleNamespace(electrodes=np.full(19, 3000.0), electrodes_sd=np.ones(19))

    @pytest.fixture
    def bench(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[float]], Any]:
        """A finger with these counts during one zero after the other; untouched in between."""

        def make(counts: list[float]) -> Any:
            seen: list[Any] = []
            stream = MagicMock()
            stream.__enter__.return_value = stream
            stream.next.side_effect = lambda _: frame(3000.0)
            stream.next_batch.side_effect = lambda _, most: seen
            zeros = iter(counts)

            def zero(*_: object, **__: object) -> Any:
                seen[:] = [frame(3000.0), frame(next(zeros))]
                return SimpleNamespace(monotonic_ns=time.monotonic_ns())

            monkeypatch.setattr(first_hour, "ask_zero", zero)
            session = SimpleNamespace(subscriber=lambda *_, **__: stream)
            return session, lambda: len(list(zeros))

        def frame(count: float) -> Any:
            now_ns = time.monotonic_ns()
            message = SimpleNamespace(
                electrodes=np.full(19, count), stamp=SimpleNamespace(monotonic_ns=now_ns)
            )
            return SimpleNamespace(message=message)

        return make

    def test_untouched(self, tare: Any, bench: Callable[[list[float]], Any]) -> None:
        session, left = bench([3010.0, 3010.0])
        first_hour.zero_wrench(session, tare)
        assert left() == 1

    def test_touched_meanwhile(self, tare: Any, bench: Callable[[list[float]], Any]) -> None:
        session, left = bench([2900.0, 3100.0, 3010.0])
        first_hour.zero_wrench(session, tare)
        assert left() == 0

    def test_never_let_go(
        self, tare: Any, bench: Callable[[list[float]], Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(first_hour, "LET_GO_S", 0.2)
        session, _ = bench([2900.0] * 100_000)
        with pytest.raises(StreamTimeout, match="was touched for"):
            first_hour.zero_wrench(session, tare)


@pytest.mark.parametrize(
    "refusal",
    [
        LinkError("no service answers", remedy="start the service"),
        StreamTimeout("no answer in time", remedy="it hangs"),
        RemoteError("cannot tare it: E6 varies", remedy="let go", code=ErrorCode.DEVICE),
    ],
)
def test_a_finger_that_is_not_tared_yet_is_asked_again(
    monkeypatch: pytest.MonkeyPatch, refusal: PalpateError
) -> None:
    """It may be touched just then, and a gateway may be unknown yet, or hang."""
    asked: list[str] = []
    tare = MagicMock()
    said = Console(file=io.StringIO(), record=True)

    def ask(*_: object, **__: object) -> object:
        asked.append("")
        if len(asked) < 3:
            raise refusal
        return tare

    def tare_at_rest() -> object:
        return tare_module.tare_at_rest(
            MagicMock(), "finger", threading.Event(), again_s=0.0, console=said
        )

    monkeypatch.setattr(tare_module, "ask_tare", ask)
    assert tare_at_rest() is tare
    assert said.export_text() == f"not yet: {refusal.problem}; trying for 60 s\n", "once"
    monkeypatch.setattr(tare_module, "LET_GO_S", 0.0)
    asked.clear()
    with pytest.raises(type(refusal)):
        tare_at_rest()
