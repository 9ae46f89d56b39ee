"""``palpate calibrate``: from presses at a station to a bundle that serves that finger."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import palpate_training
from palpate.admin import make_token, token_file
from palpate.bus import Delivery, Session
from palpate.bus.topics import ELECTRODES, FEATURES, WRENCH
from palpate.config import LinkConfig
from palpate.errors import (
    BundleError,
    ConfigError,
    DatasetError,
    LinkError,
    RecordingError,
    StreamTimeout,
)
from palpate.files.bundle import read_bundle, write_bundle
from palpate.files.record import read_record
from palpate.files.record_writer import RecordWriter
from palpate.health import Health
from palpate.messages import NO_TARE, QualityFlag, ServiceState
from palpate_deploy.station import calibrate, guided_presses
from palpate_deploy.station.guided_presses import HELD_S, PressCounter
from palpate_services.config import ModelsConfig, RecorderConfig
from palpate_services.inference.repository import resolve
from palpate_training.datasets.experiment import read_mixed
from palpate_training.datasets.export import features
from palpate_training.datasets.features import of_sensor, write_dataset
from palpate_training.tasks import finger

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]

pytest.importorskip("torch")

SAMPLE = Path(palpate_training.__file__).parent / "samples" / "twin.h5"


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--presses", "0"], "name presses of other fingers"),
        (["--presses", "5"], "too few to hold some of them out"),
        (["--presses", "0", "--from", "FILE", "--others", "FILE"], "exclude each other"),
        (["--presses", "50", "--from", "FILE"], "--presses and --from exclude each other"),
        (["--out", "FILE", "--from", "FILE"], "--out and --from exclude each other"),
        (["--from", "FILE", "--others", "FILE"], "a file is named twice"),
        (["--presses", "0", "--others", "FILE", "--others", "FILE"], "a file is named twice"),
        (["--others", "missing.h5"], "missing.h5"),
        (["--presses", "0", "--others", "FILE"], "FILE"),
        (["--out", "FILE"], "FILE: File exists"),
    ],
)
def test_what_contradicts_itself_is_refused(
    palpate: Palpate, tmp_path: Path, options: list[str], problem: str
) -> None:
    """Before anybody presses, and before a station is asked."""
    (tmp_path / "FILE").write_text("no data set")
    paths = [tmp_path / one if one == "FILE" else one for one in options]
    done = palpate("calibrate", *paths, timeout=120)
    assert done.returncode != 0
    assert problem in done.stderr
    assert "Traceback" not in done.stderr


def count(*readings: tuple[float, float]) -> tuple[int, float]:
    counter = PressCounter()
    for now_s, force_n in readings:
        counter.take(now_s, force_n, seen=True)
    return counter.count, counter.largest_n


def test_the_command_wants_as_many_presses_as_the_training() -> None:
    assert calibrate.PRESSES_LEAST == finger.PRESSES_LEAST


class TestPresses:
    def test_a_press_is_counted_when_it_ends(self) -> None:
        counter = PressCounter()
        assert not counter.take(0.0, 0.1, seen=True)
        assert not counter.take(0.1, 2.0, seen=True)
        assert counter.pressed
        assert not counter.take(0.1 + HELD_S, 3.0, seen=False)
        assert not counter.take(0.2 + HELD_S, 0.3, seen=True)
        assert counter.count == 0
        assert counter.take(0.3 + HELD_S, 0.1, seen=True)
        assert (counter.count, counter.largest_n, counter.pressed) == (1, 3.0, False)

    def test_a_knock_does_not_count(self) -> None:
        assert count((0.0, 0.0), (0.1, 5.0), (0.15, 0.0), (1.0, 0.0)) == (0, 5.0)

    def test_a_force_about_the_threshold_is_one_press(self) -> None:
        wavering = [(0.1 * k, 0.45 + 0.1 * (k % 2)) for k in range(20)]
        assert count(*wavering, (2.0, 0.0))[0] == 1

    def test_a_press_without_electrodes_does_not_count(self) -> None:
        """Those that come as it is let go tell nothing of it."""
        counter = PressCounter()
        counter.take(0.0, 2.0, seen=False)
        counter.take(2.0, 0.4, seen=True)
        assert not counter.take(2.1, 0.0, seen=True)
        assert counter.count == 0
        assert not counter.pressed


def test_the_table_says_that_it_counts_what_was_recorded() -> None:
    """A knock, or a press before the tare, is learned from and not counted by the guide."""
    console = Console(width=80, record=True, file=io.StringIO())
    names = ("force_magnitude_median_n", "force_angle_median_rad", "force_magnitude_p95_n")
    metrics = dict.fromkeys((*names, "coverage_90"), 0.5)
    calibrate._show(finger.FingerReport(bytes(32), "line", metrics, 7, 600), "x:1", console)
    assert "7 presses recorded, each held out" in console.export_text()


class Streams:
    """A session whose force presses for a second out of two, ``presses`` times.

    Its force/torque sensor is overloaded at ``overload_n``.
    """

    def __init__(
        self,
        presses: int,
        frames: Callable[[], SimpleNamespace | None],
        overload_n: float = np.inf,
    ) -> None:
        self._presses, self._frames, self._overload_n = presses, frames, overload_n

    @contextlib.contextmanager
    def subscriber(self, topic: object, **_: object) -> Iterator[SimpleNamespace]:
        forces = iter(np.tile(np.repeat([2.0, 0.0], 10), self._presses))
        times_s = itertools.count(step=0.1)

        def wrench() -> SimpleNamespace:
            stamp = SimpleNamespace(monotonic_ns=1e9 * next(times_s))
            force = np.array([0.0, 0.0, next(forces)])
            return SimpleNamespace(force=force, stamp=stamp, overload=force[2] >= self._overload_n)

        make = wrench if topic is WRENCH else self._frames

        def next_batch(_: float) -> list[SimpleNamespace]:
            message = make()
            return [] if message is None else [SimpleNamespace(message=message)]

        yield SimpleNamespace(next_batch=next_batch)


def guide(streams: Streams, presses: int, console: Console | None = None) -> int:
    return guided_presses._guide(
        streams,  # type: ignore[arg-type]
        "finger",
        presses,
        Path("rec"),
        threading.Event(),
        console or Console(quiet=True),
        check=lambda: None,
    )


def test_presses_are_counted_while_electrodes_come() -> None:
    frame = SimpleNamespace(electrodes_valid=True, tare_id=1)
    assert guide(Streams(7, lambda: frame), 7) == 7


def test_an_overload_is_told_while_it_is_pressed() -> None:
    """Once a press, not once a reading."""
    frame = SimpleNamespace(electrodes_valid=True, tare_id=1)
    told = "the force/torque sensor is overloaded: press more gently; such readings are not learned"
    for overload_n, times in ((np.inf, 0), (2.0, 3)):
        said = Console(file=io.StringIO(), width=200)
        assert guide(Streams(3, lambda: frame, overload_n), 3, said) == 3
        assert said.file.getvalue().count(told) == times  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "frame",
    [
        None,
        SimpleNamespace(electrodes_valid=False, tare_id=1),
        SimpleNamespace(electrodes_valid=True, tare_id=NO_TARE),
    ],
)
def test_electrodes_that_stop_end_the_presses(
    frame: SimpleNamespace | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The force alone teaches nothing, and the person is not to blame."""
    monkeypatch.setattr(guided_presses, "_SEEN_S", 0.0)
    with pytest.raises(StreamTimeout, match=r"no valid, tared electrodes of 'finger' .* rec keeps"):
        guide(Streams(7, lambda: frame), 7)


@pytest.mark.parametrize("recorded", [True, False])
def test_too_few_presses_until_ctrl_c_are_not_learned_from(
    recorded: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(config: RecorderConfig, *_: object, **__: object) -> None:
        if recorded:
            config.out.mkdir(parents=True)
            (config.out / "lab-1.mcap").write_text("own")

    def tare(_: object, __: str, interrupted: threading.Event, **___: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupted.wait(60)

    monkeypatch.setattr(Session, "open", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr(guided_presses, "_first", lambda *_: SimpleNamespace(sensor_serial="BT-1"))
    monkeypatch.setattr(guided_presses, "run_recorder", run)
    monkeypatch.setattr(guided_presses, "tare_at_rest", tare)
    said = Console(file=io.StringIO(), record=True)
    with pytest.raises(KeyboardInterrupt):
        guided_presses.record_presses(LinkConfig(), "lab", "finger", 7, tmp_path, said, least=6)
    kept = f"the record is {tmp_path / 'lab-1.mcap'}" if recorded else "nothing is kept"
    assert f"stopped after 0 presses; {kept}" in said.export_text()


def test_the_record_is_that_of_its_own_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another station records to the same folder, and ends later."""

    def run(config: RecorderConfig, *_: object, **__: object) -> None:
        config.out.mkdir(parents=True)
        (config.out / "lab-1.mcap").write_text("own")
        (tmp_path / "lab-2.mcap").write_text("another's")

    monkeypatch.setattr(guided_presses, "run_recorder", run)
    with guided_presses._recording(LinkConfig(), "lab", "finger", tmp_path) as recording:
        pass
    assert recording.path() == tmp_path / "lab-1.mcap"
    assert recording.path().read_text() == "own"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lab-1.mcap", "lab-2.mcap"]


def test_nothing_is_pressed_before_the_recorder_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*args: Any, health: Health, **_: object) -> None:
        time.sleep(0.2)
        health.set_state(ServiceState.READY, "recording")
        args[-1].wait(60)

    monkeypatch.setattr(guided_presses, "run_recorder", run)
    with guided_presses._recording(LinkConfig(), "lab", "finger", tmp_path) as recording:
        assert recording.health.state is ServiceState.READY


def recording_of(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *names: str,
    fails: bool = False,
    stops: bool = True,
) -> guided_presses._Recording:
    """A recording that has ended, whose recorder wrote these files, and failed at the end."""

    def run(config: RecorderConfig, *_: object, health: Health, **__: object) -> None:
        config.out.mkdir(parents=True)
        for name in names:
            (config.out / name).touch()
        if stops:
            health.set_state(ServiceState.STOPPING)
        if fails:
            health.fail(RecordingError("the disk is full", remedy="free some space"))

    monkeypatch.setattr(guided_presses, "run_recorder", run)
    with guided_presses._recording(LinkConfig(), "lab", "finger", folder) as recording:
        pass
    return recording


@pytest.mark.parametrize("stops", [False, True])
def test_a_recorder_that_pauses_ends_the_presses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stops: bool
) -> None:
    """What is pressed while it pauses is lost."""
    recording = recording_of(tmp_path, monkeypatch, "lab-1.mcap", fails=True, stops=stops)
    for look in (recording.check, recording.path):
        with pytest.raises(RecordingError, match="the disk is full") as told:
            look()
        assert "free some space" in told.value.remedy
        assert f"{tmp_path} keeps what was recorded, for --from" in told.value.remedy


def test_presses_of_two_records_are_not_halved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = recording_of(tmp_path, monkeypatch, "lab-1.mcap", "lab-2.mcap")
    with pytest.raises(RecordingError, match=r"paused.*lab-1.mcap, .*lab-2.mcap") as told:
        recording.path()
    assert "--from" in told.value.remedy


def test_nobody_presses_for_a_disk_without_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("palpate_services.recorder.writer.free_bytes", lambda _: 200_000_000)
    with pytest.raises(RecordingError, match="200 MB free, a record needs 268 MB"):
        guided_presses.record_presses(
            LinkConfig(connect=("tcp/127.0.0.1:1",)),
            "lab",
            "finger",
            7,
            tmp_path,
            Console(),
            least=6,
        )


def test_a_signal_after_the_presses_ends_the_learning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]

    def refuse(*_: object, **__: object) -> None:
        raise LinkError("no router", remedy="start it")

    monkeypatch.setattr(Session, "open", refuse)
    with pytest.raises(LinkError):
        guided_presses.record_presses(
            LinkConfig(), "lab", "finger", 7, tmp_path, Console(), least=6
        )
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_record_of_another_finger_is_not_learned_from(
    virtual_record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if the finger had been changed while it was recorded."""
    monkeypatch.setattr(calibrate, "record_presses", lambda *_, **__: (virtual_record, "BT-7"))
    order = calibrate.CalibrationOrder("virtual-finger", 7, tmp_path, None, "", serve=False)
    with pytest.raises(ConfigError, match="'virtual-finger' was BT-7 when it began"):
        calibrate.calibrate_finger(
            LinkConfig(), "lab", order, token=None, profile=None, as_json=True
        )


@pytest.mark.parametrize(
    ("serve", "problem"),
    [(False, r"\[models\] folder: .* is no folder"), (True, "no service 'features' answers")],
)
def test_nobody_presses_for_a_bundle_that_cannot_be_kept_or_served(
    link: LinkConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    serve: bool,
    problem: str,
) -> None:
    if serve:
        make_token(token_file(ModelsConfig().memory_folder, "lab"))
    else:
        (tmp_path / "data").touch()
    monkeypatch.setattr(calibrate, "record_presses", lambda *_, **__: pytest.fail("pressed"))
    order = calibrate.CalibrationOrder("finger", 7, tmp_path / "rec", None, "", serve=serve)
    with pytest.raises((ConfigError, LinkError), match=problem):
        calibrate.calibrate_finger(link, "lab", order, token=None, profile=None, as_json=True)


def test_two_fingers_in_one_record_are_not_learned_from(
    virtual_record: Path, tmp_path: Path
) -> None:
    """The second half is of another one."""
    exchanged = tmp_path / "lab.mcap"
    with RecordWriter(exchanged) as writer:
        for item in read_record(virtual_record):
            payload = item.payload
            if item.address.topic == ELECTRODES.name:
                frame = ELECTRODES.codec.decode(payload)
                if frame.stamp.sequence > 150:
                    frame = replace(frame, sensor_serial="BT-7")
                payload = ELECTRODES.codec.encode(frame)
            writer.write(item.key, item.schema, payload, log_time_ns=item.log_time_ns)
    order = calibrate.CalibrationOrder("virtual-finger", None, None, exchanged, "", serve=False)
    with pytest.raises(DatasetError, match="is 2 fingers, exchanged while it was recorded: BT-7, "):
        calibrate.calibrate_finger(
            LinkConfig(), "lab", order, token=None, profile=None, as_json=True
        )


def test_a_version_that_another_takes_meanwhile_is_left_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One is written while this one learns, and another between its choice and its writing."""
    shipped = resolve("features-virtual")
    first = 1 + int(shipped.name)
    taken = [tmp_path / shipped.parent.name / str(first + more) for more in range(3)]

    def learn(folder: Path) -> finger.FingerReport:
        shutil.copytree(shipped, folder)
        shutil.copytree(shipped, taken[0])
        return finger.FingerReport(b"", "a line", {}, 7, 700)

    def write(folder: Path, **parts: Any) -> bytes:
        if not taken[1].exists():
            shutil.copytree(shipped, taken[1])
        return write_bundle(folder, **parts)

    monkeypatch.setattr(calibrate, "write_bundle", write)
    new, report = calibrate._written(learn, tmp_path)
    assert new.folder == taken[2]
    written = read_bundle(new.folder)
    assert written.manifest.version == new.version == first + 2
    assert written.sha256 == report.digest
    assert written.golden.keys() == read_bundle(shipped).golden.keys()
    (tmp_path / "file").touch()
    taken[0] = tmp_path / "elsewhere"
    with pytest.raises(BundleError, match="cannot write"):
        calibrate._written(learn, tmp_path / "file")


def test_a_data_set_is_of_the_finger_that_is_named(palpate: Palpate, tmp_path: Path) -> None:
    """Of several fingers one is taken; the finger itself is none of the others."""
    two = features(read_mixed(SAMPLE))
    write_dataset(tmp_path / "two.h5", two)
    write_dataset(tmp_path / "one.h5", of_sensor(two, "biotac-2"))
    shutil.copy(tmp_path / "one.h5", tmp_path / "copy.h5")
    one = of_sensor(two, "biotac-2")
    write_dataset(tmp_path / "tared.h5", replace(one, baseline=one.baseline + np.float32(3.0)))
    first: dict[str, Any] = {name: rows[: len(one) // 2] for name, rows in one.arrays().items()}
    write_dataset(tmp_path / "part.h5", replace(one, **first))
    (tmp_path / "lab.mcap.part").write_text("cut off")

    def refused(name: str, source: str, *options: str | Path) -> str:
        done = palpate("calibrate", name, "--from", tmp_path / source, *options, timeout=240)
        assert done.returncode != 0
        assert "Traceback" not in done.stderr
        return " ".join(done.stderr.split())

    for source in ("one.h5", "two.h5"):
        assert "holds no sensor 'nonsense'" in refused("nonsense", source)
    for others in ("copy.h5", "two.h5", "tared.h5", "part.h5"):
        said = refused("biotac-2", "one.h5", "--others", tmp_path / others)
        assert "one.h5, biotac-2, the finger itself, and" in said
        assert f"{others} hold the same presses" in said
    twice = ("--others", tmp_path / "one.h5", "--others", tmp_path / "copy.h5")
    assert "hold the same presses" in refused("biotac-1", "two.h5", *twice)
    assert "palpate recover" in refused("finger", "lab.mcap.part")
    said = refused("biotac-2", "one.h5", "--name", "features-twin")
    assert "features-twin is the name of a bundle that ships" in said
    done = palpate("calibrate", "biotac-2", "--from", tmp_path / "two.h5", "--json", timeout=240)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["bundle"] == "features-biotac-2:1"


@pytest.mark.essential
def test_from_presses_to_estimates(
    up: subprocess.Popen[bytes],
    station: tuple[Path, LinkConfig],
    palpate: Palpate,
    tmp_path: Path,
) -> None:
    """The bundle is served for the finger, and as good as it says on presses that come later."""
    profile, link = station[0], station[1].model_copy(update={"wait_for_router_s": 90.0})
    with Session.open(link, station="test") as session:
        first = session.subscriber(FEATURES, sensor="finger")
        assert QualityFlag.UNCALIBRATED not in first.next(60).message.quality
    other = palpate("calibrate", "thumb", "--profile", profile, timeout=240)
    assert other.returncode != 0
    assert "nothing comes on electrodes of 'thumb'" in other.stderr
    assert "palpate status" in other.stderr
    done = palpate(
        *("calibrate", "finger", "--presses", "16", "--profile", profile),
        *("--out", tmp_path / "rec", "--json"),
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert "press 16 of 16" in done.stderr
    manifest = read_bundle(Path(report["folder"])).manifest
    assert manifest.sensor_serials == tuple(report["serials"])
    assert report["presses"] >= 16
    (record,) = (tmp_path / "rec").glob("*.mcap")
    assert Path(report["source"]) == record

    with Session.open(link, station="test") as session:
        estimates = session.subscriber(FEATURES, sensor="finger", delivery=Delivery.QUEUE)
        forces = session.subscriber(WRENCH, sensor="finger", delivery=Delivery.QUEUE)
        until = time.monotonic() + 25.0
        # Meanwhile: the record that is left is enough to do it again, with no station.
        again = palpate("calibrate", "finger", "--from", record, "--json", timeout=240)
        time.sleep(max(0.0, until - time.monotonic()))
        answers = [one.message for one in estimates.next_batch(20, most=4000)]
        truths = [one.message for one in forces.next_batch(20, most=4000)]
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout)["bundle"] == report["bundle"].replace(":1", ":2")
    for answer in answers:
        assert answer.bundle_sha256.hex() == report["digest"]
        assert QualityFlag.UNCALIBRATED not in answer.quality
    times = [wrench.stamp.monotonic_ns for wrench in truths]
    magnitude = [float(np.linalg.norm(wrench.force)) for wrench in truths]
    # Harder presses than any of the sixteen are flagged; the others are estimated.
    known = [answer for answer in answers if not answer.quality]
    truth = np.interp([answer.source.monotonic_ns for answer in known], times, magnitude)
    errors = np.abs([np.linalg.norm(answer.force) for answer in known] - truth)[truth > 0.5]
    assert len(errors) > 50
    constant = report["metrics"]["constant_force_magnitude_median_n"]
    assert np.median(errors) < 0.5 * constant

    back = palpate("model", "rollback", "--sensor", "finger", "--profile", profile, timeout=240)
    assert back.returncode == 0, back.stderr

    # Another finger's presses make a bundle for a finger that nobody presses.
    others = tmp_path / "others.h5"
    write_dataset(others, features(read_mixed(SAMPLE)))
    unpressed = palpate(
        *("calibrate", "finger", "--presses", "0", "--others", others, "--name", "features-guess"),
        *("--profile", profile),
        timeout=240,
    )
    assert unpressed.returncode == 0, unpressed.stderr
    assert "UNCALIBRATED until it is pressed" in unpressed.stdout
    with Session.open(link, station="test") as session:
        answer = session.subscriber(FEATURES, sensor="finger").next(20).message
    assert QualityFlag.UNCALIBRATED in answer.quality
    assert answer.bounds is not None
    assert answer.bounds.other_sensors
    itself = palpate(
        *("calibrate", "finger", "--presses", "0", "--others", record, "--profile", profile),
        timeout=240,
    )
    assert itself.returncode != 0
    assert f"holds presses of {report['serials'][0]}, the finger itself" in itself.stderr


def test_a_record_without_presses_is_refused(
    palpate: Palpate, virtual_record: Path, tmp_path: Path
) -> None:
    record = tmp_path / "lab.mcap"
    shutil.copy(virtual_record, record)
    short = palpate("calibrate", "virtual-finger", "--from", record, timeout=120)
    assert short.returncode != 0
    assert "presses of at least 0.5 N; 6 are needed" in short.stderr
    other = palpate("calibrate", "thumb", "--from", record, timeout=120)
    assert "holds no sensor 'thumb'" in other.stderr
    assert "it holds: virtual-finger" in other.stderr
    assert not list(tmp_path.glob("data/palpate/models/*"))
