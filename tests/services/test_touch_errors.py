"""Errors of a record by true force, and the picture that shows them with a touch."""

from __future__ import annotations

import dataclasses
import errno
import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus.topics import TOPICS, sensor_key
from palpate.errors import DatasetError, RecordingError
from palpate.files.record import read_record
from palpate.files.record_writer import RecordWriter
from palpate.messages import (
    ElectrodeFrame,
    ErrorBounds,
    FeatureEstimate,
    IndenterPoseFrame,
    Stamp,
    WrenchFrame,
)
from palpate_services.viewer.timeline import SensorTimeline, line_of_action
from palpate_services.viewer.touch_errors import bins_of, read_touches
from palpate_services.viewer.truth import MatchedMessages

bundles: Any = importlib.import_module("field_bundles")

Frames = Callable[..., ElectrodeFrame]

PLACE = np.array([-0.004, 0.0, -0.007])
MS = 1_000_000


@dataclasses.dataclass(frozen=True)
class Press:
    """A press straight up with a true force [N], and how far its estimate is off [N], [m]."""

    force_n: float
    error_n: float
    away_m: float = 1e-3
    touches: bool | None = True


def wrench_of(stamp: Stamp, force: Any, at: Any = PLACE) -> WrenchFrame:
    """A force that acts at a point."""
    force = np.asarray(force, np.float32)
    return WrenchFrame(stamp, "FT", force, np.cross(at, force).astype(np.float32))


def messages_of(stamp: Stamp, press: Press) -> tuple[Any, Any, Any]:
    force = np.array([0.0, 0.0, press.force_n], np.float32)
    place = (PLACE + np.array([press.away_m, 0.0, 0.0])).astype(np.float32)
    sd = np.full(3, 0.1, np.float32)
    guess = (force + np.array([0.0, 0.0, press.error_n])).astype(np.float32)
    return (
        wrench_of(stamp, force),
        IndenterPoseFrame(stamp, "sphere", PLACE, np.array([1.0, 0, 0, 0]), press.touches),
        FeatureEstimate(stamp, "BT", bytes(32), 5, True, guess, sd, place, sd),
    )


@pytest.fixture
def stamp(make_frame: Frames) -> Stamp:
    return make_frame(1, monotonic_ns=10**12).stamp


def matched(stamp: Stamp, presses: Sequence[Press]) -> list[MatchedMessages]:
    return [MatchedMessages(*messages_of(stamp, press)) for press in presses]


def test_how_often_bounds_hold_is_told_by_force(stamp: Stamp) -> None:
    bounds = [0.5, 0.2, 0.5, None]
    presses = [Press(3.0, 0.4), Press(3.0, 0.4), Press(0.7, 0.1), Press(3.0, 9.0)]
    rows = matched(stamp, presses)
    for row, bound in zip(rows, bounds, strict=True):
        assert row.estimate is not None
        given = None if bound is None else ErrorBounds(0.9, force=bound)
        row.estimate = dataclasses.replace(row.estimate, bounds=given)
    bins = bins_of(rows)
    assert bins[0].frames == 4
    assert bins[0].held_share == pytest.approx(2 / 3)  # that without a bound does not count
    by_name = {each.name: each.held_share for each in bins}
    assert by_name["2 to 8 N"] == pytest.approx(1 / 2)
    assert by_name["0.5 to 1 N"] == 1.0
    assert by_name["1 to 2 N"] is None


def test_a_view_draws_bounds_beside_the_errors(stamp: Stamp) -> None:
    timeline = SensorTimeline()
    _, _, estimate = messages_of(stamp, Press(3.0, 0.4))
    timeline.add(dataclasses.replace(estimate, bounds=ErrorBounds(0.9, 0.3, 0.5, 0.002)))
    timeline.add(dataclasses.replace(estimate, bounds=ErrorBounds(0.9, force=7.0)))
    timeline.add(estimate)
    rows = timeline.take()
    assert [row.values.tolist() for row in rows["error/force/bound"]] == [[0.5], [7.0]]
    places = np.concatenate([row.values for row in rows["error/location_mm/bound"]])
    np.testing.assert_allclose(places, [2.0, np.nan])


def test_touched_frames_do_not_drown_in_untouched_ones(stamp: Stamp) -> None:
    untouched = [Press(0.0, 0.01, touches=False)] * 90
    touched = [Press(3.0, 0.3, 2e-3), Press(3.0, 0.4, 3e-3), Press(3.0, 0.5, 4e-3)]
    bins = bins_of(matched(stamp, [*untouched, *touched]))
    assert bins[0].frames == bins[0].located == 3
    assert bins[0].force_median_n == pytest.approx(0.4, rel=1e-5)
    assert bins[0].location_median_m == pytest.approx(3e-3, rel=1e-4)
    assert bins[-1].frames == 93
    assert bins[-1].force_median_n == pytest.approx(0.01, rel=1e-4)
    assert bins[-1].located == 3  # nothing touches the others


def test_each_range_has_its_lower_end_and_not_its_upper_one(stamp: Stamp) -> None:
    forces = (0.0, 0.49, 0.5, 0.99, 1.0, 1.5, 2.0, 7.9, 8.0, 30.0)
    bins = bins_of(matched(stamp, [Press(force, 0.1) for force in forces]))
    counts = {each.name: each.frames for each in bins}
    assert counts == {
        ">= 0.5 N": 8,
        "0.5 to 1 N": 2,
        "1 to 2 N": 2,
        "2 to 8 N": 2,
        ">= 8 N": 2,
        "all frames": 10,
    }
    assert next(iter(counts)) == ">= 0.5 N"


def test_where_nothing_is_known_there_is_no_number(stamp: Stamp) -> None:
    (_, pose, estimate) = messages_of(stamp, Press(3.0, 0.1))
    without_truth = bins_of([MatchedMessages(None, pose, estimate)])
    assert {each.frames for each in without_truth} == {0}
    assert without_truth[0].force_median_n is None
    away = bins_of(matched(stamp, [Press(3.0, 0.1, touches=False)]))
    assert (away[0].frames, away[0].located, away[0].location_median_m) == (1, 0, None)


def test_where_a_robot_cannot_know_a_touch_the_true_force_says_it(stamp: Stamp) -> None:
    robot = [Press(3.0, 0.1, touches=None), Press(0.0, 0.1, touches=None)]
    bins = bins_of(matched(stamp, robot))
    assert bins[0].location_median_m == pytest.approx(1e-3, rel=1e-4)
    assert (bins[-1].frames, bins[-1].located) == (2, 1)


def record_of(path: Path, stamp: Stamp, presses: Sequence[Press], *, fields: bool = True) -> Path:
    """A record with an estimate every 10 ms, and fields: true ones at 0, 20, 40 ms and so on."""
    with RecordWriter(path, {}) as writer:

        def write(name: str, message: Any) -> None:
            codec, key = TOPICS[name].codec, sensor_key("lab", "finger", name)
            writer.write(key, codec.schema, codec.encode(message), log_time_ns=stamp.wall_ns)

        for at, press in enumerate(presses):
            now = dataclasses.replace(
                stamp, sequence=1 + at, monotonic_ns=stamp.monotonic_ns + 10 * MS * at
            )
            messages = messages_of(now, press)
            for name, message in zip(("wrench", "pose", "features"), messages, strict=True):
                write(name, message)
            if fields:
                write("field", bundles.guess(now, depth_m=1e-4 * at))
            if fields and at % 2 == 0:
                write("field_truth", bundles.truth(now, depth_m=1e-4 * at))
    return path


def test_the_touch_with_the_median_error_is_shown_with_its_fields(
    stamp: Stamp, tmp_path: Path
) -> None:
    from palpate_services.inference.repository import MeshLibrary
    from palpate_services.viewer.touch_picture import typical_touch

    presses = [Press(0.0, 0.2), Press(1.0, 0.9), Press(1.0, 0.1), Press(1.0, 0.3), Press(0.0, 0.3)]
    record = record_of(tmp_path / "a.mcap", stamp, presses)
    mine = str(bundles.write(tmp_path / "mine", "field"))
    touches = read_touches(record)
    touch = typical_touch(record, touches, MeshLibrary([mine]))
    assert touch is not None
    assert touch.time_ns == stamp.monotonic_ns + 30 * MS
    np.testing.assert_allclose(touch.estimate, bundles.pressed(3e-4), atol=1e-9)
    # Halfway between the true fields of 20 and 40 ms.
    assert touch.truth is not None
    np.testing.assert_allclose(touch.truth, bundles.pressed(3e-4), atol=1e-9)
    assert typical_touch(record, touches, MeshLibrary()) is None  # nobody knows this mesh


def test_invalid_messages_are_left_out_and_told(
    stamp: Stamp, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    from palpate_services.inference.repository import MeshLibrary
    from palpate_services.viewer.touch_picture import typical_touch

    whole = record_of(tmp_path / "a.mcap", stamp, [Press(1.0, 0.1)] * 4)
    damaged = tmp_path / "b.mcap"
    with RecordWriter(damaged) as writer:
        for name in ("wrench", "pose", "features", "field", "field_truth"):
            key = sensor_key("lab", "finger", name)
            writer.write(key, TOPICS[name].codec.schema, b"\xff\xff", log_time_ns=1)
        for item in read_record(whole):
            writer.write(item.key, item.schema, item.payload, log_time_ns=item.log_time_ns)
    mine = str(bundles.write(tmp_path / "mine", "field"))
    touches = read_touches(damaged)
    assert touches.errors() == read_touches(whole).errors()
    assert "b.mcap: 4 messages break the contract" in caplog.text, "all but the true field"
    assert typical_touch(damaged, touches, MeshLibrary([mine])) is not None


@pytest.mark.parametrize("fields", [True, False])
def test_the_picture_is_drawn_and_not_of_one_colour(
    stamp: Stamp, tmp_path: Path, fields: bool
) -> None:
    image = pytest.importorskip("matplotlib.image")
    from palpate_services.viewer.plot import plot_record

    presses = [Press(0.0, 0.0), *[Press(float(at), 0.1) for at in range(1, 9)], Press(0.0, 0.0)]
    record = record_of(tmp_path / "a.mcap", stamp, presses, fields=fields)
    mine = str(bundles.write(tmp_path / "mine", "field"))
    errors = plot_record(record, tmp_path / "a.png", bundles=[mine])
    assert (errors.sensor, errors.estimates, errors.touched.frames) == ("finger", 10, 8)
    assert errors.as_json()["bins"][">= 0.5 N"]["force_median_n"] == pytest.approx(0.1, rel=1e-4)
    pixels = image.imread(tmp_path / "a.png")[..., :3]
    assert pixels.mean() > 0.7  # white paper
    coloured = np.ptp(pixels, axis=2) > 0.25
    # Of the upper half, the skin is 5 % at least; without fields nothing there has a colour.
    share = coloured[: len(pixels) // 3].mean()
    assert share > 0.05 if fields else share < 0.01
    assert coloured[len(pixels) // 2 :].mean() > 0.002  # curves


def test_a_full_disk_leaves_the_picture_that_was_there(
    stamp: Stamp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = pytest.importorskip("matplotlib.figure")
    from palpate_services.viewer.plot import plot_record

    record = record_of(tmp_path / "a.mcap", stamp, [Press(float(at), 0.1) for at in range(4)])
    picture = tmp_path / "a.png"
    picture.write_bytes(b"a good one")

    def half(_: object, file: Path, **__: object) -> None:
        Path(file).write_bytes(b"a go")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(figure.Figure, "savefig", half)
    with pytest.raises(DatasetError, match="No space left"):
        plot_record(record, picture)
    assert picture.read_bytes() == b"a good one"
    assert sorted(tmp_path.iterdir()) == [record, picture]


def test_a_record_without_estimates_is_refused(stamp: Stamp, tmp_path: Path) -> None:
    from palpate_services.viewer.plot import plot_record

    record = record_of(tmp_path / "b.mcap", stamp, [Press(1.0, 0.1)])
    with pytest.raises(RecordingError, match="holds no estimates of the sensor 'thumb'"):
        plot_record(record, tmp_path / "b.png", sensor="thumb")
    assert not (tmp_path / "b.png").exists()


def test_a_wrench_tells_its_line_of_action(stamp: Stamp) -> None:
    line = line_of_action(wrench_of(stamp, [0.5, 0.0, 2.0]))
    assert line is not None
    through, along = line
    away = PLACE - through
    np.testing.assert_allclose(away - (away @ along) * along, 0.0, atol=1e-8)
    assert line_of_action(wrench_of(stamp, [0.0, 0.0, 0.05])) is None
    only_force = dataclasses.replace(
        wrench_of(stamp, [0.0, 0.0, 2.0]), torque=np.zeros(3, np.float32)
    )
    assert line_of_action(only_force) is None


def test_a_force_meets_the_skin_that_it_presses_on(stamp: Stamp) -> None:
    from palpate_services.viewer.touch_picture import where_it_acts

    mesh = bundles.skin()
    below = mesh.nodes[mesh.nodes[:, 2].argmin()].astype(np.float64)
    found = where_it_acts(
        wrench_of(stamp, [0.0, 0.0, 2.0], below + np.array([0, 0, 0.3])),
        mesh.nodes,
        mesh.outer_faces,
    )
    assert found is not None
    np.testing.assert_allclose(found, below, atol=1e-6)


def test_the_true_arrow_is_on_the_line_of_its_force(stamp: Stamp) -> None:
    """The tip of a wide indenter may be far from what it touches."""
    _, pose, _ = messages_of(stamp, Press(1.0, 0.0))
    timeline = SensorTimeline()
    timeline.add(wrench_of(stamp, [0.0, 0.0, 1.0], PLACE - (0.005, 0.0, 0.0)))
    timeline.add(pose)
    (row,) = timeline.take()["arrow/truth"]
    np.testing.assert_allclose(row.at, PLACE - (0.005, 0.0, 0.0), atol=1e-7)


def test_location_errors_are_drawn_in_millimetres(stamp: Stamp) -> None:
    timeline = SensorTimeline()
    for message in messages_of(stamp, Press(1.0, 0.0, away_m=2e-3)):
        timeline.add(message)
    assert [float(row.values[0]) for row in timeline.take()["error/location_mm"]] == [
        pytest.approx(2.0, rel=1e-4)
    ]
