"""``palpate fem recover``: does calibration find the parameters of simulated, noisy forces?"""

from __future__ import annotations

import json
from dataclasses import replace

import typer
from rich.console import Console
from rich.table import Table

from palpate_fem.calibration.plan import plan_recovery
from palpate_fem.calibration.recover import Recovery, recover
from palpate_fem.calibration.result import Evaluation
from palpate_fem.cli.calibrate import simulator_for
from palpate_fem.cli.model import Model
from palpate_fem.cli.show import progress_bar
from palpate_fem.config import EDGE_M, FingertipParameters
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac

# Away from the defaults, so that nothing is found by not moving.
PLANTED = FingertipParameters(
    skin_thickness_m=1.45e-3, shear_modulus_pa=3.3e5, friction_coefficient=0.25
)
HEADINGS = ("parameter", "planted", "found", "error", "deviation", "tolerance", "")


def recover_command(
    model: Model, *, edge_mm: float | None, noise_n: float, seed: int, workers: int, as_json: bool
) -> int:
    """Plant, simulate, add noise, calibrate, compare.

    Args:
        model: Mesh of the calibration; its parameters are not used.
        edge_mm: Edge of that mesh on the pad [mm]; None = the default mesh.
        noise_n: Standard deviation of the noise of each axis [N].
        seed: Of the noise.
        workers: Processes that solve.
        as_json: Print JSON instead of a table.

    Returns:
        0, or 1 if a parameter is farther off than its tolerance.
    """
    geometry = biotac(
        thickness_m=PLANTED.skin_thickness_m, edge_m=EDGE_M if edge_mm is None else edge_mm * 1e-3
    )
    planned = plan_recovery(Fingertip.pressurised(geometry, replace(PLANTED)))
    with (
        simulator_for(model, workers, len(planned)) as (simulator, executor),
        progress_bar() as bar,
    ):
        task = bar.add_task("simulate", total=None, info="")

        def on_evaluation(evaluation: Evaluation) -> None:
            bar.update(
                task,
                info=f"{evaluation.stage}: cost {evaluation.cost:.3f} N after "
                f"{evaluation.simulations} runs",
            )

        recovery = recover(
            simulator,
            PLANTED,
            planned,
            noise_n,
            seed,
            executor=executor,
            on_evaluation=on_evaluation,
            on_run=lambda done, total: bar.update(task, completed=done, total=total),
        )
    if as_json:
        typer.echo(json.dumps(_plain(recovery, noise_n, seed), indent=1))
    else:
        table = Table(title=f"planted and found, noise {noise_n:g} N, seed {seed}")
        for heading in HEADINGS:
            table.add_column(heading)
        for row in recovery.rows():
            table.add_row(*row)
        Console().print(table)
        for name, why in recovery.calibration.excluded.items():
            Console().print(f"left out: {name}: {why}", markup=False, highlight=False)
    return 0 if recovery.passed else 1


def _plain(recovery: Recovery, noise_n: float, seed: int) -> dict[str, object]:
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
        "largest_force_n": {item.name: float(abs(item.force).max()) for item in recovery.measured},
    }
