"""The page of a data set: statistics, pictures, and the command that made it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from palpate.errors import DatasetError
from palpate.files.atomic import written_whole
from palpate_training.twin.content import ExperimentDataset, MixedDataset
from palpate_training.twin.hdf5 import content_sha256
from palpate_training.twin_figures.contact import draw_contacts
from palpate_training.twin_figures.electrodes import draw_electrode_boxes
from palpate_training.twin_figures.force import draw_force_boxes
from palpate_training.twin_figures.idle import IdleStream
from palpate_training.twin_figures.motion import draw_motion, motion_share
from palpate_training.twin_figures.noise import draw_noise
from palpate_training.twin_figures.plate import PlateLog, plate_response
from palpate_training.twin_figures.signs import draw_signs, flat_presses
from palpate_training.twin_figures.statistics import (
    PAPER_UNITS,
    DatasetStatistics,
    dataset_statistics,
)
from palpate_training.twin_figures.tables import (
    electrode_table,
    group_table,
    noise_table,
    sign_table,
    size_table,
    unit_table,
)

PAGE = "statistics.md"


@dataclass(frozen=True, slots=True)
class Sources:
    """What a page is made from.

    Attributes:
        experiment: The purely experimental data set.
        mixed: The mixed one; None leaves out skin motion, and the skin under the contacts.
        idle: Untouched streams of the twin, of real sensors, or both; empty leaves out noise.
        plate: Logs of a real sensor under a plate; empty leaves out the sign pattern.
    """

    experiment: ExperimentDataset
    mixed: MixedDataset | None = None
    idle: tuple[IdleStream, ...] = ()
    plate: tuple[PlateLog, ...] = ()


def write_page(
    folder: Path,
    sources: Sources,
    *,
    command: str,
    on_step: Callable[[str], None] = lambda step: None,
) -> DatasetStatistics:
    """Write ``statistics.md`` and its pictures.

    Args:
        folder: Where to; made if it is not there.
        sources: What to show.
        command: The command line that made it.
        on_step: Called with a word before each part.

    Returns:
        The statistics.

    Raises:
        DatasetError: A unit of the data set has no trial, a stream is too short, or the
            disk refused.
    """
    data = sources.experiment
    on_step("statistics")
    statistics = dataset_statistics(data)
    unused = [unit for unit in data.unit_names if unit not in {u.name for u in statistics.units}]
    if unused:
        raise DatasetError(
            f"there is no trial of {', '.join(unused)}",
            remedy="generate or ingest trials of every unit that the data set names",
        )
    # The paper's BioTacs have no names; ours are put beside them in order.
    paper = [i if i < len(PAPER_UNITS) else None for i in range(len(data.unit_names))]
    parts = [
        "# Statistics of a data set of the experiment\n",
        f"Made by `{command}`.\n",
        _provenance(data),
        "## Size\n",
        size_table(statistics),
        "## Units\n",
        unit_table(statistics.units, paper),
        "The normal of the last line is that of the core's form under the indenter's tip, so it is"
        " a rough number for long and flat indenters.\n",
    ]
    on_step("contact locations")
    mesh = sources.mixed.mesh if sources.mixed is not None else None
    parts += ["## Contact locations\n"]
    parts += _picture("contacts.png", draw_contacts(folder / "contacts.png", data, mesh))
    on_step("force")
    parts += ["## Force\n"]
    parts += _picture("force.png", draw_force_boxes(folder / "force.png", data))
    on_step("electrodes")
    parts += ["## Electrodes\n"]
    parts += _picture("electrodes.png", draw_electrode_boxes(folder / "electrodes.png", data))
    parts += [
        "Targets: real sensors, dominated by light contacts.\n",
        group_table(statistics.units),
        electrode_table(statistics.units),
    ]
    if sources.mixed is not None:
        on_step("skin motion")
        parts += _motion(folder, sources.mixed)
    if sources.idle:
        on_step("noise and drift")
        parts += _noise(folder, sources.idle)
    if sources.plate:
        on_step("sign pattern")
        parts += _signs(folder, data, sources.plate)
    _write(folder / PAGE, "\n".join(parts))
    return statistics


def _motion(folder: Path, mixed: MixedDataset) -> list[str]:
    share = motion_share(mixed)
    text = draw_motion(folder / "motion.png", mixed.mesh, share, len(mixed))
    loss = (
        f"Fields are kept as {len(mixed.basis.modes)} coefficients a row; that loses"
        f" {1e6 * mixed.basis.loss_mean_m:.3g} um in the mean and at most"
        f" {1e6 * mixed.basis.loss_max_m:.3g} um of any node.\n"
    )
    return ["## Skin motion\n", *_picture("motion.png", text), loss]


def _noise(folder: Path, streams: Sequence[IdleStream]) -> list[str]:
    text = draw_noise(folder / "noise.png", streams)
    missing = (
        [] if any(not s.real for s in streams) else ["No idle stream of the twin was given.\n"]
    )
    return [
        "## Noise and drift\n",
        *missing,
        *_picture("noise.png", text),
        noise_table(streams),
        "Median of the 19 electrodes, in brackets lowest to highest; drift: slope of a line over"
        " the whole stream; in common: share of the squared change that one course common to all"
        " electrodes explains.\n",
    ]


def _signs(folder: Path, data: ExperimentDataset, logs: Sequence[PlateLog]) -> list[str]:
    real = plate_response(logs)
    if real is None:
        return ["## Rise and fall\n", "No log has a ventral plate on the pad.\n"]
    presses = flat_presses(data)
    text = draw_signs(folder / "signs.png", real, presses)
    return ["## Rise and fall\n", *_picture("signs.png", text), sign_table(real, presses)]


def _picture(name: str, text: str) -> list[str]:
    return [f"![{name.removesuffix('.png')}]({name})\n", f"*{text}*\n"]


def _provenance(data: ExperimentDataset) -> str:
    where = data.provenance
    made_by = f"`{where.command}`" if where.command else "-"
    lines = [
        f"* source: {where.source}",
        f"* data set made by: {made_by} (palpate {where.palpate_version})",
        f"* content sha256: {content_sha256(data)}",
        f"* input sha256: {where.input_sha256 or '-'}",
        f"* licence: {where.licence}",
        f"* notes: {where.notes or '-'}",
    ]
    return "\n".join(lines) + "\n"


def _write(path: Path, text: str) -> None:
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")
