"""The page of a study: every table beside the paper's numbers, as Markdown and as HTML.

Both are made from the JSON alone, so the documents of the repository can be made again without the
data.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.files.atomic import written_whole
from palpate_training.figures.style import markdown_table
from palpate_training.learning.splits import ALL_UNITS, SplitName

Row = Mapping[str, Any]

SPLIT_WORDS = {
    "trajectory": "Unseen trajectory, on whatever unit",
    "execution": "Unseen execution: the same press may have been seen on another unit",
    "point": "Unseen point, with all its presses",
    "indenter": "Unseen indenter",
    "block": "Unseen blocks of 18 s: every fifth is tested, five times in turn",
    "tail": "The last 20 % of each recording",
    "touch": "Unseen touches: every fifth is tested, five times in turn",
    "log": "Unseen logs, of another time",
    "unit": "Unseen BioTac, nothing calibrated",
    "neighbour": "Not a result: neighbouring rows in training, which shows what is left to gain",
}

FLOOR: SplitName = "neighbour"
FLOOR_WORDS = "*not a result*, neighbouring rows in training"

TASK_WORDS = {
    "location": "Contact location",
    "force": "Force",
    "centre": "Centre of pressure",
    "normal": "Contact normal",
    "field": "Displacement of the skin",
    "synthesis": "Electrodes from the skin",
}


@dataclass(frozen=True, slots=True)
class Column:
    """A metric as a table shows it: name in the JSON, unit, factor to that unit, digits."""

    metric: str
    unit: str
    factor: float
    digits: int
    title: str

    def cell(self, row: Row) -> str:
        """The value, with its interval where there is one."""
        value = row["metrics"].get(self.metric)
        if value is None:
            return "-"
        text = f"{value * self.factor:.{self.digits}f}"
        ends = row["intervals"].get(self.metric)
        if ends is not None and None not in ends:
            low, high = (f"{end * self.factor:.{self.digits}f}" for end in ends)
            text += f" ({low}-{high})"
        return text


HEADLINES: dict[str, tuple[Column, ...]] = {
    "location": (Column("distance_m_median", "mm", 1e3, 2, "median distance"),),
    "centre": (Column("distance_m_median", "mm", 1e3, 2, "median distance"),),
    "force": (
        Column("magnitude_n_median", "N", 1.0, 3, "median error of the magnitude"),
        Column("angle_rad_median", "rad", 1.0, 3, "median angle"),
    ),
    "normal": (Column("angle_rad_median", "rad", 1.0, 3, "median angle"),),
    "field": (
        Column("subset_m_mean", "mm", 1e3, 3, "mean of the 128 nodes"),
        Column("all_m_mean", "mm", 1e3, 3, "mean of all nodes"),
    ),
    "synthesis": (
        Column("rmse_counts", "counts", 1.0, 1, "root mean square"),
        Column("l2_counts_median", "counts", 1.0, 0, "median norm in R^19"),
    ),
}
"""One table of systems by tests for each."""

DETAILS: dict[str, tuple[Column, ...]] = {
    "location": tuple(
        Column(f"distance_m_{name}", "mm", 1e3, 2, title)
        for name, title in (
            ("mean", "mean"),
            ("iqr", "IQR"),
            ("median_below_2n", "below 2 N"),
            ("median_2_to_8n", "2-8 N"),
            ("median_above_8n", "above 8 N"),
            ("median_normal_presses", "normal presses"),
            ("median_angled_presses", "angled presses"),
            ("median_reweighted", "re-weighted"),
        )
    ),
    "force": (
        Column("magnitude_n_mean", "N", 1.0, 3, "mean"),
        Column("magnitude_n_median_reweighted", "N", 1.0, 3, "re-weighted"),
        Column("magnitude_over_norm_median_below_2n", "%", 100.0, 1, "below 2 N"),
        Column("magnitude_over_norm_median_2_to_8n", "%", 100.0, 1, "2-8 N"),
        Column("magnitude_over_norm_median_above_8n", "%", 100.0, 1, "above 8 N"),
        Column("magnitude_n_median_from_2n", "N", 1.0, 3, "from 2 N"),
        Column("angle_rad_median_from_2n", "rad", 1.0, 3, "angle from 2 N"),
        Column("one_minus_cos_median", "-", 1.0, 4, "1 - cos"),
    ),
    "field": (
        Column("moving_m_mean", "mm", 1e3, 3, "moving nodes"),
        Column("max_m_mean", "mm", 1e3, 2, "worst node"),
        Column("all_m_mean_below_2n", "mm", 1e3, 3, "all, below 2 N"),
        Column("all_m_mean_2_to_8n", "mm", 1e3, 3, "all, 2-8 N"),
        Column("all_m_mean_above_8n", "mm", 1e3, 3, "all, above 8 N"),
    ),
    "synthesis": (
        Column("rmse", "-", 1.0, 4, "of full scale"),
        Column("rmse_counts_below_2n", "counts", 1.0, 1, "below 2 N"),
        Column("rmse_counts_2_to_8n", "counts", 1.0, 1, "2-8 N"),
        Column("rmse_counts_above_8n", "counts", 1.0, 1, "above 8 N"),
    ),
}
DETAILS["centre"] = DETAILS["location"]
DETAILS["normal"] = tuple(
    Column(f"angle_rad_{name}", "rad", 1.0, 3, title)
    for name, title in (
        ("mean", "mean"),
        ("iqr", "IQR"),
        ("median_below_2n", "below 2 N"),
        ("median_2_to_8n", "2-8 N"),
        ("median_above_8n", "above 8 N"),
    )
)

PAPER: dict[tuple[str, str, str], dict[str, str]] = {
    ("location", "trajectory", "distance_m_median"): {
        "biotac-1": "1.5", "biotac-2": "2.0", "biotac-3": "2.4", ALL_UNITS: "2.0",
    },
    ("location", "indenter", "distance_m_median"): {
        "biotac-2": "2.4", "biotac-3": "2.5", "biotac-2 + biotac-3": "2.4",
    },
    ("force", "trajectory", "magnitude_n_median"): {
        "biotac-1": "0.96", "biotac-2": "0.78", "biotac-3": "0.73", ALL_UNITS: "0.64",
    },
    ("force", "indenter", "magnitude_n_median"): {
        "biotac-2": "0.75", "biotac-3": "0.78", "biotac-2 + biotac-3": "0.64",
    },
    ("force", "trajectory", "angle_rad_median"): {
        "biotac-1": "0.14", "biotac-2": "0.15", "biotac-3": "0.12", ALL_UNITS: "0.15",
    },
    ("force", "indenter", "angle_rad_median"): {
        "biotac-2": "0.14", "biotac-3": "0.13", "biotac-2 + biotac-3": "0.15",
    },
    ("field", "trajectory", "subset_m_mean"): {
        "biotac-1": "0.21", "biotac-2": "0.20", "biotac-3": "0.25", ALL_UNITS: "0.22",
    },
    ("synthesis", "trajectory", "rmse_counts"): {
        "biotac-1": "80", "biotac-2": "73", "biotac-3": "66",
    },
    ("synthesis", "indenter", "rmse_counts"): {"biotac-2": "98", "biotac-3": "120"},
    ("synthesis", "trajectory", "l2_counts_median"): {
        "biotac-1": "225", "biotac-2": "166", "biotac-3": "187",
    },
    ("synthesis", "indenter", "l2_counts_median"): {"biotac-2": "161", "biotac-3": "274"},
}  # fmt: skip
"""Best network of the paper, on real BioTacs: MLP for location and angle, voxel network for the
magnitude, PointNet++ for field and electrodes."""

PAPER_LABEL = "*the paper, real BioTacs*"


@dataclass(frozen=True, slots=True)
class Table:
    """A heading of level 2 or 3 and a sentence, with a table below where there are rows.

    ``pictures`` are files with their captions.
    """

    level: int
    heading: str
    text: str = ""
    columns: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    pictures: tuple[tuple[str, str], ...] = ()


def tables_of(values: Mapping[str, Any]) -> Iterator[Table]:
    """All tables of a study, in order."""
    scores = values["scores"]

    def pictures(task: str) -> tuple[tuple[str, str], ...]:
        all_pictures = values.get("pictures", ())
        return tuple((one["file"], one["caption"]) for one in all_pictures if one["task"] == task)

    if pictures(""):
        yield Table(2, "How strong the presses are", pictures=pictures(""))
    for task in dict.fromkeys(row["task"] for row in scores):
        yield Table(2, TASK_WORDS[task], pictures=pictures(task))
        for split in dict.fromkeys(row["split"] for row in scores if row["task"] == task):
            mine = [row for row in scores if row["task"] == task and row["split"] == split]
            floor = [
                row
                for row in scores
                if row["task"] == task and row["split"] == FLOOR and split != FLOOR
            ]
            yield from _of_split(task, split, mine, floor)
    ratios = values.get("ratios", [])
    if ratios:
        yield Table(
            2,
            "Ours beside the best of the paper's networks",
            "Median error over that of the best of the paper's three networks in the same test, "
            "with its 95 % interval; below 1 ours is better.",
            ("quantity", "split", "test", "network", "rows", "ratio"),
            tuple(
                (
                    f"{TASK_WORDS[row['task']].lower()}, {row['error']}",
                    row["split"],
                    row["test"],
                    row["system"],
                    _force_range(row["least_n"], row["most_n"]),
                    _ratio(row),
                )
                for row in ratios
            ),
        )


def _ratio(row: Row) -> str:
    """The ratio with its interval; a test may have no row in the range of forces."""
    if row["ratio"] is None:
        return "-"
    return f"{row['ratio']:.2f} ({row['interval'][0]:.2f}-{row['interval'][1]:.2f})"


def _force_range(least_n: float, most_n: float | None) -> str:
    if most_n is not None:
        return f"below {most_n:g} N"
    return f"from {least_n:g} N" if least_n else "all"


def _of_split(task: str, split: str, rows: Sequence[Row], floor: Sequence[Row]) -> Iterator[Table]:
    tests = tuple(dict.fromkeys(row["test"] for row in rows))
    systems = tuple(dict.fromkeys(row["system"] for row in rows))
    found = {(row["system"], row["test"]): row for row in rows}
    left = {(row["system"], row["test"]): row for row in floor}
    floors = tuple(dict.fromkeys(row["test"] for row in floor))
    for number, column in enumerate(HEADLINES[task]):
        lines = [
            (
                system,
                *(column.cell(found[system, test]) if (system, test) in found else "-"
                  for test in tests),
                *(column.cell(left[system, test]) if (system, test) in left else "-"
                  for test in floors),
            )
            for system in systems
        ]  # fmt: skip
        known = PAPER.get((task, split, column.metric))
        if known:
            shown = (known.get(test, "-") for test in tests)
            lines.append((PAPER_LABEL, *shown, *("-" for _ in floors)))
        yield Table(
            3,
            SPLIT_WORDS[split] if number == 0 else f"{SPLIT_WORDS[split]}: {column.title}",
            f"{column.title[0].upper()}{column.title[1:]} [{column.unit}].",
            ("system", *tests, *(f"{FLOOR_WORDS}: {test}" for test in floors)),
            tuple(lines),
        )
    widest = ALL_UNITS if ALL_UNITS in tests else tests[-1]
    columns = DETAILS[task]
    yield Table(
        3,
        f"{SPLIT_WORDS[split]}: more of {widest}",
        "",
        ("system", *(f"{one.title} [{one.unit}]" for one in columns), "time [s]", "seeds"),
        tuple(
            (
                system,
                *(one.cell(found[system, widest]) for one in columns),
                f"{found[system, widest]['seconds']:.0f}",
                str(found[system, widest]["seeds"]),
            )
            for system in systems
            if (system, widest) in found
        ),
    )


def preface(values: Mapping[str, Any], command: str) -> list[str]:
    """Paragraphs on top: which data, and what the numbers are."""
    sources = "; ".join(dict.fromkeys(one["source"] for one in values["sources"]))
    rows = ", ".join(f"{count:,} {what}" for what, count in values["rows"].items())
    left = []
    if values.get("missing"):
        left = [
            f"**{values['missing']:,} of {values['trainings']:,} trainings are not made yet.** A "
            "system is left out of each test that lacks one of its trainings, and a ratio where "
            "one of the paper's three networks is left out."
        ]
    return [
        f"Data: **{sources}**; {rows}. Rows called the paper's are of its real BioTacs and its own "
        "data.",
        *left,
        f"Made by `{command}`.",
        "Brackets are 95 % intervals, whole trajectories (touches, blocks) drawn with replacement. "
        "A system that depends on a seed is shown as the mean over its seeds. Re-weighted medians "
        "give the forces the spread that they have in the paper.",
    ]


def write_pages(folder: Path, values: Mapping[str, Any], *, command: str) -> list[Path]:
    """Write ``report.md`` and ``report.html``; returns their paths.

    The pictures of the study are in the folder already (``Study.draw``).

    Raises:
        DatasetError: The disk refused.
    """
    tables = list(tables_of(values))
    paragraphs = preface(values, command)
    pages = {
        "report.md": _markdown(paragraphs, tables),
        "report.html": _html(paragraphs, tables, folder),
    }
    for name, text in pages.items():
        with written_whole(folder / name) as part:
            part.write_text(text, encoding="utf-8")
    return [folder / name for name in pages]


TITLE = "What systems estimate from a BioTac, in every split"


def _markdown(paragraphs: Sequence[str], tables: Sequence[Table]) -> str:
    parts = [f"# {TITLE}\n", *(f"{paragraph}\n" for paragraph in paragraphs)]
    for table in tables:
        parts.append(f"{'#' * table.level} {table.heading}\n")
        parts += [f"{table.text}\n"] * bool(table.text)
        parts += [f"![{caption}]({file})\n" for file, caption in table.pictures]
        if table.rows:
            parts.append(markdown_table(table.columns, table.rows))
    return "\n".join(parts)


_STYLE = """body{font:15px/1.45 system-ui,sans-serif;color:#30343b;max-width:78em;margin:2em auto;
padding:0 1em}table{border-collapse:collapse;margin:.6em 0 1.6em}td,th{padding:.2em .7em;
border-bottom:1px solid #e4e4e8;text-align:right;font-variant-numeric:tabular-nums}
img{max-width:100%;display:block;margin:1em 0}
td:first-child,th:first-child{text-align:left}tr:hover{background:#f3f6fa}code{background:#f3f4f6}"""


def _html(paragraphs: Sequence[str], tables: Sequence[Table], folder: Path) -> str:
    """One file: pictures of the folder are in it."""

    def inline(text: str) -> str:
        safe = html.escape(text)
        for mark, tag in (("**", "b"), ("*", "i"), ("`", "code")):
            pieces = safe.split(mark)
            for k in range(1, len(pieces) - 1, 2):
                pieces[k] = f"<{tag}>{pieces[k]}</{tag}>"
            safe = "".join(pieces) if len(pieces) % 2 else safe
        return safe

    def cells(row: Sequence[str], tag: str) -> str:
        return f"<tr>{''.join(f'<{tag}>{inline(cell)}</{tag}>' for cell in row)}</tr>"

    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        f"<title>{TITLE}</title><style>{_STYLE}</style><h1>{TITLE}</h1>",
        *(f"<p>{inline(paragraph)}</p>" for paragraph in paragraphs),
    ]
    for table in tables:
        parts.append(f"<h{table.level}>{inline(table.heading)}</h{table.level}>")
        parts += [f"<p>{inline(table.text)}</p>"] * bool(table.text)
        for file, caption in table.pictures:
            content = base64.b64encode((folder / file).read_bytes()).decode()
            source = f"data:image/png;base64,{content}"
            parts.append(f'<img src="{source}" alt="{html.escape(caption)}">')
        if table.rows:
            body = "".join(cells(row, "td") for row in table.rows)
            parts.append(f"<table>{cells(table.columns, 'th')}{body}</table>")
    return "\n".join(parts) + "\n"
