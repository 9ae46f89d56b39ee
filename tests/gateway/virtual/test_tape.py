"""The twin: what is played is the tape, in time, with its truth, and the same every time."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.gateway.pipelines import pushed

from palpate.errors import ConfigError, DatasetError
from palpate.files.tape import Tape, read_tape
from palpate.messages import Tare
from palpate_gateway.clock.stamps import DueMessage, FileClock
from palpate_gateway.drivers import make_device
from palpate_gateway.readings import (
    ElectrodeReading,
    FieldReading,
    PoseReading,
    Reading,
    WrenchReading,
)
from palpate_gateway.service.pipeline import Pipeline
from palpate_gateway.virtual import tape as virtual_tape
from palpate_gateway.virtual.tape import between, order, poses

fakes: Any = importlib.import_module("tape_fakes")

Write = Callable[..., Path]

FIELD_M = 2e-9
"""Float32 of the coefficients, decoded, against the tape's own decoding."""


def play(path: Path, **options: Any) -> list[Reading]:
    readings: list[Reading] = []
    with make_device("virtual", {"tape": str(path), "realtime": False, **options}) as device:
        while got := device.read(1.0):
            readings += got
    return readings


def of(kind: type[Any], readings: list[Reading]) -> list[Any]:
    return [reading for reading in readings if isinstance(reading, kind)]


@pytest.fixture
def quiet(tape_path: Write) -> Path:
    """A tape whose units add nothing."""
    return tape_path(**fakes.QUIET)


def steps_of(tape: Tape, readings: list[Reading]) -> Any:
    """Place among the steps of the touched trajectory, by the indenter's travel, shape (N,)."""
    one = next(t for t in tape.trajectories if t.id == fakes.IDS[2])
    tip = np.array([r.position for r in of(PoseReading, readings)])
    travel = (tip - one.poses[0, :3]) @ np.array([0.0, 0.0, 1.0])
    return travel / 3e-3 * (fakes.STEPS - 1)


def test_truth_and_counts_are_the_tapes_at_every_instant(quiet: Path) -> None:
    tape = read_tape(quiet)
    readings = play(quiet, episodes=1, trajectories=[fakes.IDS[2]], unit=2, field_rate_hz=100)
    step = steps_of(tape, readings)
    assert step.max() == pytest.approx(5.0, abs=1e-9)  # it is pressed to the end
    step = np.clip(step, 0.0, 5.0)
    one = tape.trajectories[2]
    lower = np.minimum(step.astype(int), 4)
    share = step - lower

    def straight(values: Any) -> Any:
        weights = share.reshape(-1, *[1] * (values.ndim - 1))
        return values[lower] * (1 - weights) + values[lower + 1] * weights

    wrench = of(WrenchReading, readings)
    np.testing.assert_allclose([r.force for r in wrench], straight(one.force), atol=1e-5)
    np.testing.assert_allclose([r.torque for r in wrench], straight(one.torque), atol=1e-7)
    frames = of(ElectrodeReading, readings)
    np.testing.assert_array_less(
        np.abs([r.electrodes.astype(float) for r in frames] - straight(one.counts[1])), 0.51
    )
    pdc = 2000.0 + straight(one.fluid_pressure_pa) / 36.5
    assert np.abs([r.pdc for r in frames] - pdc).max() < 3.0  # rounding and noise of sd 0.5
    true = np.array([tape.displacement(c.astype(np.float32)) for c in straight(one.coefficients)])
    np.testing.assert_allclose(
        [r.displacement for r in of(FieldReading, readings)], true, atol=FIELD_M
    )


def test_the_hold_is_the_last_step_exactly(quiet: Path) -> None:
    tape = read_tape(quiet)
    readings = play(quiet, episodes=1, trajectories=[fakes.IDS[1]], field_rate_hz=100)
    one = tape.trajectories[1]
    pose = of(PoseReading, readings)
    deepest = [k for k, r in enumerate(pose) if np.array_equal(r.position, one.poses[-1, :3])]
    assert len(deepest) >= 19  # 0.2 s at least
    assert deepest == list(range(deepest[0], deepest[-1] + 1))
    for k in deepest:
        assert np.array_equal(of(WrenchReading, readings)[k].force, one.force[-1])
        assert np.allclose(pose[k].orientation, one.poses[-1, 3:], atol=1e-12)
        field = of(FieldReading, readings)[k].displacement
        np.testing.assert_allclose(field, tape.displacement(one.coefficients[-1]), atol=FIELD_M)
    assert np.linalg.norm(tape.displacement(one.coefficients[-1]), axis=1).max() > 1e-4


def test_it_comes_from_3_mm_along_the_pressing_direction_and_goes_back(quiet: Path) -> None:
    one = read_tape(quiet).trajectories[1]
    readings = play(quiet, episodes=1, trajectories=[one.id], seed=2)
    pose = of(PoseReading, readings)
    away = np.array([r.position for r in pose]) - one.poses[0, :3]
    direction = np.array([0.5, 0.0, np.sqrt(0.75)])
    along = away @ direction
    assert np.allclose(away - along[:, None] * direction, 0.0, atol=1e-12)
    assert along[0] == pytest.approx(-3e-3)
    assert along[-1] < -2.9e-3
    down = np.argmax(along)
    assert (np.diff(along[: down + 1]) >= -1e-12).all()
    assert np.abs(np.diff(along)).max() < 0.5e-3  # no jump
    touching = np.array([r.in_contact for r in pose])
    force = np.array([r.force for r in of(WrenchReading, readings)])
    assert np.array_equal(touching, force.any(axis=1))
    assert np.array_equal(touching, along > 1e-12)


def test_electrodes_force_and_field_move_together(tape_path: Write) -> None:
    readings = play(tape_path(), episodes=3, field_rate_hz=100)
    force = np.linalg.norm([r.force for r in of(WrenchReading, readings)], axis=1)
    electrodes = np.array([r.electrodes.astype(float) for r in of(ElectrodeReading, readings)])
    fall = electrodes[:100].mean(axis=0)[-1] - electrodes[:, -1]
    moved = np.array(
        [np.linalg.norm(r.displacement, axis=1).max() for r in of(FieldReading, readings)]
    )
    untouched = force == 0.0
    assert (moved[untouched] == 0.0).all()
    assert (moved[~untouched] > 0.0).all()
    assert fall[untouched].max() < 25.0  # noise, creep
    assert fall[force > 2.0].min() > 100.0
    assert np.corrcoef(force, fall)[0, 1] > 0.9


def test_same_options_same_readings_at_any_block_size(
    tape_path: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tape_path()
    whole = [repr(r) for r in play(path, seed=4, frames=400)]
    assert whole == [repr(r) for r in play(path, seed=4, frames=400)]
    for size in (1, 7, 1000):
        monkeypatch.setattr(virtual_tape, "BLOCK_FRAMES", size)
        assert whole == [repr(r) for r in play(path, seed=4, frames=400)]
    assert whole != [repr(r) for r in play(path, seed=5, frames=400)]


def test_starts_untouched_so_that_a_tare_succeeds(tape_path: Write) -> None:
    path = tape_path()
    for rate_hz in (100.0, 10.0):
        with make_device(
            "virtual", {"tape": str(path), "realtime": False, "rate_hz": rate_hz, "frames": 60}
        ) as device:
            pipeline = Pipeline(device.info)
            pipeline.begin(device.identity, FileClock("x", None))
            out: list[DueMessage] = []
            while got := device.read(1.0):
                out += pushed(pipeline, got, 0)
        (tare,) = [item.message for item in out if isinstance(item.message, Tare)]
        rest = read_tape(path).specimens[0].rest_counts
        # After half an hour the core is 1.4 K short of its end: -3.4 % of conductivity.
        assert np.abs(tare.electrodes - rest).max() < 60
        assert (tare.electrodes_sd < 1.0).all()


def test_units_differ_in_counts_only(quiet: Path) -> None:
    one, two, by_name = (play(quiet, episodes=2, unit=u) for u in (1, 2, "unit2"))
    truth = [repr(r) for r in one if not isinstance(r, ElectrodeReading)]
    assert truth == [repr(r) for r in two if not isinstance(r, ElectrodeReading)]
    assert [repr(r) for r in two] == [repr(r) for r in by_name]
    rest = [of(ElectrodeReading, r)[0].electrodes.astype(int) for r in (one, two)]
    assert (rest[1] - rest[0] == 200).all()


def test_every_trajectory_is_played_once_before_any_is_again(quiet: Path) -> None:
    # The presses are 2 mm apart in x and of different depths, so that the deepest tip names them.
    readings = play(quiet, episodes=6, seed=1)
    tips = np.array([r.position for r in of(PoseReading, readings)])
    ends = {one.id: one.poses[-1, :3] for one in read_tape(quiet).trajectories}
    deepest = {name: (tips == end).all(axis=1) for name, end in ends.items()}
    order_of = [name for k in range(len(tips)) for name in ends if deepest[name][k]]
    played = [name for k, name in enumerate(order_of) if k == 0 or name != order_of[k - 1]]
    assert sorted(played[:3]) == sorted(fakes.IDS)
    assert sorted(played[-3:]) == sorted(fakes.IDS)
    for count, seed in ((3, 1), (5, 0)):
        through = [order(count, seed, number) for number in range(3 * count)]
        for k in range(3):
            assert sorted(through[k * count : (k + 1) * count]) == list(range(count))
    assert len({tuple(order(5, seed, n) for n in range(5)) for seed in range(10)}) > 3


def test_indenter_and_trajectories_are_chosen(quiet: Path) -> None:
    assert {r.indenter for r in of(PoseReading, play(quiet, episodes=5, indenter="cube"))} == {
        "cube"
    }
    balls = play(quiet, episodes=5, indenter="ball")
    assert {r.indenter for r in of(PoseReading, balls)} == {"ball"}


def test_field_rate(quiet: Path) -> None:
    def ticks(**options: Any) -> list[int]:
        return [r.tick for r in of(FieldReading, play(quiet, frames=60, **options))]

    assert ticks() == list(range(0, 60, 5))
    assert ticks(field_rate_hz=0) == []
    assert ticks(rate_hz=10) == list(range(60))
    assert len(ticks(rate_hz=70, field_rate_hz=20)) == 17


def test_quaternions_of_either_sign_make_no_turn() -> None:
    turn = np.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0])
    values = np.zeros((3, 7))
    values[:, 3:] = [turn, -turn, turn]
    _, quaternion = poses(values, np.linspace(0.0, 2.0, 9), np.zeros(9))
    assert np.allclose(quaternion, turn)


def test_between_is_exact_at_the_steps() -> None:
    values = np.random.default_rng(0).normal(size=(7, 3))
    assert np.array_equal(between(values, np.arange(7.0)), values)
    assert np.allclose(between(values, np.array([1.25]))[0], 0.75 * values[1] + 0.25 * values[2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"unit": 3}, "no specimen 3 -> choose a number from 1 to 2 or one of unit1, unit2"),
        ({"unit": 0}, "no specimen 0"),
        ({"unit": "unit9"}, "no specimen 'unit9'"),
        ({"trajectories": ["ball/0/norml"]}, "did you mean 'ball/0/normal'"),
        ({"indenter": "ring"}, "its indenters are ball, cube"),
        ({"trajectories": [fakes.IDS[0]], "indenter": "cube"}, "no such trajectory"),
    ],
)
def test_what_the_tape_has_not(quiet: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_device("virtual", {"tape": str(quiet), **options})


def test_default_is_the_shipped_tape_or_else_the_formula(
    quiet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(virtual_tape, "SHIPPED", tmp_path / "tapes")
    assert make_device("virtual").info.model == "virtual finger, sphere_14mm"
    with pytest.raises(ConfigError, match="no tape ships"):
        make_device("virtual", {"model": "tape"})
    with pytest.raises(ConfigError, match="'trajectories' is of the model 'tape'"):
        make_device("virtual", {"trajectories": ["a"]})
    with pytest.raises(ConfigError, match="'tape' is of the model 'tape'"):
        make_device("virtual", {"model": "formula", "tape": str(quiet)})
    with pytest.raises(ConfigError, match="unit = 'unit1' is not a number"):
        make_device("virtual", {"unit": "unit1"})

    (tmp_path / "tapes").mkdir()
    quiet.rename(tmp_path / "tapes" / "twin.npz")
    for options in ({}, {"model": "tape"}, {"tape": "twin"}):
        model = make_device("virtual", options).info.model
        assert model == "digital twin unit1, 3 presses of twin"
    assert "virtual finger" in make_device("virtual", {"model": "formula"}).info.model
    with pytest.raises(ConfigError, match="no tape 'twn' ships with palpate -> choose one of twin"):
        make_device("virtual", {"tape": "twn"})


def test_a_damaged_or_missing_tape_is_told_when_the_device_is_made(quiet: Path) -> None:
    with pytest.raises(ConfigError, match=r"away\.npz cannot be read"):
        make_device("virtual", {"tape": str(quiet.with_name("away.npz"))})
    quiet.write_bytes(quiet.read_bytes()[:-100])
    with pytest.raises(DatasetError, match=r"small\.npz"):
        make_device("virtual", {"tape": str(quiet)})
