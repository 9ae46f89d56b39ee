"""Recordings -> data sets: axes, tares, alignment by time, presses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import ELECTRODES, POSE, TARE, WRENCH, Topic, sensor_key
from palpate.errors import DatasetError, RecordingError
from palpate.files.record import read_record
from palpate.files.record_writer import RecordWriter
from palpate.messages import (
    ElectrodeFrame,
    IndenterPoseFrame,
    Origin,
    SensorType,
    Stamp,
    Tare,
    WrenchFrame,
)
from palpate_training.datasets.ingest import (
    PRESS_N,
    TOUCH_N,
    ingest_lasa,
    ingest_record,
    number_presses,
)

PERIOD_NS = 10_000_000


@pytest.fixture
def lasa_archive(tmp_path: Path) -> Path:
    """An invented archive with the keys of the real one."""
    rng = np.random.default_rng(0)
    arrays: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = {}
    for finger, rows in ((1, 100), (2, 120)):
        arrays[f"finger{finger}_electrodes_raw"] = rng.integers(
            2000, 3000, (rows, 19), dtype=np.uint16
        )
        arrays[f"finger{finger}_baseline_mean"] = np.full(19, 2500 + finger, dtype=np.float32)
        arrays[f"finger{finger}_force_N"] = np.tile(
            np.array([0.1, 0.2, -3.0], dtype=np.float32), (rows, 1)
        )
    path = tmp_path / "force_calibration.npz"
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


def test_lasa(lasa_archive: Path) -> None:
    data = ingest_lasa(lasa_archive, command="test", lag_rows=0)
    assert len(data) == 220
    # lateral, distal, ventral -> distal, lateral, dorsal: pressed from below, pushed upwards
    np.testing.assert_allclose(data.force, np.tile([0.2, 0.1, 3.0], (220, 1)), rtol=1e-6)
    np.testing.assert_array_equal(data.baseline[[0, -1], 0], [2501, 2502])
    np.testing.assert_array_equal(np.bincount(data.sensor), [100, 120])
    assert len(np.unique(data.block)) == 40
    assert "do not redistribute" in data.provenance.licence
    assert len(data.provenance.input_sha256) == 64


def test_lasa_pairs_electrodes_with_the_force_before(lasa_archive: Path) -> None:
    stored = ingest_lasa(lasa_archive, lag_rows=0)
    paired = ingest_lasa(lasa_archive, lag_rows=2)
    assert len(paired) == len(stored) - 4
    np.testing.assert_array_equal(paired.electrodes[:98], stored.electrodes[2:100])
    np.testing.assert_array_equal(paired.electrodes[98:], stored.electrodes[102:])
    np.testing.assert_array_equal(np.bincount(paired.sensor), [98, 118])
    assert "2 rows before" in paired.provenance.notes


def test_lasa_takes_whatever_fingers_an_archive_holds(lasa_archive: Path, tmp_path: Path) -> None:
    arrays = dict(np.load(lasa_archive))
    others = {key.replace("finger1", "finger12"): value for key, value in arrays.items()}
    np.savez(tmp_path / "others.npz", **others)
    assert ingest_lasa(tmp_path / "others.npz").sensor_names == ("lasa-finger2", "lasa-finger12")
    one = ingest_lasa(tmp_path / "others.npz", fingers=(12,), lag_rows=0)
    assert one.sensor_names == ("lasa-finger12",)
    np.testing.assert_array_equal(one.electrodes, arrays["finger1_electrodes_raw"])
    with pytest.raises(DatasetError, match="has no finger 1; it has 2, 12"):
        ingest_lasa(tmp_path / "others.npz", fingers=(1, 2))
    with pytest.raises(DatasetError, match="named twice: 12, 12"):
        ingest_lasa(tmp_path / "others.npz", fingers=(12, 12))


@pytest.mark.parametrize("rows", [0, 21])
def test_lasa_refuses_arrays_that_do_not_fit(lasa_archive: Path, tmp_path: Path, rows: int) -> None:
    arrays = dict(np.load(lasa_archive))
    arrays["finger2_force_N"] = arrays["finger2_force_N"][:rows]
    np.savez(tmp_path / "cut.npz", **arrays)
    with pytest.raises(DatasetError, match="arrays of finger 2 have shapes"):
        ingest_lasa(tmp_path / "cut.npz")
    arrays["finger2_electrodes_raw"] = arrays["finger2_electrodes_raw"][:rows]
    np.savez(tmp_path / "short.npz", **arrays)
    with pytest.raises(DatasetError, match=f"finger 2 has {rows} rows, too few"):
        ingest_lasa(tmp_path / "short.npz")


def test_lasa_names_what_is_missing(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(DatasetError, match="holds no finger; it has: x"):
        ingest_lasa(tmp_path / "other.npz")
    (tmp_path / "text.npz").write_text("not an archive")
    with pytest.raises(DatasetError, match="not a readable NumPy archive"):
        ingest_lasa(tmp_path / "text.npz")


def stamp(sequence: int, *, offset_ns: int = 0) -> Stamp:
    time_ns = 1_000_000_000 + sequence * PERIOD_NS + offset_ns
    return Stamp(sequence, sequence, time_ns, 10**18 + time_ns, 7, Origin.SIMULATED)


def tare(tare_id: int, level: float) -> Tare:
    return Tare(
        tare_id=tare_id,
        stamp=stamp(1),
        sensor_serial="s1",
        electrodes=np.full(19, level, dtype=np.float32),
        electrodes_sd=np.ones(19, dtype=np.float32),
        pdc=2000.0,
        pac=2000.0,
        tac=2000.0,
        tdc=2000.0,
        frames_averaged=10,
    )


def frame(sequence: int, tare_id: int = 1) -> ElectrodeFrame:
    return ElectrodeFrame(
        stamp=stamp(sequence),
        sensor_serial="s1",
        sensor_type=SensorType.BIOTAC,
        electrodes=np.full(19, 2000 + sequence, dtype=np.uint16),
        pdc=2000,
        pac=np.full(22, 2000, dtype=np.uint16),
        tac=2000,
        tdc=2000,
        validity=(1 << SensorType.BIOTAC.layout.slots) - 1,
        slot_period_ns=227_000,
        tare_id=tare_id,
    )


def wrench(sequence: int, offset_ns: int = 0) -> WrenchFrame:
    """Force grows by 1 N a frame, so that its time can be read off."""
    at = stamp(sequence, offset_ns=offset_ns)
    force = np.array([0, 0, sequence + offset_ns / PERIOD_NS], dtype=np.float32)
    return WrenchFrame(at, "ft", force, np.zeros(3, dtype=np.float32))


def pose(sequence: int, *, touches: bool) -> IndenterPoseFrame:
    position = np.array([0.001 * sequence, 0, -0.008])
    return IndenterPoseFrame(
        stamp(sequence), "sphere_3-5mm", position, np.array([1.0, 0, 0, 0]), in_contact=touches
    )


class Record:
    """Writes messages of one sensor to a record."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.messages: list[tuple[Topic, str, object]] = []  # type: ignore[type-arg]

    def add(self, topic: Topic, *messages: object, of: str = "finger") -> Record:  # type: ignore[type-arg]
        self.messages += [(topic, of, message) for message in messages]
        return self

    def write(self) -> Path:
        with RecordWriter(self.path) as writer:
            for i, (topic, sensor, message) in enumerate(self.messages):
                writer.write(
                    sensor_key("lab", sensor, topic.name),
                    topic.codec.schema,
                    topic.codec.encode(message),
                    log_time_ns=i,
                )
        return self.path


@pytest.fixture
def record(tmp_path: Path) -> Record:
    return Record(tmp_path / "r.mcap")


def test_record_aligns_and_numbers_presses(record: Record) -> None:
    touches = [20 <= i < 40 or 60 <= i < 80 for i in range(100)]
    record.add(TARE, tare(1, 2000.0))
    record.add(ELECTRODES, *(frame(i + 1) for i in range(100)))
    wrenches = [wrench(i + 1, offset_ns=-4_000_000) for i in range(101)]
    # 1 mN a frame: nothing that would contradict the poses
    record.add(WRENCH, *(replace(one, force=1e-3 * one.force) for one in wrenches))
    record.add(POSE, *(pose(i + 1, touches=touches[i]) for i in range(100)))
    data = ingest_record(record.write())
    assert len(data) == 100
    # wrenches come 4 ms before the frames: the value between two of them is the frame's own
    np.testing.assert_allclose(data.force[:, 2], 1e-3 * np.arange(1, 101), atol=1e-7)
    np.testing.assert_allclose(data.tared_counts[:, 0], np.arange(1, 101))
    assert data.in_contact is not None
    assert data.contact_location is not None
    np.testing.assert_array_equal(data.in_contact, touches)
    assert np.isnan(data.contact_location[~data.in_contact]).all()
    np.testing.assert_allclose(data.contact_location[30], [0.031, 0, -0.008], atol=1e-6)
    assert "left out" not in data.provenance.notes
    np.testing.assert_array_equal(np.unique(data.group), [0, 1])
    assert data.group[49] == 0
    assert data.group[50] == 1
    assert data.sensor_names == ("finger",)


def test_where_a_robot_cannot_know_whether_it_touches_the_force_says_so(record: Record) -> None:
    record.add(TARE, tare(1, 2000.0))
    record.add(ELECTRODES, *(frame(i + 1) for i in range(100)))
    pressing = [20 <= i < 40 or 60 <= i < 80 for i in range(100)]
    wrenches = [replace(wrench(i + 1), force=np.zeros(3, np.float32)) for i in range(100)]
    pressed = np.array([0.1, 0.0, 0.5], np.float32)
    record.add(
        WRENCH,
        *(replace(w, force=pressed) if on else w for w, on in zip(wrenches, pressing, strict=True)),
    )
    poses = [replace(pose(i + 1, touches=False), in_contact=None) for i in range(100)]
    record.add(POSE, *poses)
    data = ingest_record(record.write())
    assert data.contact_location is not None
    np.testing.assert_array_equal(data.in_contact, pressing)
    np.testing.assert_array_equal(np.isnan(data.contact_location[:, 0]), ~np.array(pressing))
    np.testing.assert_array_equal(np.unique(data.group), [0, 1])


def test_a_finger_without_poses_takes_no_location_in_silence(record: Record) -> None:
    for name in ("finger", "thumb"):
        record.add(TARE, tare(1, 2000.0), of=name)
        record.add(ELECTRODES, *(frame(i + 1) for i in range(20)), of=name)
        record.add(WRENCH, *(wrench(i + 1) for i in range(20)), of=name)
    record.add(POSE, *(pose(i + 1, touches=True) for i in range(20)))
    data = ingest_record(record.write())
    assert data.contact_location is None
    assert "no contact locations, because thumb has no pose" in data.provenance.notes


def test_record_drops_what_cannot_be_used_and_tells(
    record: Record, caplog: pytest.LogCaptureFixture
) -> None:
    record.add(TARE, tare(1, 2000.0), tare(2, 1990.0))
    record.add(ELECTRODES, frame(6, tare_id=0))  # before any tare
    record.add(ELECTRODES, replace(frame(1), validity=1))  # bad channels
    record.add(ELECTRODES, frame(2), frame(3, tare_id=2), frame(4, tare_id=9))  # 9: unknown
    record.add(ELECTRODES, frame(50))  # no wrench near
    record.add(WRENCH, *(wrench(i) for i in range(1, 7)))
    data = ingest_record(record.write())
    np.testing.assert_array_equal(data.electrodes[:, 0], [2002, 2003])
    np.testing.assert_array_equal(data.tared_counts[:, 0], [2, 13])
    assert data.contact_location is None
    assert data.in_contact is not None, "without poses, contact is a force above a threshold"
    told = (
        "4 of 6 frames of finger left out: 3 not valid or with no tare in the record, 1 with no"
        " force within three periods"
    )
    assert told in data.provenance.notes
    assert told in caplog.text


def test_no_frame_of_a_biotac_sp_is_left_out_in_silence(record: Record) -> None:
    sp = replace(
        frame(2),
        sensor_type=SensorType.BIOTAC_SP,
        electrodes=np.full(24, 2000, np.uint16),
        pac=np.full(27, 2000, np.uint16),
    )
    record.add(TARE, tare(1, 2000.0)).add(ELECTRODES, frame(1), sp, frame(3))
    record.add(WRENCH, wrench(1), wrench(2), wrench(3))
    with pytest.raises(DatasetError, match="1 of 3 frames of 'finger' are of a BIOTAC_SP with 24"):
        ingest_record(record.write())


def test_record_lacks_something(record: Record, tmp_path: Path) -> None:
    record.add(TARE, tare(1, 2000.0)).add(ELECTRODES, frame(1))
    with pytest.raises(DatasetError, match="no wrench stream"):
        ingest_record(record.write())
    no_tare = Record(tmp_path / "no_tare.mcap").add(ELECTRODES, frame(1, 0)).add(WRENCH, wrench(1))
    with pytest.raises(DatasetError, match="tare before recording"):
        ingest_record(no_tare.write())
    far = Record(tmp_path / "far.mcap").add(TARE, tare(1, 2000.0)).add(ELECTRODES, frame(9))
    with pytest.raises(DatasetError, match="within"):
        ingest_record(far.add(WRENCH, wrench(1)).write())
    only_wrench = Record(tmp_path / "only.mcap").add(WRENCH, wrench(1))
    with pytest.raises(DatasetError, match="no electrode frames"):
        ingest_record(only_wrench.write())


def test_messages_that_break_the_contract_are_left_out_and_told(
    record: Record, caplog: pytest.LogCaptureFixture
) -> None:
    record.add(TARE, tare(1, 2000.0)).add(ELECTRODES, *(frame(i) for i in range(1, 51)))
    record.add(WRENCH, *(wrench(i) for i in range(1, 51)))
    record.add(POSE, *(pose(i, touches=True) for i in range(1, 51)))
    path = record.write()
    whole = ingest_record(path)
    spoilt = path.with_name("spoilt.mcap")
    with RecordWriter(spoilt) as writer:
        for topic in (TARE, ELECTRODES, WRENCH, POSE):
            key = sensor_key("lab", "finger", topic.name)
            writer.write(key, topic.codec.schema, b"no message", log_time_ns=0)
        for item in read_record(path):
            writer.write(item.key, item.schema, item.payload, log_time_ns=item.log_time_ns)
    with caplog.at_level("WARNING"):
        data = ingest_record(spoilt)
    np.testing.assert_array_equal(data.force, whole.force)
    np.testing.assert_array_equal(data.tared_counts, whole.tared_counts)
    assert "4 messages break the contract and are left out" in caplog.text


def test_a_truncated_record_is_named(record: Record) -> None:
    record.add(TARE, tare(1, 2000.0)).add(ELECTRODES, *(frame(i) for i in range(1, 51)))
    path = record.write()
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(RecordingError):
        ingest_record(path)


def _later(message: Any, *, back_ns: int = 0, clock_id: int = 7, session_id: int = 0) -> Any:
    """The message by a monotonic clock that goes back."""
    old = message.stamp
    new = replace(
        old, monotonic_ns=old.monotonic_ns - back_ns, clock_id=clock_id, session_id=session_id
    )
    return replace(message, stamp=new)


def _record_twice(record: Record, **later: int) -> Path:
    """100 frames and wrenches, the latter half as ``_later`` has them."""
    record.add(TARE, tare(1, 2000.0))
    for topic, make in ((ELECTRODES, frame), (WRENCH, wrench)):
        record.add(topic, *(make(i) for i in range(1, 51)))
        record.add(topic, *(_later(make(i), **later) for i in range(51, 101)))
    return record.write()


def test_a_host_that_was_started_again_mixes_no_times(record: Record) -> None:
    """Its monotonic clock began anew, so that times of before and after overlap."""
    data = ingest_record(_record_twice(record, back_ns=30 * PERIOD_NS - 3_000_000, clock_id=8))
    np.testing.assert_array_equal(data.electrodes[:, 0], np.arange(2001, 2101))
    # A simulated frame is computed for its stamp, and so each force is that of its own frame.
    np.testing.assert_allclose(data.force[:, 2], np.arange(1, 101), atol=1e-4)


@pytest.mark.parametrize("session_id", [0, 5])
def test_a_clock_that_goes_back_is_refused(record: Record, session_id: int) -> None:
    path = _record_twice(record, back_ns=20 * PERIOD_NS, session_id=session_id)
    with pytest.raises(DatasetError, match=r"monotonic clock of the electrodes .* back by 0.19 s"):
        ingest_record(path)


def test_a_frame_that_was_overtaken_is_put_in_its_place(record: Record) -> None:
    record.add(TARE, tare(1, 2000.0))
    record.add(ELECTRODES, *(frame(i) for i in (1, 2, 4, 3, 5)))
    record.add(WRENCH, *(wrench(i) for i in range(1, 7)))
    data = ingest_record(record.write())
    np.testing.assert_array_equal(data.electrodes[:, 0], [2001, 2002, 2003, 2004, 2005])


def test_presses_end_halfway() -> None:
    touching = np.array([0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 1], dtype=np.bool_)
    for one, presses in (
        (touching, [0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2]),
        (np.zeros(4, np.bool_), [0, 0, 0, 0]),
        (np.ones(4, np.bool_), [0, 0, 0, 0]),
    ):
        np.testing.assert_array_equal(number_presses(one, one), presses)


@pytest.mark.parametrize(
    ("touching", "presses"),
    [
        ("X..x...X", "00001111"),  # as without it
        ("X.xxx..X", "00000111"),  # not cut in two
        ("X..xxx.X", "00011111"),
        ("x.X.....Xx.x", "000001111111"),
        ("x..x", "0000"),
    ],
)
def test_a_touch_that_presses_nothing_joins_the_nearer_press(touching: str, presses: str) -> None:
    rows = np.array(list(touching))
    found = number_presses(rows != ".", rows == "X")
    assert "".join(map(str, found)) == presses


def test_noise_of_the_force_sensor_makes_no_presses() -> None:
    """Of slow presses that rise through the threshold of a touch, as a KMS 40 measures them."""
    rng = np.random.default_rng(0)
    ramp = np.linspace(0.0, 1.0, 100) ** 2
    press = np.concatenate([np.zeros(200), ramp, np.ones(100), ramp[::-1], np.zeros(200)])
    peaks = rng.uniform(1.0, 8.0, (40, 1))
    force = np.zeros((40 * len(press), 3))
    force[:, 2] = (peaks * press).ravel()
    force += rng.normal(0.0, (0.04, 0.04, 0.06), force.shape)
    strength = np.linalg.norm(force, axis=1)
    found = number_presses(strength > TOUCH_N, strength >= PRESS_N)
    true = np.repeat(np.arange(40), len(press))
    np.testing.assert_array_equal(found[strength >= PRESS_N], true[strength >= PRESS_N])
    assert found.max() == 39


def test_a_contact_that_a_pose_tells_is_a_press_however_light(record: Record) -> None:
    record.add(TARE, tare(1, 2000.0))
    record.add(ELECTRODES, *(frame(i) for i in range(1, 31)))
    record.add(WRENCH, *(replace(wrench(i), force=np.full(3, 0.01, "f4")) for i in range(1, 32)))
    record.add(POSE, *(pose(i, touches=i % 10 < 5) for i in range(1, 32)))
    assert len(np.unique(ingest_record(record.write()).group)) == 4


def presses(*, rest_n: float = 0.0, most_n: float = np.inf) -> list[WrenchFrame]:
    """Two presses of 5 N in 100 readings, of a sensor that clips at ``most_n`` and says so."""
    made = []
    for i in range(1, 101):
        size = min(rest_n + 5.0 * (i % 50 >= 25), most_n)
        force = np.array([0.0, 0.0, size], np.float32)
        made.append(replace(wrench(i), force=force, overload=size == most_n))
    return made


def add_finger(record: Record, name: str, wrenches: list[WrenchFrame], serial: str = "s1") -> None:
    record.add(TARE, tare(1, 2000.0), of=name)
    frames = (replace(frame(i), sensor_serial=serial) for i in range(1, 101))
    record.add(ELECTRODES, *frames, of=name)
    record.add(WRENCH, *wrenches, of=name)


def test_what_an_overloaded_sensor_says_is_no_truth(
    record: Record, caplog: pytest.LogCaptureFixture
) -> None:
    add_finger(record, "finger", presses(most_n=3.0))
    data = ingest_record(record.write())
    # Of 100 rows 50 are pressed.
    assert len(data) == 50
    assert not data.force.any()
    told = "50 rows of finger left out: the force/torque sensor was overloaded"
    assert told in data.provenance.notes
    assert "50 of 100 frames of finger are left out: the force/torque sensor was" in caplog.text
    assert "within three periods" not in caplog.text, "each frame is told once"


def test_between_a_good_reading_and_an_overloaded_one_the_force_is_unknown(record: Record) -> None:
    record.add(TARE, tare(1, 2000.0)).add(ELECTRODES, *(frame(i) for i in range(1, 11)))
    wrenches = [wrench(i, offset_ns=-4_000_000) for i in range(1, 12)]
    wrenches[5] = replace(wrenches[5], overload=True)  # between frames 5 and 6
    data = ingest_record(record.add(WRENCH, *wrenches).write())
    np.testing.assert_array_equal(data.electrodes[:, 0] - 2000, [1, 2, 3, 4, 7, 8, 9, 10])


def test_a_record_of_overload_alone_is_not_blamed_on_clocks(record: Record) -> None:
    add_finger(record, "finger", presses(rest_n=3.0, most_n=3.0))
    with pytest.raises(
        DatasetError, match="100 in which the force/torque sensor was overl"
    ) as told:
        ingest_record(record.write())
    assert told.value.remedy == "press more gently"


def test_two_fingers_are_not_taken_for_one(record: Record) -> None:
    record.add(TARE, tare(1, 2000.0))
    frames = [frame(i) for i in range(1, 11)]
    record.add(ELECTRODES, *frames[:3], *(replace(f, sensor_serial="s2") for f in frames[3:]))
    record.add(WRENCH, *(wrench(i) for i in range(1, 11)))
    with pytest.raises(DatasetError, match=r"'finger' is 2 fingers, .*: s1, s2") as told:
        ingest_record(record.write())
    assert "a record of its own of each finger" in told.value.remedy


def test_serial_numbers_are_kept_with_the_rows(record: Record) -> None:
    add_finger(record, "finger", presses(), serial="BT-1")
    add_finger(record, "thumb", presses(), serial="BT-2")
    notes = ingest_record(record.write()).provenance.notes
    assert "serial number of finger: BT-1" in notes
    assert "serial number of thumb: BT-2" in notes


def test_fingers_of_a_record_can_be_chosen(record: Record) -> None:
    """One that has no force/torque sensor does not hold up the others."""
    for name, wrenches in (("index", presses()), ("little", []), ("thumb", presses())):
        add_finger(record, name, wrenches)
    path = record.write()
    with pytest.raises(DatasetError, match="'little' has no wrench stream") as told:
        ingest_record(path)
    assert "palpate data ingest-record --sensor index --sensor thumb" in told.value.remedy
    assert ingest_record(path, sensors=["thumb", "index"]).sensor_names == ("index", "thumb")
    with pytest.raises(DatasetError, match="no sensor 'ring'") as told:
        ingest_record(path, sensors=["index", "ring"])
    assert told.value.remedy == "it holds: index, little, thumb"


def test_a_force_where_a_pose_knows_of_no_contact_is_refused(record: Record) -> None:
    """The force/torque sensor was not zeroed; or the pose is wrong."""
    add_finger(record, "finger", presses(rest_n=1.5))
    record.add(POSE, *(pose(i, touches=i % 50 >= 25) for i in range(1, 101)))
    with pytest.raises(
        DatasetError, match=r"force on 'finger' is 1\.50 N in the 50 frames"
    ) as told:
        ingest_record(record.write())
    assert "palpate tare NAME" in told.value.remedy


def test_a_force_that_never_ends_is_told(record: Record, caplog: pytest.LogCaptureFixture) -> None:
    """A finger may be touched all the time; but most often the sensor was not zeroed."""
    add_finger(record, "finger", presses(rest_n=1.5))
    data = ingest_record(record.write())
    assert "the force on finger is never below 1.50 N" in data.provenance.notes
    assert "the force/torque sensor was not zeroed" in caplog.text


def test_readings_that_share_a_stamp_are_aligned(record: Record) -> None:
    """As where three arrive in one packet, every 20 ms."""
    record.add(TARE, tare(1, 2000.0)).add(ELECTRODES, *(frame(i) for i in range(1, 21)))
    record.add(WRENCH, *(wrench(i) for i in range(1, 23, 2) for _ in range(3)))
    data = ingest_record(record.write())
    np.testing.assert_allclose(data.force[:, 2], np.arange(1, 21), atol=1e-4)
