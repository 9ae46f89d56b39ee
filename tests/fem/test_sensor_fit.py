"""A planted sensor is found again from its rest and a few touches; bad recordings are refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError
from palpate.files.hdf5 import rows_sha256
from palpate_fem.cli.app import fem_app
from palpate_fem.config import FingertipParameters
from palpate_fem.electrodes.gap import Gap
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.specimen import SENSING, SpecimenParameters
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.population.explain import ANGLE_SD_RAD, SPREAD, TouchExplainer, TouchPrior
from palpate_fem.population.fitting import deep_states
from palpate_fem.population.members import read_population
from palpate_fem.population.press_library import PressLibrary, read_library
from palpate_fem.population.responses import Population
from palpate_fem.population.sensor_fit import fit_sensor
from palpate_fem.population.touches import (
    DIGESTED,
    FEATURES,
    SensorTouches,
    held,
    read_touches,
    touches_of,
)
from palpate_fem.service.biotac import BiotacTip
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter
from palpate_training.datasets.features import FEATURE_COLUMNS

Floats = NDArray[np.float64]

NOISE_COUNTS = 4.0
PLANTED = SpecimenParameters(
    name="planted",
    sigma_s_m=0.14,
    series_ohm=700.0,
    side_closing_m=0.12e-3,
    clamp_closing=0.3,
    core_offset_m=(0.6e-3, 0.05e-3, -0.4e-3),
    asperity_m=110e-6,
    squeeze_pa=45e3,
    squeeze_exponent=0.7,
)
STEPS_N = (1.0, 3.0, 5.0, 7.0)


@dataclass(frozen=True)
class Bench:
    """A model, a library of dents, and the sensor that is to be found."""

    model: ElectrodeModel
    library: PressLibrary
    touches: SensorTouches
    later: SensorTouches


def dent(model: ElectrodeModel, rest: Gap, place: Floats, force_n: float) -> Gap:
    """The film of a finger that is pressed over a place of the core: closed there, open around."""
    away = np.linalg.norm(model.film.nodes - place, axis=1)
    inside = np.exp(-((away / 3e-3) ** 2)) * min(force_n / 2.5, 1.0)
    bulge = 0.08e-3 * force_n / 5 * (1 - inside)
    return replace(rest, gap=rest.gap * (1 - inside) + bulge, pressure=4e4 * force_n * inside**4)


@pytest.fixture(scope="module")
def bench() -> Bench:
    model = ElectrodeModel(biotac(edge_m=0.8e-3), edge_m=0.9e-3)
    rest = model.finder.measure(model.geometry.mesh.nodes)
    nodes, normals = model.film.nodes, model.film.normals
    rng = np.random.default_rng(4)
    pad = np.flatnonzero((normals[:, 2] < -0.3) & (nodes[:, 0] > -11e-3))
    presses = [nodes[pad[0]]]
    for _ in range(23):  # far from one another
        away = np.linalg.norm(nodes[pad][:, None] - np.array(presses), axis=2).min(axis=1)
        presses.append(nodes[pad[int(np.argmax(away))]])
    order = rng.permutation(len(presses))
    gaps, force, place, number = [], [], [], []
    for j, at in enumerate(presses):
        inwards = -normals[np.argmin(np.linalg.norm(nodes - at, axis=1))]
        for size in STEPS_N:
            gaps.append(dent(model, rest, at, size))
            force.append(size * inwards)
            place.append(at)
            number.append(j)
    library = PressLibrary(rest, gaps, np.array(force), np.array(place), np.array(number, np.int64))
    sensor = model.with_specimen(PLANTED)
    counts, measured = [], []
    for k, j in enumerate(order):
        size = 2.0 + 0.2 * k
        warmth = 0.05 + 0.002 * k
        answer = sensor.of_gap(dent(model, rest, presses[j], size), log_sigma=warmth)
        counts.append(answer.counts + NOISE_COUNTS * rng.standard_normal(SENSING))
        turned = force[4 * j] + 0.1 * rng.standard_normal(3)
        measured.append(size * turned / np.linalg.norm(turned))
    touches = SensorTouches(
        "planted", sensor.of_gap(rest).counts, np.array(counts), np.array(measured)
    )
    return Bench(model, library, touches.some(slice(0, 8)), touches.some(slice(8, 24)))


def explained(bench: Bench, specimen: SpecimenParameters) -> float:
    """Share of the later touches' variance, each electrode told from five others."""
    explainer = TouchExplainer(bench.model.with_specimen(specimen), bench.library)
    prior = explainer.learn(bench.touches).learned
    left = total = 0.0
    away = bench.later.tared - bench.later.tared.mean(axis=0)
    for k in range(4):
        given = np.arange(SENSING) % 4 == k
        told = explainer.explain(bench.later, prior, given=given).tared
        left += float(((told - bench.later.tared)[:, ~given] ** 2).sum())
        total += float((away[:, ~given] ** 2).sum())
    return 1 - left / total


def misses(specimen: SpecimenParameters) -> dict[str, float]:
    """Errors of what touches decide, in standard deviations of the priors."""
    return {
        "ln sigma": abs(np.log(specimen.sigma_s_m / PLANTED.sigma_s_m)) / 0.7,
        "sides": abs(specimen.side_closing_m - PLANTED.side_closing_m) / 0.144e-3,
        "core x": abs(specimen.core_offset_m[0] - PLANTED.core_offset_m[0]) / 0.58e-3,
        "core z": abs(specimen.core_offset_m[2] - PLANTED.core_offset_m[2]) / 0.38e-3,
    }


def test_a_planted_sensor_is_found_and_its_later_touches_are_told(bench: Bench) -> None:
    nominal = SpecimenParameters()
    rest = fit_sensor(bench.model, bench.library, bench.touches.some(slice(0, 0)))
    rounds: list[float] = []
    fit = fit_sensor(
        bench.model, bench.library, bench.touches, on_round=lambda _, spread: rounds.append(spread)
    )
    assert rounds[-1] < min(rounds[0], 4 * NOISE_COUNTS)
    assert fit.learned is not None
    assert fit.learned.warmth == pytest.approx(0.057, abs=0.03)
    for name, before in misses(nominal).items():
        assert misses(fit.specimen)[name] < 0.3 * before, name
    by_touches = explained(bench, fit.specimen)
    assert by_touches > 0.97
    assert by_touches > explained(bench, rest.specimen) + 0.02
    assert by_touches > explained(bench, nominal) + 0.5


def touch_of(bench: Bench) -> SensorTouches:
    """The first press of the library at 3 N, as the planted sensor reads it."""
    sensor = bench.model.with_specimen(PLANTED)
    counts = sensor.of_gap(bench.library.gaps[1]).counts
    return SensorTouches("planted", bench.touches.rest, counts[None], bench.library.force[1:2])


def first_press(bench: Bench, times: int = 1) -> PressLibrary:
    """The library's first press alone, so many times."""
    library, steps = bench.library, len(STEPS_N)
    states = np.tile(np.arange(steps), times)
    return PressLibrary(
        library.rest,
        [library.gaps[state] for state in states],
        library.force[states],
        library.place[states],
        np.repeat(np.arange(times), steps),
    )


def test_a_touch_counts_however_many_presses_it_may_have_been(bench: Bench) -> None:
    touch = touch_of(bench)
    rest = fit_sensor(bench.model, first_press(bench), touch.some(slice(0, 0)))
    once, often = (
        fit_sensor(bench.model, first_press(bench, times), touch, rounds=1) for times in (1, 60)
    )
    assert once.specimen.side_closing_m > 1.2 * rest.specimen.side_closing_m
    for name in ("sigma_s_m", "side_closing_m", "clamp_closing", "core_offset_m"):
        value = getattr(once.specimen, name)
        assert getattr(often.specimen, name) == pytest.approx(value, rel=1e-3), name


def test_a_fit_does_not_end_before_the_touches_were_fitted(bench: Bench) -> None:
    """Not even where electrodes deviate from the start by as much as is assumed of unknown ones."""
    library, touch = first_press(bench), touch_of(bench)
    rest = fit_sensor(bench.model, library, touch.some(slice(0, 0)))
    explainer = TouchExplainer(bench.model.with_specimen(rest.specimen), library)
    by_force = explainer.explain(touch, TouchPrior(), given=np.zeros(SENSING, bool))
    expected = touch.rest + by_force.tared
    off = np.where(np.arange(SENSING) % 2, 1.0, -1.0)
    # What is left is linear in the deviation.
    left = explainer.explain(replace(touch, counts=expected + off), TouchPrior()).left
    fit = fit_sensor(bench.model, library, replace(touch, counts=expected + SPREAD / left * off))
    assert fit.specimen != rest.specimen


def test_what_touches_teach_is_told_of_the_specimen_that_is_returned(bench: Bench) -> None:
    fit = fit_sensor(bench.model, bench.library, bench.touches, rounds=1)
    assert fit.learned is not None
    explainer = TouchExplainer(bench.model.with_specimen(fit.specimen), bench.library)
    own = explainer.learn(bench.touches).learned
    assert fit.learned.spread == pytest.approx(own.spread, rel=0.1)
    assert fit.learned.warmth == pytest.approx(own.warmth, abs=0.02)


def test_without_touches_only_the_rest_is_fitted(bench: Bench) -> None:
    fit = fit_sensor(bench.model, bench.library, bench.touches.some(slice(0, 0)))
    nominal = bench.model.of_gap(bench.library.rest).counts
    before = float(np.sqrt(np.mean((nominal - bench.touches.rest) ** 2)))
    assert fit.rest_error < 0.2 * before
    assert fit.learned is None
    assert "touches" in fit.member(0).found


def test_the_press_that_a_touch_was_is_found_without_most_electrodes(bench: Bench) -> None:
    explainer = TouchExplainer(bench.model.with_specimen(PLANTED), bench.library)
    whole = explainer.explain(bench.later, TouchPrior(spread=20.0))
    some = np.arange(SENSING) % 4 == 0
    part = explainer.explain(bench.later, TouchPrior(spread=20.0), given=some)
    np.testing.assert_allclose(whole.probability.sum(axis=1), 1.0)
    same = whole.probability.argmax(axis=1) == part.probability.argmax(axis=1)
    assert same.mean() > 0.8
    # What is not given must not matter.
    hidden = replace(bench.later, counts=np.where(some, bench.later.counts, 2000.0))
    again = explainer.explain(hidden, TouchPrior(spread=20.0), given=some)
    np.testing.assert_array_equal(part.tared, again.tared)


def test_a_touch_beyond_all_presses_is_refused(bench: Bench) -> None:
    hard = replace(bench.touches, force=10 * bench.touches.force)
    with pytest.raises(DatasetError, match="beyond all simulated presses"):
        fit_sensor(bench.model, bench.library, hard)
    with pytest.raises(DatasetError, match="no touch to explain"):
        TouchExplainer(bench.model, bench.library).learn(bench.touches.some(slice(0, 0)))


def test_forces_of_the_wrong_sign_are_refused(bench: Bench) -> None:
    pushed = replace(bench.touches, force=-bench.touches.force)
    with pytest.raises(DatasetError, match="degrees away from those of the nearest"):
        fit_sensor(bench.model, bench.library, pushed)


def test_electrodes_that_no_press_explains_are_told(bench: Bench) -> None:
    other = np.clip(bench.touches.rest - 3.0 * bench.touches.tared[:, ::-1], 1.0, 4094.0)
    mixed = replace(bench.touches, counts=other)
    for touches, nothing in ((bench.touches, False), (mixed, True)):
        fit = fit_sensor(bench.model, bench.library, touches, rounds=2)
        assert fit.tells_nothing is nothing
        assert fit.angle_rad < ANGLE_SD_RAD


def test_candidates_have_the_measured_size_of_force(bench: Bench) -> None:
    found = bench.library.candidates(bench.later.force)
    there = np.isfinite(found.angle_rad)
    assert there.any(axis=1).all()
    size = np.linalg.norm(found.at(bench.library.force), axis=2)
    wanted = np.broadcast_to(np.linalg.norm(bench.later.force, axis=1)[:, None], size.shape)
    np.testing.assert_allclose(size[there], wanted[there], rtol=1e-9)


def test_candidates_of_a_press_that_dips_have_the_measured_size_too(bench: Bench) -> None:
    sizes = np.array([2.0, 1.0, 3.0, 2.5, 4.0, 1.0])
    force = sizes[:, None] * [0.0, 0.0, 1.0]
    gaps, press = [bench.library.rest] * len(sizes), np.zeros(len(sizes), np.int64)
    library = PressLibrary(bench.library.rest, gaps, force, np.zeros((len(sizes), 3)), press)
    wanted = np.array([2.0, 2.2, 3.0, 3.5, 4.0])
    found = library.candidates(wanted[:, None] * [0.0, 0.0, 1.0])
    np.testing.assert_allclose(found.at(library.force)[:, 0, 2], wanted)
    assert ((found.share >= 0) & (found.share <= 1)).all()


def recording() -> tuple[Floats, Floats]:
    """Three holds; the second moves too little to be another touch, and one is too short."""
    rng = np.random.default_rng(0)
    levels = np.repeat([2000.0, 2050.0, 2600.0, 2900.0], [60, 70, 80, 20])
    counts = levels[:, None] + rng.uniform(-5, 5, (len(levels), SENSING))
    return counts, np.tile([0.0, 0.0, 4.0], (len(levels), 1))


def test_a_touch_is_what_was_held_and_differs_from_the_one_before() -> None:
    counts, force = recording()
    stretches = held(counts)
    assert [(one.start, one.stop) for one in stretches] == [(0, 130), (130, 210)]
    touches = touches_of("mine", np.full(SENSING, 2500.0), counts, force)
    np.testing.assert_allclose(touches.counts.mean(axis=1), [2027, 2600], atol=3)
    assert len(held(counts, rows=90)) == 1


REST = np.full(SENSING, 2500.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rest": np.full(SENSING, np.nan)}, "rest is not finite"),
        ({"rest": np.zeros(SENSING)}, "rest is from 0"),
        ({"rest": np.zeros(0)}, "rest has shape"),
        ({"counts": np.zeros((0, SENSING))}, "force has shape"),
        ({"counts": np.full((2, 24), 2000.0)}, "counts has shape"),
        ({"counts": np.full((2, SENSING), np.nan)}, "counts is not finite"),
        ({"counts": np.full((2, SENSING), -20.0)}, "raw counts"),
        ({"force": np.zeros((2, 3))}, "has no force"),
        ({"force": np.full((2, 3), np.inf)}, "force is not finite"),
    ],
)
def test_touches_that_make_no_sense_are_refused(changes: dict[str, Floats], words: str) -> None:
    good = {"rest": REST, "counts": np.full((2, SENSING), 2000.0), "force": np.ones((2, 3))}
    with pytest.raises(DatasetError, match=words):
        SensorTouches("mine", **(good | changes))


def write_recording(
    path: Path,
    *,
    rows_of: tuple[Floats, Floats, Floats] | None = None,
    group: Floats | None = None,
    leave_out: str = "",
    names: tuple[str, ...] = ("mine",),
) -> Path:
    rest, counts, force = rows_of or (REST, *recording())
    rows = len(counts)
    columns: dict[str, tuple[str, Any]] = {
        "electrodes": ("counts", counts.astype(np.uint16)),
        "baseline": ("counts", np.broadcast_to(rest, counts.shape).astype(np.float32)),
        "force": ("N", force.astype(np.float32)),
        "sensor": ("1", np.zeros(rows, np.int32)),
    }
    if group is not None:
        columns["group"] = ("1", group.astype(np.int32))
    with h5py.File(path, "w") as file:
        file.attrs.update({**FEATURES.facts, "sensor_names": list(names)})
        for name, (unit, values) in columns.items():
            if name != leave_out:
                file.create_dataset(name, data=values).attrs["unit"] = unit
    return path


def test_a_recording_is_read_or_refused(tmp_path: Path) -> None:
    good = write_recording(tmp_path / "good.h5")
    touches = read_touches(good)
    assert (touches.name, len(touches)) == ("mine", 2)
    assert len(read_touches(good, sensor="mine", rows=75)) == 2
    two = write_recording(tmp_path / "two.h5", names=("mine", "yours"))
    cases: list[tuple[Callable[[], object], str]] = [
        (lambda: read_touches(tmp_path / "no.h5"), "no such file"),
        (lambda: read_touches(good, sensor="yours"), "no sensor 'yours'"),
        (lambda: read_touches(two), "several sensors"),
        (lambda: read_touches(two, sensor="yours"), "no row of yours"),
        (lambda: read_touches(good, rows=500), "was held"),
        (lambda: read_touches(good, rows=0), "at least one row"),
    ]
    for name in ("electrodes", "baseline", "force", "sensor"):
        without = write_recording(tmp_path / f"{name}.h5", leave_out=name)
        cases.append((lambda path=without: read_touches(path), f"'{name}' is missing"))  # type: ignore[misc]
    changed = write_recording(tmp_path / "changed.h5")
    with h5py.File(changed, "r+") as file:
        arrays = {name: file[name][()] for name in DIGESTED if name in file}
        file.attrs["content_sha256"] = rows_sha256(["mine"], arrays)
    assert len(read_touches(changed)) == 2
    with h5py.File(changed, "r+") as file:
        file["force"][0] *= -1.0
    cases.append((lambda: read_touches(changed), "does not match its content_sha256"))
    for call, words in cases:
        with pytest.raises(DatasetError, match=words):
            call()


def test_a_recording_of_the_rest_will_do_where_no_touch_is_asked_for(tmp_path: Path) -> None:
    rest = np.tile(REST, (100, 1))
    path = write_recording(tmp_path / "rest.h5", rows_of=(REST, rest, np.zeros((100, 3))))
    with pytest.raises(DatasetError, match="was held"):
        read_touches(path)
    touches = read_touches(path, rest_alone=True)
    assert len(touches) == 0
    np.testing.assert_array_equal(touches.rest, REST)


def test_touches_are_tared_by_the_tare_that_was_in_force(tmp_path: Path) -> None:
    """The same dents, with one electrode near the converter's end, after each of two tares."""
    rest = np.repeat([2700.0, 2500.0], 120)[:, None] * np.ones(SENSING)
    counts = rest + np.tile(np.repeat([-400.0, 600.0], 60), 2)[:, None]
    counts[:, 0] = np.tile(np.repeat([4000.0, 3000.0], 60), 2)
    force = np.tile([0.0, 0.0, 4.0], (len(counts), 1))
    touches = read_touches(write_recording(tmp_path / "a.h5", rows_of=(rest, counts, force)))
    np.testing.assert_array_equal(touches.tared[:, 1], [-400, 600, -400, 600])
    np.testing.assert_array_equal(touches.some(slice(2, 4)).tared[:, 1], [-400, 600])
    np.testing.assert_array_equal(touches.counts[:, 0], [4000, 3000, 4000, 3000])
    np.testing.assert_array_equal(touches.rest, np.full(SENSING, 2700.0))
    # An electrode at its end is refused, even if the first tare was higher.
    counts[180:, 0] = 0.0
    with pytest.raises(DatasetError, match="counts is from 0"):
        read_touches(write_recording(tmp_path / "b.h5", rows_of=(rest, counts, force)))
    with pytest.raises(DatasetError, match="240 rows of counts, 3 of baseline"):
        touches_of("mine", REST, counts, force, baseline=rest[:3])
    with pytest.raises(DatasetError, match="baseline is not finite"):
        touches_of("mine", REST, counts, force, baseline=np.nan * rest)


def test_a_touch_is_of_one_press(tmp_path: Path) -> None:
    """Two presses at which the electrodes read the same, with different forces."""
    counts = np.full((120, SENSING), 2000.0)
    force = np.repeat([[0.0, 0.0, 4.0], [3.0, 0.0, 0.0]], 60, axis=0)
    rows_of = REST, counts, force
    apart = write_recording(tmp_path / "apart.h5", rows_of=rows_of, group=np.repeat([0.0, 1.0], 60))
    np.testing.assert_array_equal(read_touches(apart).force, force[[0, 60]])
    assert len(read_touches(write_recording(tmp_path / "one.h5", rows_of=rows_of))) == 1


def test_the_digest_is_of_all_columns_of_a_data_set() -> None:
    assert tuple(FEATURE_COLUMNS) == DIGESTED


def kept_for_counts_alone(path: Path, sensor: ElectrodeModel) -> None:
    """Gaps of a store are kept by the thousand, so without what derivatives by the skin need."""
    store = SimulationStore.open(path)
    for gaps in (
        read_library(store, sensor).gaps,
        [gap for deep in deep_states(store, sensor, lambda _: 2e-3) for gap in deep.gaps],
    ):
        some = [gap for gap in gaps if gap is not None and gap.pressure.any()]
        assert some
        assert all(gap.contact is None for gap in some)


def test_the_command_writes_a_population_that_the_twin_takes(tmp_path: Path) -> None:
    geometry = biotac(edge_m=1.4e-3)
    tip = Fingertip.pressurised(geometry, FingertipParameters(fluid_volume_m3=6e-7))
    plate = make_indenter("plate")
    sensor = ElectrodeModel(geometry, PLANTED)
    counts, force = [], []
    with StoreWriter(tmp_path / "plate.sim", BiotacTip(tip).describe()) as store:
        for k, lean in enumerate((-0.5, -0.2, 0.1)):
            normal = np.array([np.sin(lean), 0.0, np.cos(lean)])
            start = tip.nodes[np.argmin(tip.nodes @ normal)] - 2e-6 * normal
            turn = [np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0]
            path = np.array([[*(start + 0.4e-3 * i * normal), *turn] for i in range(6)])
            pressed = tip.indent(plate, path)
            store.write(f"plate/{k}/tilted", pressed)
            step = pressed.steps[-2]
            gap = sensor.finder.of_step(tip.nodes, step)
            counts.append(sensor.of_gap(gap).counts)
            force.append(step.force)
    kept_for_counts_alone(tmp_path / "plate.sim", sensor)
    rest = sensor.respond(tip.nodes).counts
    rows_of = rest, np.array(counts), np.array(force)
    recorded = write_recording(tmp_path / "real.h5", rows_of=rows_of)
    out = tmp_path / "mine.json"
    command = ["units", "fit", str(tmp_path / "plate.sim"), "--out", str(out)]
    command += ["--recording", str(recorded), "--held-rows", "1"]
    done = CliRunner().invoke(fem_app, [*command, "--touches", "2"], env={"COLUMNS": "100"})
    assert done.exit_code == 0, done.output
    assert "fitted to the rest and 2 of 3 touches" in done.output
    assert "degrees off the nearest presses" in done.output
    (member,) = read_population(out)
    assert member.specimen.name == "mine"
    assert member.found["touches"] == 2
    twin = Population(SimulationStore.open(tmp_path / "plate.sim").fingertip(), [member.specimen])
    left = np.abs(twin.rest_counts["mine"] - rest).mean()
    assert left < 0.3 * np.abs(ElectrodeModel(geometry).respond(tip.nodes).counts - rest).mean()
    assert "mine" in CliRunner().invoke(fem_app, ["units", "show", str(out)]).output
    refused = CliRunner().invoke(fem_app, [*command, "--touches", "-1"])
    assert isinstance(refused.exception, ConfigError)
    mixed = np.clip(rest - 3.0 * (np.array(counts) - rest)[:, ::-1], 1.0, 4094.0)
    for rows_of, asked, code, words in (
        ((rest, mixed, np.array(force)), "3", 1, "do not explain the electrodes"),
        ((rest, np.tile(rest, (9, 1)), np.zeros((9, 3))), "0", 0, "the rest and 0 of 0 touches"),
    ):
        write_recording(recorded, rows_of=rows_of)
        done = CliRunner().invoke(fem_app, [*command, "--touches", asked], env={"COLUMNS": "100"})
        assert done.exit_code == code, done.output
        assert words in done.output
