"""An invented population: electrodes of specimens differ by one gain, which only presses tell."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from palpate.anatomy import ELECTRODE_MIRROR
from palpate_training.datasets.container import Provenance
from palpate_training.datasets.features import FeatureDataset
from palpate_training.learning.electrode_nets import MIRROR_AXES
from palpate_training.learning.population_net import PopulationConfig

Floats = npt.NDArray[np.float64]

SPECIMENS, PRESSES, ROWS = 16, 40, 8
SMALL = PopulationConfig(
    epochs=50,
    batch_rows=64,
    threads=1,
    width=32,
    blocks=1,
    told_width=16,
    press_width=32,
    code=8,
    gain_sd=0.0,
    stiffness_sd=0.0,
    common_sd=0.05,
    offset_sd=0.01,
    force_power=0.75,
)


def pattern(force: Floats, place: Floats) -> Floats:
    """Change of the logarithms of the impedance of a specimen of gain 1, (N, 19).

    The mirror image of a force at the mirrored place gives the mirror image.
    """
    weight = np.random.default_rng(7).normal(0.0, 0.06, (2, 3, 19))
    weight = 0.5 * (weight + MIRROR_AXES[:, None] * weight[:, :, ELECTRODE_MIRROR])
    length = np.linalg.norm(force, axis=1, keepdims=True)
    return np.asarray(force @ weight[0] + length * (200.0 * place @ weight[1]))


def population(
    *,
    specimens: int = SPECIMENS,
    presses: int = PRESSES,
    each: int = 4,
    gain_sd: float = 0.4,
) -> FeatureDataset:
    """Each press on some specimens, whose gain the electrodes at rest do not tell."""
    rng = np.random.default_rng(0)
    gain = np.exp(rng.normal(0.0, gain_sd, specimens))
    columns: dict[str, list[npt.NDArray[np.generic]]] = {
        name: [] for name in ("electrodes", "baseline", "force", "group", "sensor", "location")
    }
    for press in range(presses):
        place = rng.uniform(-1.0, 1.0, 3) * np.array([6.0, 4.0, 2.0]) * 1e-3
        most = rng.uniform(1.0, 5.0) * np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.7, 3)
        force = np.linspace(0.0, 1.0, ROWS)[:, None] * most
        for specimen in rng.choice(specimens, each, replace=False):
            ratio = 0.5 * np.exp(rng.normal(0.0, 0.01, 19))
            logs = gain[specimen] * pattern(force, place)
            counts = np.rint(4095.0 / (1.0 + ratio * np.exp(logs)))
            columns["electrodes"].append(counts.astype(np.uint16))
            columns["baseline"].append(np.tile(4095.0 / (1.0 + ratio), (ROWS, 1)))
            columns["force"].append(force)
            columns["group"].append(np.full(ROWS, press))
            columns["sensor"].append(np.full(ROWS, specimen))
            columns["location"].append(np.tile(place, (ROWS, 1)))
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    return FeatureDataset(
        electrodes=joined["electrodes"].astype(np.uint16),
        baseline=joined["baseline"].astype(np.float32),
        force=joined["force"].astype(np.float32),
        group=joined["group"].astype(np.int32),
        block=joined["group"].astype(np.int32),
        sensor=joined["sensor"].astype(np.int32),
        sensor_names=tuple(f"unit-{number:03d}" for number in range(specimens)),
        provenance=Provenance("invented", "", "", "", ""),
        contact_location=joined["location"].astype(np.float32),
        in_contact=np.linalg.norm(joined["force"], axis=1) > 0.0,
    )
