"""Write docs/pictures/field.png: a press as simulated, and as estimated from 19 electrodes.

``python docs/make_field_picture.py``

The press is one of the 18 trajectories of the shipped sample, which the shipped network was not
trained on: the last row of the trial whose displacement error is the median of all trials.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

from palpate.files.bundle import read_bundle
from palpate_services.inference.model import load
from palpate_services.inference.repository import resolve
from palpate_training.datasets.experiment import MixedDataset, read_mixed
from palpate_training.figures.skin import paint_outer
from palpate_training.figures.style import INK, MM, finish, label, new_figure
from palpate_training.learning.contact_code import spread_forces
from palpate_training.tasks.fields import tared_counts

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "training" / "palpate_training" / "samples" / "twin.h5"
PICTURE = ROOT / "docs" / "pictures" / "field.png"

Floats = npt.NDArray[np.floating]


def main() -> None:
    """Estimate, choose, draw."""
    data = read_mixed(SAMPLE)
    bundle = read_bundle(resolve("field-twin"))
    runtime = load(bundle, "field")
    trial = data.experiment.trial
    rows = np.flatnonzero(np.append(trial[1:] != trial[:-1], True))
    outputs = [runtime.run(counts) or {} for counts in tared_counts(data)[rows]]
    moved = np.stack([one["displacement"].reshape(-1, 3) for one in outputs])
    errors = np.linalg.norm(moved - data.displacement(rows), axis=2).mean(axis=1)
    middle = int(np.argsort(errors)[len(errors) // 2])
    row = int(rows[middle])
    force = outputs[middle]["contact_force"].reshape(-1, 3)
    draw(data, row, moved[middle], force, 1e3 * float(errors[middle]), len(rows))
    sys.stdout.write(f"wrote {PICTURE}\n")


def draw(
    data: MixedDataset, row: int, moved: Floats, force: Floats, error_mm: float, trials: int
) -> None:
    """Truth, estimate and error of both fields, from below."""
    mesh = data.mesh
    outer = mesh.outer_nodes
    truth = data.displacement(np.array([row]))[0]
    pressing = np.zeros_like(truth)
    pressing[outer] = spread_forces(data, np.array([row]))[0]
    area = mesh.areas(mesh.outer_faces)
    kilopascal = 1e-3 / np.where(area > 0, area, np.inf)
    panels = {
        "displacement [mm]": [
            MM * np.linalg.norm(each, axis=1) for each in (truth, moved, moved - truth)
        ],
        "contact pressure [kPa]": [
            kilopascal * np.linalg.norm(each, axis=1)
            for each in (pressing, force, force - pressing)
        ],
    }
    experiment = data.experiment
    number = experiment.trial[row]
    name = experiment.trajectories[experiment.trial_trajectory[number]]
    unit = experiment.unit_names[experiment.trial_unit[number]]
    net, wanted = force.sum(axis=0), pressing.sum(axis=0)
    text = (
        f"{name} on {unit}, {np.linalg.norm(wanted):.1f} N: of {trials} presses that the network"
        f" has not seen, the one with the median error, {error_mm:.3f} mm over all nodes; net force"
        f" {np.linalg.norm(net - wanted):.2f} N off. Contact forces are spread over 1.5 mm."
    )
    figure = new_figure(11.5, 6.0)
    axes = figure.subplots(len(panels), 3)
    for line, (title, each) in zip(axes, panels.items(), strict=True):
        top = max(float(values[outer].max()) for values in each)
        drawn = None
        for panel, values, what in zip(line, each, ("truth", "estimate", "error"), strict=True):
            drawn = paint_outer(panel, mesh, values, top)
            panel.invert_yaxis()
            x_name = "x, distal [mm]" if line[0] is axes[-1, 0] else ""
            y_name = "y, lateral [mm]" if panel is line[0] else ""
            label(panel, x_name, y_name, f"{title.partition(' [')[0]}: {what}")
        bar = figure.colorbar(drawn, ax=line, shrink=0.85, pad=0.01)
        bar.set_label(title, color=INK, fontsize=9)
        bar.ax.tick_params(colors=INK, labelsize=8)
    finish(figure, PICTURE, "A press from 19 electrodes", text)


if __name__ == "__main__":
    main()
