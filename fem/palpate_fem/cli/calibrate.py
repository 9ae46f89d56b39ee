"""``palpate fem calibrate`` and ``palpate fem validate``: simulated against measured forces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.table import Table

from palpate.errors import ConfigError
from palpate_fem.calibration.calibrate import calibrate
from palpate_fem.calibration.measured import SIMULATED, Indentation
from palpate_fem.calibration.result import Calibration, Evaluation, write_calibration
from palpate_fem.calibration.runs import Simulated, simulate_all
from palpate_fem.cli.model import Model, workers_for
from palpate_fem.cli.show import console, progress_bar
from palpate_fem.plot.validation import plot_calibration, plot_examples, plot_indenters
from palpate_fem.service.pool_simulator import PoolSimulator
from palpate_fem.store.read import SimulationStore
from palpate_fem.validation.report import (
    INDENTER_HEADINGS,
    indenter_rows,
    summary_lines,
    write_report,
)
from palpate_fem.validation.simulated import measured_from, simulated_from
from palpate_fem.validation.validate import validate

CALIBRATION_HEADINGS = ("parameter", "value", "deviation", "force per 1 %", "bounds", "remark")
_LIMIT_S = 900.0  # of one run; the slowest trajectory takes a tenth of it


def calibrate_command(
    measured: Path,
    out: Path,
    only: Sequence[str],
    model: Model,
    *,
    png: Path | None,
    workers: int,
) -> int:
    """Calibrate and write the result.

    Returns:
        0, or 1 if the search did not arrive.

    Raises:
        DatasetError: The file is damaged, or nothing in it can be compared.
        SimulationError: No simulation can be compared with its measurement.
        ConfigError: No trajectory is left.
    """
    chosen = _chosen(measured, only)
    with simulator_for(model, workers, len(chosen)) as (simulator, executor), progress_bar() as bar:
        task = bar.add_task("simulate", total=None, info="")

        def on_evaluation(evaluation: Evaluation) -> None:
            bar.update(
                task,
                info=f"{evaluation.stage}: cost {evaluation.cost:.3f} N after "
                f"{evaluation.simulations} runs",
            )

        result = calibrate(
            simulator,
            chosen,
            executor=executor,
            on_evaluation=on_evaluation,
            on_run=lambda done, total: bar.update(task, completed=done, total=total),
        )
    write_calibration(out, result)
    _show_calibration(result, out)
    if png is not None:
        plot_calibration(result, png)
    return 0 if result.converged else 1


def validate_command(
    measured: Path,
    out: Path,
    only: Sequence[str],
    model: Model,
    *,
    store: Path | None,
    workers: int,
) -> int:
    """Compare and write table and plots.

    Returns:
        0, or 1 if nothing could be compared.

    Raises:
        DatasetError: A file is damaged.
        ConfigError: No trajectory is left.
    """
    chosen = _chosen(measured, only)
    refused: dict[str, str] = {}
    if store is not None:
        simulated, refused = simulated_from(SimulationStore.open(store), chosen)
    else:
        simulated = _simulated(chosen, model, workers)
    result = validate(chosen, simulated)
    shown = Console()
    for name, why in refused.items():
        shown.print(f"{name}: {why}", markup=False, highlight=False, soft_wrap=True)
    if not result.compared:
        shown.print(*summary_lines(result), sep="\n", markup=False, highlight=False)
        return 1
    _table("", INDENTER_HEADINGS, indenter_rows(result))
    shown.print(*summary_lines(result), sep="\n", markup=False, highlight=False, soft_wrap=True)
    files = [*write_report(out, result), out / "examples.png", out / "indenters.png"]
    plot_examples(result, files[-2])
    plot_indenters(result, files[-1])
    names = ", ".join(file.name for file in files)
    shown.print(f"wrote {out}: {names}", markup=False, highlight=False, soft_wrap=True)
    return 0


def _simulated(chosen: Sequence[Indentation], model: Model, workers: int) -> dict[str, Simulated]:
    with simulator_for(model, workers, len(chosen)) as (simulator, executor), progress_bar() as bar:
        task = bar.add_task("simulate", total=None)
        return simulate_all(
            simulator,
            model.parameters,
            chosen,
            executor=executor,
            on_run=lambda done, total: bar.update(task, completed=done, total=total),
        )


def _chosen(measured: Path, only: Sequence[str]) -> list[Indentation]:
    """Trajectories of the file whose name begins with one of ``only``; without, all."""
    found, left_out = measured_from(measured)
    for name, why in left_out.items():
        console.print(f"left out: {name}: {why}", markup=False, highlight=False, soft_wrap=True)
    chosen = [
        item for item in found if not only or any(item.name.startswith(start) for start in only)
    ]
    if not chosen:
        raise ConfigError(
            f"no trajectory of {measured} begins with {' or '.join(only) or 'anything'}",
            remedy=f"there are e.g. {', '.join(item.name for item in found[:3]) or 'none'}",
        )
    if any(item.origin == SIMULATED for item in chosen):
        console.print(
            "these forces are simulated, not measured: this tests the method, not the model"
        )
    return chosen


@contextmanager
def simulator_for(
    model: Model, workers: int, jobs: int
) -> Iterator[tuple[PoolSimulator, ThreadPoolExecutor]]:
    """Worker processes, and as many threads that wait for them."""
    count, threads = workers_for(workers, jobs)
    with (
        PoolSimulator(
            model.setup(keep=2), workers=count, threads=threads, limit_s=_LIMIT_S
        ) as simulator,
        ThreadPoolExecutor(count) as executor,
    ):
        try:
            yield simulator, executor
        except BaseException:
            simulator.close()  # first: the executor waits for its threads, and they for it
            raise


def _show_calibration(result: Calibration, out: Path) -> None:
    title = "calibrated" if result.converged else "the search did not arrive"
    _table(title, CALIBRATION_HEADINGS, result.rows())
    lines = [
        f"cost {result.cost:.4g} N, {result.thickness_m * 1e3:.2f} mm thick, "
        f"{result.simulations} runs; wrote {out}",
        *(f"left out: {name}: {why}" for name, why in result.excluded.items()),
        *(f"note: {note}" for note in result.notes),
    ]
    Console().print(*lines, sep="\n", markup=False, highlight=False, soft_wrap=True)


def _table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    table = Table(title=title or None)
    for heading in headings:
        table.add_column(heading)
    for row in rows:
        table.add_row(*row)
    Console().print(table)
