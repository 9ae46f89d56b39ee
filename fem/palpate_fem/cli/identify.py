"""``palpate fem calibrate``, ``validate``, ``recover``, ``units``: parameters from measurements.

Calibration finds the fingertip's mechanical parameters from measured forces, ``recover`` checks
that method on known parameters, ``validate`` compares simulated with measured forces, and
``units`` fits the electrodes of specimens to published ranges, or draws them.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import active_children, get_context
from pathlib import Path

import numpy as np
import typer
from rich.progress import Progress

from palpate.errors import ConfigError, DatasetError
from palpate.files.outputs import check_folder, check_output
from palpate.process import begin_worker
from palpate_fem.calibration.calibrate import calibrate
from palpate_fem.calibration.measured import SIMULATED, MeasuredIndentation
from palpate_fem.calibration.recover import ParameterRecovery, plan_recovery, recover
from palpate_fem.calibration.result import (
    Calibration,
    Evaluation,
    without_nan,
    write_calibration,
)
from palpate_fem.calibration.runs import FingertipSimulator, simulate_all
from palpate_fem.calibration.settings import CalibrationSettings
from palpate_fem.cli.model import FingertipModel, workers_for
from palpate_fem.cli.terminal import console, print_lines, print_table, progress_bar
from palpate_fem.config import EDGE_M, FingertipParameters
from palpate_fem.electrodes.model import ElectrodeModel
from palpate_fem.electrodes.specimen import SpecimenParameters
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.plot.validation import plot_calibration, plot_examples, plot_indenters
from palpate_fem.population.fitting import deep_states, fit_member, misses
from palpate_fem.population.members import (
    PAPER,
    Member,
    draw_members,
    read_population,
    write_population,
)
from palpate_fem.population.press_library import read_library
from palpate_fem.population.responses import geometry_of
from palpate_fem.population.sensor_fit import fit_sensor
from palpate_fem.population.touches import read_touches
from palpate_fem.service.batch import PoolSimulator
from palpate_fem.store.read import SimulationStore
from palpate_fem.trajectory import ANGLED_DEPTH_M, CLEARANCE_M, NORMAL_DEPTH_M
from palpate_fem.validation.sources import measured_from, simulated_from
from palpate_fem.validation.validate import (
    INDENTER_HEADINGS,
    indenter_rows,
    summary_lines,
    validate,
    write_report,
)

CALIBRATION_HEADINGS = ("parameter", "value", "deviation", "force per 1 %", "bounds", "remark")
_LIMIT_S = 900.0  # of one run; the slowest trajectory takes a tenth of it
_SAME_M = 1e-6  # depths of paths differ by rounding


def calibrate_command(
    measured: Path,
    out: Path,
    only: Sequence[str],
    model: FingertipModel,
    *,
    png: Path | None,
    workers: int,
    slopes: bool,
    total_thickness_m: float,
) -> int:
    """Calibrate a finger this thick and write the result; 1 if the search did not converge."""
    check_output(out, "--out", ".json", measured)
    check_output(png, "--png", ".png", measured)
    settings = CalibrationSettings(target_thickness_m=total_thickness_m)
    chosen = _chosen(measured, only)
    runs_with = slope_simulator_for if slopes else simulator_for
    with runs_with(model, workers, len(chosen)) as (simulator, executor, bar):
        result = calibrate(
            simulator,
            chosen,
            settings=settings,
            executor=executor,
            on_evaluation=bar.on_evaluation,
            on_run=bar.on_run,
        )
    _show_calibration(result)  # first: it is all that is left of the search if the disk refuses
    write_calibration(out, result)
    print_lines(f"wrote {out}")
    if png is not None:
        plot_calibration(result, png)
    return 0 if result.converged else 1


def validate_command(
    measured: Path,
    out: Path,
    only: Sequence[str],
    model: FingertipModel,
    *,
    store: Path | None,
    workers: int,
) -> int:
    """Compare, and write table and plots; 1 if nothing could be compared."""
    check_folder(out, "--out")
    chosen = _chosen(measured, only)
    refused: dict[str, str] = {}
    if store is not None:
        simulated, refused = simulated_from(SimulationStore.open(store), chosen)
    else:
        with simulator_for(model, workers, len(chosen)) as (simulator, executor, bar):
            simulated = simulate_all(
                simulator, model.parameters, chosen, executor=executor, on_run=bar.on_run
            )
    result = validate(chosen, simulated, refused)
    if result.compared:
        print_table(INDENTER_HEADINGS, indenter_rows(result))
    print_lines(*summary_lines(result))
    if not result.compared:
        return 1
    files = [*write_report(out, result), out / "examples.png", out / "indenters.png"]
    plot_examples(result, files[-2])
    plot_indenters(result, files[-1])
    print_lines(f"wrote {out}: {', '.join(file.name for file in files)}")
    return 0


def _chosen(measured: Path, only: Sequence[str]) -> list[MeasuredIndentation]:
    """Trajectories of the file whose name begins with one of ``only``; without, all."""
    found, left_out = measured_from(measured)
    print_lines(*(f"left out: {name}: {why}" for name, why in left_out.items()), to=console)
    chosen = [
        item for item in found if not only or any(item.name.startswith(start) for start in only)
    ]
    if not chosen:
        raise ConfigError(
            f"no trajectory of {measured} begins with {' or '.join(only) or 'anything'}",
            remedy=f"there are e.g. {', '.join(item.name for item in found[:3]) or 'none'}",
        )
    if any(item.origin == SIMULATED for item in chosen):
        print_lines(
            "these forces are simulated, not measured: this tests the method, not the model",
            to=console,
        )
    return chosen


@contextmanager
def simulator_for(
    model: FingertipModel, workers: int, jobs: int
) -> Iterator[tuple[PoolSimulator, ThreadPoolExecutor, _SearchBar]]:
    """A simulator over worker processes, an executor with a thread for each, and a progress bar."""
    count, threads = workers_for(workers, jobs)
    with (
        PoolSimulator(
            model.setup(keep=2), workers=count, threads=threads, limit_s=_LIMIT_S
        ) as simulator,
        ThreadPoolExecutor(count) as executor,
        progress_bar() as bar,
    ):
        try:
            yield simulator, executor, _SearchBar(bar)
        except BaseException:
            simulator.close()  # before the executor, whose threads wait for the simulator
            raise


@contextmanager
def slope_simulator_for(
    model: FingertipModel, workers: int, jobs: int
) -> Iterator[tuple[FingertipSimulator, ProcessPoolExecutor, _SearchBar]]:
    """The same for a simulator that derives its runs.

    Raises:
        ConfigError: The finger is not the parametric one.
    """
    options = dict(model.options)
    if "mesh" in options:
        raise ConfigError("--slopes is for the parametric mesh", remedy="leave out --mesh")
    count, _ = workers_for(workers, jobs)
    others = set(active_children())
    with (
        ProcessPoolExecutor(
            count, mp_context=get_context("spawn"), initializer=begin_worker
        ) as executor,
        progress_bar() as bar,
    ):
        try:
            yield FingertipSimulator(**options), executor, _SearchBar(bar)  # type: ignore[arg-type]
        except BaseException:  # the executor would wait for runs that nobody needs
            for worker in set(active_children()) - others:
                worker.kill()
            raise


class _SearchBar:
    """Progress of a calibration."""

    def __init__(self, bar: Progress) -> None:
        self._bar = bar
        self._task = bar.add_task("simulate", total=None, info="")

    def on_evaluation(self, evaluation: Evaluation) -> None:
        self._bar.update(
            self._task,
            info=f"{evaluation.stage}: cost {evaluation.cost:.3f} N after "
            f"{evaluation.simulations} runs",
        )

    def on_run(self, done: int, total: int) -> None:
        self._bar.update(self._task, completed=done, total=total)


def _show_calibration(result: Calibration) -> None:
    title = "calibrated" if result.converged else "the search did not converge"
    print_table(CALIBRATION_HEADINGS, result.rows(), title=title)
    print_lines(
        f"cost {result.cost:.4g} N, {result.thickness_m * 1e3:.2f} mm thick, "
        f"{result.simulations} runs",
        *(f"left out: {name}: {why}" for name, why in result.excluded.items()),
        *(f"note: {note}" for note in result.notes),
    )


# Away from the defaults, so that a search that does not move fails the test.
PLANTED = FingertipParameters(
    skin_thickness_m=1.45e-3, shear_modulus_pa=3.3e5, friction_coefficient=0.25
)
RECOVERY_HEADINGS = ("parameter", "planted", "found", "error", "deviation", "tolerance", "")


def recover_command(
    model: FingertipModel,
    *,
    edge_mm: float | None,
    noise_n: float,
    seed: int,
    workers: int,
    slopes: bool,
    as_json: bool,
) -> int:
    """Simulate with known parameters, add noise, calibrate; 1 if an error exceeds its tolerance.

    Of the model only the mesh is used.
    """
    if not math.isfinite(noise_n):
        raise ConfigError(f"--noise-n {noise_n:g} is not finite", remedy="give newtons, 0 or more")
    geometry = biotac(
        thickness_m=PLANTED.skin_thickness_m, edge_m=EDGE_M if edge_mm is None else edge_mm * 1e-3
    )
    planned = plan_recovery(Fingertip.pressurised(geometry, replace(PLANTED)))
    runs_with = slope_simulator_for if slopes else simulator_for
    with runs_with(model, workers, len(planned)) as (simulator, executor, bar):
        recovery = recover(
            simulator,
            PLANTED,
            planned,
            noise_n,
            seed,
            executor=executor,
            on_evaluation=bar.on_evaluation,
            on_run=bar.on_run,
        )
    if as_json:
        content = without_nan(_recovery_json(recovery, noise_n, seed))
        typer.echo(json.dumps(content, indent=1, allow_nan=False))
    else:
        title = f"planted and found, noise {noise_n:g} N, seed {seed}"
        print_table(RECOVERY_HEADINGS, recovery.rows(), title=title)
        excluded = recovery.calibration.excluded
        print_lines(*(f"left out: {name}: {why}" for name, why in excluded.items()))
    return 0 if recovery.passed else 1


def _recovery_json(recovery: ParameterRecovery, noise_n: float, seed: int) -> dict[str, object]:
    return {
        "noise_n": noise_n,
        "seed": seed,
        "passed": recovery.passed,
        "simulations": recovery.calibration.simulations,
        "converged": recovery.calibration.converged,
        "cost_n": recovery.calibration.cost,
        "left_out": recovery.calibration.excluded,
        "notes": recovery.calibration.notes,
        "deviation": {name: recovery.sd[name] / value for name, value in recovery.found.items()},
        "planted": recovery.truth,
        "found": recovery.found,
        "error": recovery.errors,
        "largest_force_n": {
            item.name: float(np.linalg.norm(item.force, axis=1).max()) for item in recovery.measured
        },
    }


_PAPER_PRESS = re.compile(r".+/(?:(?P<normal>normal)|angled-\d+)")


def planned_travel_m(name: str) -> float:
    """Planned travel of a press of the paper, from its first pose on [m], by its name.

    Raises:
        DatasetError: It is no such press.
    """
    press = _PAPER_PRESS.fullmatch(name)
    if press is None:
        raise DatasetError(
            f"{name} is none of the paper's presses, to whose ranges specimens are fitted",
            remedy="give a store of palpate data generate without --random and --path",
        )
    return CLEARANCE_M + (NORMAL_DEPTH_M if press["normal"] else ANGLED_DEPTH_M)


def store_overtravel_m(store: SimulationStore) -> float:
    """How much deeper than the paper's all presses of a store are planned at least [m].

    Raises:
        DatasetError: It holds none, others, or shorter ones.
    """
    beyond = [
        float(np.linalg.norm(path[-1, :3] - path[0, :3])) - planned_travel_m(name)
        for name in store.ids()
        for path in (store.summary(name).path,)
    ]
    if not beyond:
        raise DatasetError(f"{store.path} holds no trajectory", remedy="simulate some first")
    if min(beyond) < -_SAME_M:
        raise DatasetError(
            f"{store.path}: a press ends {-1e3 * min(beyond):.3g} mm short of the paper's depth",
            remedy="give a store of palpate data generate",
        )
    return max(0.0, min(beyond))


def fit_units_command(store: Path, out: Path, *, overtravel_m: float | None) -> int:
    """Fit the paper's three specimens on a store of the whole set, and write the population.

    Args:
        store: Its presses.
        out: The population.
        overtravel_m: Most of it that a specimen may have [m]; None = that of the store's paths.

    Returns:
        1 if a specimen is far from what it was fitted to.
    """
    check_output(out, "--out", ".json", store)
    if overtravel_m is not None and not overtravel_m >= 0:
        raise ConfigError(f"overtravel of {overtravel_m} m", remedy="give 0 or more")
    opened = SimulationStore.open(store)
    most_m = store_overtravel_m(opened)
    if overtravel_m is not None and overtravel_m > most_m + _SAME_M:
        raise ConfigError(
            f"--overtravel-mm {1e3 * overtravel_m:g}, but the presses of {store} go only "
            f"{1e3 * most_m:.3g} mm deeper than the paper's",
            remedy="leave it out, or simulate deeper presses",
        )
    if overtravel_m is not None:
        most_m = overtravel_m
    fingertip = opened.fingertip()
    geometry = geometry_of(fingertip)
    sensor = ElectrodeModel(geometry)
    rest = sensor.finder.measure(fingertip.pressurised_nodes)
    ids = opened.ids()
    with progress_bar() as bar:
        task = bar.add_task("films", total=len(ids))
        states = deep_states(
            opened, sensor, planned_travel_m, on_trajectory=lambda: bar.advance(task)
        )
        bar.update(task, description="specimens", total=len(PAPER), completed=0)
        members: list[Member] = []
        for number, published in enumerate(PAPER, 1):
            members.append(fit_member(geometry, rest, states, published, number, most_m=most_m))
            bar.advance(task)
    source = f"{len(ids)} trajectories of the fingertip {fingertip.key[:12]}"
    write_population(out, members, source=source)
    _show_members(members)
    print_lines(f"wrote {out}")
    missed = {member.specimen.name: far for member in members if (far := misses(member))}
    for name, far in missed.items():
        print_lines(f"{name} is far from what is published: {', '.join(far)}")
    if missed:
        print_lines("these presses do not come to that: simulate the paper's whole set")
    return 1 if missed else 0


def fit_sensor_command(
    store: Path, out: Path, recording: Path, *, sensor: str, touches: int | None, held_rows: int
) -> int:
    """Fit one specimen to a recorded sensor on a store of presses, and write it.

    Returns:
        1 if the presses do not explain the electrodes.
    """
    check_output(out, "--out", ".json", store, recording)
    if touches is not None and touches < 0:
        raise ConfigError(f"{touches} touches", remedy="give 0 for the rest alone, or more")
    found = read_touches(recording, sensor=sensor, rows=held_rows, rest_alone=touches == 0)
    some = found.some(slice(0, len(found) if touches is None else touches))
    opened = SimulationStore.open(store)
    model = ElectrodeModel(geometry_of(opened.fingertip()))
    with progress_bar() as bar:
        task = bar.add_task("films", total=len(opened.ids()))
        library = read_library(opened, model, on_press=lambda: bar.advance(task))
        bar.update(task, description="fit", total=None, info="")
        fit = fit_sensor(
            model,
            library,
            some,
            on_round=lambda number, spread: bar.update(
                task, info=f"round {number}: electrodes deviate by {spread:.0f} counts"
            ),
        )
    member = fit.member(len(some))
    source = f"{len(some)} touches of {found.name} on {library.presses} simulated presses"
    write_population(out, [member], source=source)
    print_table(
        ("", found.name),
        [(label, f"{of(fit.specimen):.3g}") for label, of in ELECTRICAL],
        title=f"fitted to the rest and {len(some)} of {len(found)} touches",
        numbers_from=1,
    )
    lines = [f"counts at rest are left with {fit.rest_error:.0f} (root mean square)"]
    if fit.learned is not None:
        degrees = math.degrees(fit.angle_rad)
        lines += [
            f"forces of these touches are {degrees:.0f} degrees off the nearest presses (median)",
            f"electrodes of these touches deviate by {fit.learned.spread:.0f} counts",
        ]
    if fit.tells_nothing:
        lines.append(
            "these presses do not explain the electrodes: simulate more; if that does not help, "
            "check that they are E1..E19 in order, raw and live"
        )
    print_lines(*lines, f"wrote {out}")
    return 1 if fit.tells_nothing else 0


def show_units_command(file: Path | None, *, as_json: bool) -> None:
    """Print a population."""
    members = read_population(file)
    if as_json:
        typer.echo(json.dumps([member.to_dict() for member in members], indent=2))
    else:
        _show_members(members)


ELECTRICAL: tuple[tuple[str, Callable[[SpecimenParameters], float]], ...] = (
    ("conductivity [S/m]", lambda one: one.sigma_s_m),
    ("series impedance [Ohm]", lambda one: one.series_ohm),
    ("film closed by the clamp [1]", lambda one: one.clamp_closing),
    ("sides closer to the core by [mm]", lambda one: one.side_closing_m * 1e3),
    ("core displaced distally by [mm]", lambda one: one.core_offset_m[0] * 1e3),
    ("core displaced to the left by [mm]", lambda one: one.core_offset_m[1] * 1e3),
    ("core displaced upwards by [mm]", lambda one: one.core_offset_m[2] * 1e3),
    ("film of an unloaded contact [um]", lambda one: one.asperity_m * 1e6),
    ("film at infinite pressure [um]", lambda one: one.floor_m * 1e6),
    ("squeeze pressure [kPa]", lambda one: one.squeeze_pa * 1e-3),
    ("squeeze exponent [1]", lambda one: one.squeeze_exponent),
)
"""What specimens differ in, for people."""

DRAWN = (
    *ELECTRICAL,
    ("noise [counts]", lambda one: one.noise_counts),
    ("warms up by [K]", lambda one: one.heating_k),
    ("with a time constant of [s]", lambda one: one.heating_tau_s),
)


def draw_units_command(count: int, seed: int, out: Path | None, *, as_json: bool) -> None:
    """Draw specimens, write them, and print how their parameters spread."""
    check_output(out, "--out", ".json")
    members = draw_members(count, seed)
    if out is not None:
        write_population(out, members, source=f"{count} drawn with seed {seed}")
    if as_json:
        typer.echo(json.dumps([member.to_dict() for member in members], indent=2))
        return
    print_table(
        ("", "5 %", "median", "95 %"),
        [
            (
                label,
                *(
                    f"{value:.3g}"
                    for value in np.percentile(
                        [of(member.specimen) for member in members], [5, 50, 95]
                    )
                ),
            )
            for label, of in DRAWN
        ],
        title=f"{count} specimens drawn with seed {seed}",
        numbers_from=1,
    )
    if out is not None:
        print_lines(f"wrote {out}")


def _show_members(members: Sequence[Member]) -> None:
    rows: list[tuple[str, Callable[[Member], str]]] = [
        ("lowest tared value", lambda m: _against(m, "low")),
        ("highest tared value", lambda m: _against(m, "high")),
        ("largest force [N]", lambda m: _against(m, "max_force_n")),
        ("pressed deeper by [mm]", lambda m: f"{m.overtravel_m * 1e3:.1f}"),
        ("conductivity [S/m]", lambda m: f"{m.specimen.sigma_s_m:.3f}"),
        ("sides closer to the core by [mm]", lambda m: f"{m.specimen.side_closing_m * 1e3:.2f}"),
        ("squeeze pressure [kPa]", lambda m: f"{m.specimen.squeeze_pa * 1e-3:.1f}"),
        ("film at infinite pressure [um]", lambda m: f"{m.specimen.floor_m * 1e6:.1f}"),
    ]
    print_table(
        ("", *(member.specimen.name for member in members)),
        [(label, *(value(member) for member in members)) for label, value in rows],
        title="specimens: found (published)",
        numbers_from=1,
    )


def _against(member: Member, key: str) -> str:
    """What was found and, in brackets, published; a drawn specimen has neither."""
    if member.published is None:
        return "-"
    form = ".1f" if key == "max_force_n" else ".3f"
    found = format(member.found[key], form) if key in member.found else "-"
    return f"{found} ({getattr(member.published, key)})"
