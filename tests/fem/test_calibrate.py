"""Calibration on a finger that is a formula: what was planted is found, what fails is told."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import ConfigError, DatasetError, SimulationError
from palpate.rigid import path_lengths
from palpate_fem.arrays import Floats
from palpate_fem.calibration.calibrate import calibrate
from palpate_fem.calibration.local import LocalModel, estimates
from palpate_fem.calibration.measured import MeasuredIndentation
from palpate_fem.calibration.point import CalibrationCase, SimulatedPoint
from palpate_fem.calibration.recover import recover
from palpate_fem.calibration.result import Evaluation, read_parameters, write_calibration
from palpate_fem.calibration.runs import PlannedPath, RunSlopes, SimulatedRun
from palpate_fem.calibration.settings import (
    FRICTION,
    MODULUS,
    PAPER_BOUNDS,
    THICKNESS,
    VOLUME,
    CalibrationSettings,
)
from palpate_fem.cli.app import fem_app
from palpate_fem.config import FingertipParameters
from palpate_fem.plot.validation import plot_calibration
from palpate_fem.result import IndentationOutcome

RADII_M = {"sphere_small": 1.75e-3, "sphere_medium": 3.5e-3, "sphere_large": 7e-3}


def bulge_m(parameters: FingertipParameters) -> float:
    """How far the skin is blown up: 1.46 mm in 474 mm^3, as measured on the public mesh."""
    if parameters.fluid_volume_m3 is not None:
        return (parameters.fluid_volume_m3 - 366e-9) / 474e-9 * 1.46e-3
    return parameters.total_thickness_m - 13.64e-3 - (parameters.skin_thickness_m - 1.57e-3)


@dataclass
class Formula:
    """A dome on a core: a membrane, then a pinch; Coulomb friction behind a spring.

    Attributes:
        stop_m: Travel at which runs of ``stops`` end by divergence.
        stops: Name of the indenter whose runs do.
        refuses: Name of an indenter that it does not know.
        limit_n: Force at which runs end.
        thicknesses_m: Skins that it can simulate at all.
    """

    stop_m: float = math.inf
    stops: str = ""
    refuses: str = ""
    limit_n: float = 32.0
    thicknesses_m: tuple[float, float] = (0.0, 1.0)

    def simulate(
        self, parameters: FingertipParameters, indenter: str, path: Floats
    ) -> SimulatedRun:
        if indenter == self.refuses:
            raise SimulationError("the mesh is folded", remedy="none")
        if not self.thicknesses_m[0] < parameters.skin_thickness_m < self.thicknesses_m[1]:
            raise SimulationError("the path begins inside the skin", remedy="none")
        mu, friction = parameters.shear_modulus_pa, parameters.friction_coefficient
        skin, bulge = parameters.skin_thickness_m, bulge_m(parameters)
        root = math.sqrt(RADII_M[indenter])
        way = path_lengths(path)
        move = (path[-1, :3] - path[0, :3]) / way[-1]
        total = 13.64e-3 + (skin - 1.57e-3) + bulge
        depth = np.maximum(way - 3e-3 + 0.5 * (total - 15.1e-3), 0.0)
        deep, aside = depth * move[2], depth * math.hypot(move[0], move[1])
        stretch = skin / 1.57e-3 * (0.6 + 0.4 * bulge / 1.46e-3)
        membrane = 5.6 * stretch * root * deep**1.5 * (1 + (deep / 2.5e-3) ** 2)
        gap = 0.73e-3 + bulge
        squeeze = np.logaddexp(0.0, (deep - gap) / 1e-4) * 1e-4
        normal = mu * (membrane + 3.2 * root * squeeze**1.5 * 1.57e-3 / skin)
        spring = 16 * mu * root * np.sqrt(deep) * aside
        slip = np.maximum(friction * normal, 1e-12)
        tangent = slip * np.tanh(spring / slip) * (normal > 0)
        along = np.array([move[0], move[1], 0.0]) / max(math.hypot(move[0], move[1]), 1e-9)
        force = normal[:, None] * [0.0, 0.0, 1.0] + tangent[:, None] * along
        outcome, count = IndentationOutcome.COMPLETE, len(way)
        for end, at in (
            (IndentationOutcome.FORCE_LIMIT, np.linalg.norm(force, axis=1) > self.limit_n),
            (IndentationOutcome.DIVERGED, (way > self.stop_m) & (indenter == self.stops)),
        ):
            if at[:count].any():
                outcome, count = end, int(at.argmax())
        volume = 366e-9 + 474e-9 * bulge / 1.46e-3
        reason = "" if outcome is IndentationOutcome.COMPLETE else "by design"
        return SimulatedRun(force[:count], way[:count], total, volume, outcome, reason)


class SlopeFormula(Formula):
    """The same with its derivatives."""

    def simulate_slopes(
        self,
        parameters: FingertipParameters,
        indenter: str,
        path: Floats,
        names: tuple[str, ...],
    ) -> SimulatedRun:
        run, columns, step = self.simulate(parameters, indenter, path), [], 1e-5
        for name in names:
            value = getattr(parameters, name)
            more, less = (
                self.simulate(replace(parameters, **{name: value * (1 + way)}), indenter, path)
                for way in (step, -step)
            )
            count = len(run.forces)
            both: list[Floats] = [
                (more.forces[:count] - less.forces[:count]).ravel(),
                np.array([more.thickness_m, more.fluid_volume_m3])
                - [less.thickness_m, less.fluid_volume_m3],
            ]
            columns.append(np.concatenate(both) / (2 * step * value))
        table = np.stack(columns, axis=-1)
        force = table[:-2].reshape(-1, 3, len(names))
        return replace(run, slopes=RunSlopes(names, force, table[-2], table[-1]))


def press(
    angle_deg: float = 0.0, azimuth_deg: float = 0.0, *, depth_m: float = 3e-3, samples: int = 46
) -> Floats:
    """A straight path that begins 3 mm above the skin."""
    angle, azimuth = np.radians([angle_deg, azimuth_deg])
    move = np.array(
        [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)]
    )
    path = np.zeros((samples, 7))
    path[:, :3] = np.linspace(0.0, 3e-3 + depth_m, samples)[:, None] * move + [0.0, 0.0, -12e-3]
    path[:, 3] = 1.0
    return path


ANGLED = PlannedPath("sphere_medium/00/angled-0", "sphere_medium", press(30.0))
NORMAL = PlannedPath("sphere_medium/00/normal", "sphere_medium", press())
PLANS = (
    ANGLED,
    NORMAL,
    PlannedPath("sphere_large/01/angled-1", "sphere_large", press(30.0, 90.0)),
    PlannedPath("sphere_small/02/normal", "sphere_small", press()),
)
TRUTH = FingertipParameters(
    skin_thickness_m=1.42e-3, shear_modulus_pa=3.4e5, friction_coefficient=0.25
)


def measure(
    plans: Sequence[PlannedPath] = PLANS, truth: FingertipParameters = TRUTH
) -> list[MeasuredIndentation]:
    """Perfect records of the formula."""
    return [
        MeasuredIndentation(
            plan.name,
            plan.indenter,
            "biotac1",
            plan.path,
            Formula(limit_n=math.inf).simulate(truth, plan.indenter, plan.path).forces,
        )
        for plan in plans
    ]


@pytest.mark.parametrize(
    ("truth", "noise_n", "sensors"),
    [
        (TRUTH, 0.02, 1),
        (TRUTH, 0.05, 2),
        (FingertipParameters(1.8e-3, 1.5e5, 0.12), 0.03, 1),
    ],
)
@pytest.mark.parametrize("simulator", [Formula(), SlopeFormula()], ids=["differences", "slopes"])
def test_planted_parameters_are_found_in_noise(
    simulator: Formula, truth: FingertipParameters, noise_n: float, sensors: int
) -> None:
    found = recover(simulator, truth, PLANS, noise_n, seed=1, sensors=sensors)
    assert found.passed, found.rows()
    assert found.calibration.converged
    assert found.calibration.self_test
    for name, error in found.errors.items():
        assert abs(error) < 4 * found.sd[name] / found.found[name], (name, found.rows())
    # residuals are the noise, but for the shift that was fitted
    np.testing.assert_allclose(found.calibration.axis_rms_n, noise_n, rtol=0.3)
    assert sum(found.calibration.paper_axis_rms_n) > sum(found.calibration.axis_rms_n)


def test_exact_forces_give_exact_parameters() -> None:
    found = calibrate(Formula(), measure())
    assert found.converged
    assert found.parameters.skin_thickness_m == pytest.approx(TRUTH.skin_thickness_m, rel=2e-3)
    assert found.parameters.shear_modulus_pa == pytest.approx(TRUTH.shear_modulus_pa, rel=2e-3)
    assert found.parameters.friction_coefficient == pytest.approx(0.25, rel=2e-3)
    assert found.parameters.fluid_volume_m3 is None, "the solver is to fill to the thickness"
    assert found.cost < 0.01


def test_free_volume_is_held_by_the_thickness_term() -> None:
    """The same optimum, found over four parameters with the paper's penalty."""
    bounds = PAPER_BOUNDS | {VOLUME: (5e-7, 1.2e-6)}
    found = calibrate(Formula(), measure(), CalibrationSettings(bounds=bounds))
    truth = Formula().simulate(TRUTH, "sphere_medium", press())
    assert found.fluid_volume_m3 == pytest.approx(truth.fluid_volume_m3, rel=1e-2)
    assert found.parameters.fluid_volume_m3 == pytest.approx(found.fluid_volume_m3, rel=1e-12)
    assert found.thickness_m == pytest.approx(15.1e-3, abs=1e-6)
    assert found.parameters.skin_thickness_m == pytest.approx(TRUTH.skin_thickness_m, rel=1e-2)
    assert {estimate.name for estimate in found.estimates} == {
        THICKNESS, MODULUS, FRICTION, VOLUME,
    }  # fmt: skip


def test_the_modulus_needs_no_runs() -> None:
    """Runs = points x paths: those of the scan, of the steps, and two beside each step's end."""
    events: list[Evaluation] = []
    one = recover(Formula(), TRUTH, PLANS[:2], 0.02, 5, on_evaluation=events.append)
    points = len(events)
    beside = one.calibration.simulations / len(PLANS[:2]) - points
    assert beside == 2 * round(beside / 2)
    assert one.calibration.simulations <= 2 * (points + 2 * (points - 6 + 1))


def test_slopes_save_the_scan_and_the_runs_beside() -> None:
    counts = []
    for simulator in (Formula(), SlopeFormula()):
        found = calibrate(simulator, measure())
        assert found.converged
        assert found.parameters.skin_thickness_m == pytest.approx(TRUTH.skin_thickness_m, rel=2e-3)
        assert found.parameters.friction_coefficient == pytest.approx(0.25, rel=2e-3)
        counts.append(found.simulations)
        deviations = {estimate.name: estimate.sd for estimate in found.estimates}
        assert all(math.isfinite(sd) for sd in deviations.values())
    assert 3 * counts[1] <= counts[0]


def test_slopes_of_a_free_volume() -> None:
    bounds = PAPER_BOUNDS | {VOLUME: (5e-7, 1.2e-6)}
    found = calibrate(SlopeFormula(), measure(), CalibrationSettings(bounds=bounds))
    truth = Formula().simulate(TRUTH, "sphere_medium", press())
    assert found.fluid_volume_m3 == pytest.approx(truth.fluid_volume_m3, rel=1e-2)
    assert found.thickness_m == pytest.approx(15.1e-3, abs=1e-6)


def test_where_the_middle_fails_slopes_begin_with_the_scan() -> None:
    simulator = SlopeFormula(thicknesses_m=(1.42e-3, 1.9e-3))
    truth = replace(TRUTH, skin_thickness_m=1.7e-3)
    found = calibrate(simulator, measure(truth=truth))
    assert [entry.stage for entry in found.history][:2] == ["start", "scan"]
    assert found.parameters.skin_thickness_m == pytest.approx(1.7e-3, rel=5e-3)


def test_progress_is_told_in_order() -> None:
    events: list[Evaluation] = []
    batches: list[tuple[int, int]] = []
    found = calibrate(
        Formula(),
        measure(),
        CalibrationSettings(scan=(2, 2)),
        on_evaluation=events.append,
        on_run=lambda done, total: batches.append((done, total)),
    )
    assert [event.stage for event in events][:5] == ["scan"] * 4 + ["step"]
    assert events == list(found.history)
    assert len(batches) == found.simulations
    assert batches[:16] == [(done, 16) for done in range(1, 17)]
    steps = [event.cost for event in events if event.stage == "step"]
    assert steps == sorted(steps, reverse=True), "each step that counts is lower"


def test_without_slip_friction_is_not_determined() -> None:
    found = calibrate(Formula(), measure([NORMAL, PLANS[3]]))
    friction = next(item for item in found.estimates if item.name == FRICTION)
    assert math.isinf(friction.sd)
    assert friction.sensitivity_n == pytest.approx(0.0, abs=1e-9)
    assert any("not determined" in row[-1] for row in found.rows())
    assert found.parameters.skin_thickness_m == pytest.approx(TRUTH.skin_thickness_m, rel=1e-2)


def test_a_bound_that_is_reached_is_told() -> None:
    bounds = PAPER_BOUNDS | {FRICTION: (0.3, 0.9)}
    found = calibrate(Formula(), measure(), CalibrationSettings(bounds=bounds))
    friction = next(item for item in found.estimates if item.name == FRICTION)
    assert friction.at_bound
    assert math.isnan(friction.sd)
    assert friction.value == pytest.approx(0.3, rel=1e-3)


def test_a_bound_is_not_exceeded_in_the_last_digit() -> None:
    """exp(log(1e7)) is more than 1e7, which no finger may have."""
    stiff = cast("FingertipParameters", SimpleNamespace(**asdict(TRUTH) | {MODULUS: 2e7}))
    bounds = PAPER_BOUNDS | {MODULUS: (1e5, 1e7)}
    found = calibrate(Formula(), measure(truth=stiff), CalibrationSettings(bounds=bounds))
    assert found.parameters.shear_modulus_pa == found.value(MODULUS) == 1e7


def test_nothing_is_determined_where_all_stopped_at_bounds() -> None:
    bounds = {THICKNESS: (1.4e-3, 1.9e-3), FRICTION: (0.25, 0.7), VOLUME: (8e-7, 1.2e-6)}
    settings = CalibrationSettings(bounds=bounds | {MODULUS: (3e5, 6e5)})
    at = np.array([low for low, _ in bounds.values()])
    finger, items, names = settings.parameters(at), measure(), settings.simulated
    runs = [
        SlopeFormula().simulate_slopes(finger, item.indenter, item.pose, names) for item in items
    ]
    cases = [CalibrationCase.of(item, settings) for item in items]
    model = LocalModel(SimulatedPoint.of(at, runs), (), cases, settings)
    found = estimates(model, np.zeros(3), math.log(3e5))
    assert len(found) == 4
    assert all(item.at_bound and math.isnan(item.sd) for item in found)


def test_stated_deviation_grows_with_the_noise() -> None:
    sds = []
    for noise_n in (0.01, 0.03):
        found = recover(Formula(), TRUTH, PLANS[:2], noise_n, seed=8)
        sds.append([found.sd[name] for name in (THICKNESS, MODULUS, FRICTION)])
    np.testing.assert_allclose(np.divide(sds[1], sds[0]), 3.0, rtol=0.35)


def test_runs_that_end_early_are_compared_as_far_as_they_go_and_noted() -> None:
    simulator = Formula(stops="sphere_small", stop_m=5.2e-3)
    found = calibrate(simulator, measure())
    fit = {fit.name: fit for fit in found.trajectories}["sphere_small/02/normal"]
    assert 0.5 < fit.coverage < 1.0
    assert any("sphere_small" in note and "diverged (by design)" in note for note in found.notes)
    assert found.parameters.skin_thickness_m == pytest.approx(TRUTH.skin_thickness_m, rel=5e-3)


@pytest.mark.parametrize(
    ("simulator", "why"),
    [
        (Formula(refuses="sphere_small"), "simulation: refused: the mesh is folded"),
        (Formula(stops="sphere_small", stop_m=4.3e-3), "covers"),
        (Formula(stops="sphere_small", stop_m=3.05e-3), "never reaches"),
    ],
)
def test_a_trajectory_that_cannot_be_simulated_is_left_out_in_the_open(
    simulator: Formula, why: str
) -> None:
    found = calibrate(simulator, measure())
    assert list(found.excluded) == ["sphere_small/02/normal"]
    assert why in found.excluded["sphere_small/02/normal"]
    assert len(found.trajectories) == 3
    assert found.parameters.skin_thickness_m == pytest.approx(TRUTH.skin_thickness_m, rel=5e-3)


def test_points_of_the_scan_where_nothing_works_leave_no_trajectory_out() -> None:
    """Four of six points, as with a real finger, whose skin grows over where paths begin."""
    found = calibrate(Formula(thicknesses_m=(1.3e-3, 1.6e-3)), measure())
    assert not found.excluded
    assert len(found.trajectories) == len(PLANS)
    assert found.parameters.skin_thickness_m == pytest.approx(TRUTH.skin_thickness_m, rel=5e-3)


def test_nothing_to_compare_is_an_error() -> None:
    soft = [replace(item, force=item.force * 0.001) for item in measure(PLANS[:1])]
    with pytest.raises(DatasetError, match="never reaches the threshold"):
        calibrate(Formula(), soft)
    with pytest.raises(DatasetError, match="none given"):
        calibrate(Formula(), [])
    with pytest.raises(SimulationError, match="sphere_medium/00/angled-0: refused: the mesh"):
        calibrate(Formula(refuses="sphere_medium"), measure(PLANS[:1]))


def test_all_reasons_for_which_nothing_can_be_compared_are_told() -> None:
    """As on a real finger: paths that begin in the thin skins, and miss most of the thick ones."""
    simulator = Formula(thicknesses_m=(1.3e-3, 3e-3), stops="sphere_medium", stop_m=3.05e-3)
    with pytest.raises(SimulationError) as caught:
        calibrate(simulator, measure(PLANS[:1]))
    said = caught.value.problem
    assert "the path begins inside the skin -> none (skin of 1." in said
    assert "never reaches" in said
    assert "bounds" not in caught.value.remedy
    assert "above the skin" in caught.value.remedy


def test_result_is_a_file_that_gives_the_parameters_back(tmp_path: Path) -> None:
    found = calibrate(Formula(), measure([NORMAL, PLANS[3]]))  # has an infinite deviation
    path, picture = tmp_path / "fits" / "fit.json", tmp_path / "fit.png"
    write_calibration(path, found)
    assert read_parameters(path) == found.parameters
    content = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert content["simulations"] == found.simulations
    assert len(content["history"]) == len(found.history)
    plot_calibration(found, picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    content["parameters"] |= {"strain_stiffening": None, "fluid_volume_m3": None}
    path.write_text(json.dumps(content))
    assert read_parameters(path).fluid_volume_m3 is None
    content["parameters"]["shear_modulus_pa"] = None
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=r"fit\.json: shear_modulus_pa = None"):
        read_parameters(path)
    path.write_text(path.read_text().replace("palpate.calibration", "other"))
    for bad in (path, tmp_path / "nothing.json", picture):
        with pytest.raises(ConfigError, match="not a calibration"):
            read_parameters(bad)


def test_json_of_a_recovery_that_fails_is_json(monkeypatch: pytest.MonkeyPatch) -> None:
    """Deviations are infinite there, and a value that was not found is none."""
    found = recover(Formula(), TRUTH, PLANS[:2], 0.02, 5)
    failed = replace(
        found,
        found=found.found | {MODULUS: math.nan},
        sd=dict.fromkeys(found.sd, math.inf),
    )
    bar = SimpleNamespace(on_evaluation=None, on_run=None)
    command = "palpate_fem.cli.identify"
    monkeypatch.setattr(f"{command}.biotac", lambda **_: None)
    monkeypatch.setattr(f"{command}.Fingertip.pressurised", lambda *_: None)
    monkeypatch.setattr(f"{command}.plan_recovery", lambda _: [])
    monkeypatch.setattr(f"{command}.simulator_for", lambda *_: nullcontext((None, None, bar)))
    monkeypatch.setattr(f"{command}.recover", lambda *_, **__: failed)
    done = CliRunner().invoke(fem_app, ["recover", "--json"])
    assert done.exit_code == 1
    told = json.loads(done.stdout, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert told["found"][MODULUS] is None
    oblique = ANGLED.name + "/virtual1"
    force = next(item.force for item in found.measured if item.name == oblique)
    largest = np.sqrt((force**2).sum(axis=1)).max()
    assert told["largest_force_n"][oblique] == pytest.approx(largest)
    assert set(told["deviation"].values()) == {None}


def test_infinite_noise_is_refused() -> None:
    with pytest.raises(ConfigError, match="--noise-n inf is not finite"):
        CliRunner().invoke(fem_app, ["recover", "--noise-n", "inf"], catch_exceptions=False)
