"""Write docs/results/twin/plate.md: the twin under a plate that is tilted as the real one was.

``python docs/make_plate_signs.py FOLDER`` takes the folder of public data. Of the real logs it
takes how the plate was tilted (quartiles about y, the median about x) and how far the fluid's
pressure rose; the twin's two units that were pressed with cubes are pressed by a plate alike.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.rigid import rotation_matrices
from palpate_deploy.experiment import parameters_of
from palpate_fem.indenter.catalogue import make_indenter
from palpate_fem.mechanics.load_stepping import SolverSettings
from palpate_fem.mechanics.solver import Fingertip
from palpate_fem.mesh.parametric import biotac
from palpate_fem.population.members import read_population
from palpate_fem.population.responses import Population
from palpate_fem.service.biotac import BiotacTip
from palpate_training.experiment.generate.simulator import ExperimentSpec
from palpate_training.figures.plate import (
    TOUCHED_COUNTS,
    VENTRAL_COS,
    agreement,
    plate_response,
    read_plate_logs,
    signs,
)

Floats = NDArray[np.float64]

OUT = Path(__file__).parent / "results" / "twin" / "plate.md"
PLATE = make_indenter("plate")
STEP_M = 1e-4
STEPS = 34
PDC_PA = 36.5
"""Pressure of one count of PDC [Pa]."""
WORDS = {1: "rises", -1: "falls", 0: "-"}

HEAD = """# Under a plate: the twin beside the real sensor

Made by `python docs/make_plate_signs.py ../shared/data`. Real: {samples:,} samples of {logs} logs
of one BioTac under a flat plate within 20 degrees of the pad's normal; the plate leaned by
{low:.1f}, {middle:.1f} and {high:.1f} degrees (quartiles; negative = its tip end higher) and by
{roll:.1f} to the side, and PDC rose by {p_low:.1f} to {p_high:.1f} kPa. Twin: a plate of
40 x 24 mm at these three tilts, mean over the steps with the same rise of the fluid's pressure.
Tared counts over full scale; nearer to zero than 0.005 is undecided. Nothing was fitted to this.

"""


def tilts(folder: Path) -> tuple[Floats, float, Floats]:
    """Quartiles of the lean towards the tip, median to the side [rad], range of pressure [Pa]."""
    leans, sides, rises = [], [], []
    for log in read_plate_logs(folder):
        values, often = np.unique(log.pdc, return_counts=True)
        above = log.pdc - values[np.argmax(often)]
        there = (above > TOUCHED_COUNTS) & (log.normal[:, 2] > VENTRAL_COS)
        normal = log.normal[there]
        leans.append(np.arctan2(normal[:, 0], normal[:, 2]))
        sides.append(np.arctan2(normal[:, 1], normal[:, 2]))
        rises.append(above[there] * PDC_PA)
    lean = np.percentile(np.concatenate(leans), [25, 50, 75])
    rise = np.percentile(np.concatenate(rises), [0, 100])
    return lean, float(np.median(np.concatenate(sides))), rise


def path_at(nodes: Floats, lean: float, side: float) -> Floats:
    """Poses (K, 7) of a plate that leans so and moves along its normal, from just clear."""
    # +z turned towards +x by the lean, then towards +y by the side.
    half_y, half_x = lean / 2, -side / 2
    w = np.cos(half_y) * np.cos(half_x)
    quaternion = np.array(
        [
            w,
            np.cos(half_y) * np.sin(half_x),
            np.sin(half_y) * np.cos(half_x),
            -np.sin(half_y) * np.sin(half_x),
        ]
    )
    normal = rotation_matrices(quaternion)[:, 2]
    low = float((nodes @ normal).min())
    centre = np.array([-5e-3, 0.0, 0.0])
    centre += normal * (low - 2e-6 - centre @ normal)
    return np.array([[*(centre + normal * STEP_M * k), *quaternion] for k in range(STEPS)])


def main(folder: Path) -> None:
    """Press, compare, write."""
    real = plate_response(read_plate_logs(folder))
    if real is None:
        raise SystemExit(f"no contact-normal logs in {folder}")
    leans, side, rises = tilts(folder)
    spec = ExperimentSpec()
    geometry = biotac(edge_m=spec.edge_m, layers=2)
    tip = Fingertip.pressurised(geometry, parameters_of(spec), SolverSettings())
    members = [member for member in read_population() if member.pressed_with("cube")]
    population = Population(BiotacTip(tip).describe(), [member.specimen for member in members])
    found: dict[str, list[Floats]] = {member.specimen.name: [] for member in members}
    for lean in leans:
        steps = tip.indent(PLATE, path_at(tip.nodes, lean, side)).steps
        rise = np.array([step.fluid_pressure_pa for step in steps]) - tip.fluid_pressure_pa
        chosen = [step for step, p in zip(steps, rise, strict=True) if rises[0] <= p <= rises[1]]
        for name, counts in population.counts(chosen).items():
            found[name].append((counts - population.rest_counts[name]).mean(axis=0) / 4095)
    twin = {name: np.mean(values, axis=0) for name, values in found.items()}
    low, middle, high = np.degrees(leans)
    lines = [
        HEAD.format(
            samples=real.samples, logs=real.logs, low=low, middle=middle, high=high,
            roll=np.degrees(side), p_low=rises[0] / 1e3, p_high=rises[1] / 1e3,
        )
    ]  # fmt: skip
    names = ["real", *twin]
    columns = [real.tared, *twin.values()]
    lines += [f"| electrode | {' | '.join(names)} |\n", "|---|" + "---:|" * len(names) + "\n"]
    for k in range(len(real.tared)):
        words = [f"{WORDS[int(signs(one)[k])]} ({one[k]:+.3f})" for one in columns]
        lines.append(f"| E{k + 1} | {' | '.join(words)} |\n")
    agreeing = [agreement(real.tared, column) for column in twin.values()]
    cells = [f"**{same} of {decided}**" for same, decided in agreeing]
    lines.append(f"| same sign | | {' | '.join(cells)} |\n")
    OUT.write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
