"""Compare the figures of the documents with the files that the commands wrote (``make docs``).

``python docs/make_numbers.py``          writes the figures into the pages
``python docs/make_numbers.py --check``  exits 1 if a page says something else

A claim is a piece of a page with fields for its figures. The piece is found by its words, whatever
figures it has now; it must occur exactly once in the page.
"""

from __future__ import annotations

import json
import math
import re
import runpy
import statistics
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
MODELS = ROOT / "services" / "palpate_services" / "models"
FEM = runpy.run_path(str(Path(__file__).with_name("make_fem_results.py")))
"""The program that writes the page of the finite elements knows how deep a run was."""
FIELD = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True, slots=True)
class Claim:
    """A piece of a page, with ``{name}`` where figures stand, and the figures as printed."""

    page: str
    text: str
    figures: dict[str, str] = field(default_factory=dict)

    def pattern(self) -> re.Pattern[str]:
        """The piece with any figures; line breaks may stand where it has blanks."""
        parts = FIELD.split(self.text)
        words = [re.escape(part).replace(r"\ ", r"\s+") for part in parts[::2]]
        return re.compile(r"(-?\d[\d.,]*\d|\d)".join(words))

    def fresh(self, page: str) -> str:
        """The page with this claim's figures.

        Raises:
            SystemExit: The piece is not in the page, or more than once.
        """
        found = list(self.pattern().finditer(page))
        if len(found) != 1:
            raise SystemExit(f"{self.page}: {self.text!r} is there {len(found)} times, not once")
        names = FIELD.findall(self.text)
        for number in range(len(names), 0, -1):
            start, end = found[0].span(number)
            page = page[:start] + self.figures[names[number - 1]] + page[end:]
        return page


def _read(name: str) -> Any:
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


def _fem() -> Iterator[Claim]:
    """Speed and robustness of the finite elements."""
    bench, runs = _read("fem/bench.json"), _read("fem/campaign.json")
    good = [run for run in runs if run["outcome"] in {"complete", "force limit"}]
    deep = [run for run in runs if FEM["as_deep_as_the_paper"](run)]
    figures = {
        "seconds": f"{bench['normal.seconds']:.1f}",
        "unknowns": f"{bench['system.unknowns']:,.0f}",
        "good": str(len(good)),
        "deep": str(len(deep)),
        "all": str(len(runs)),
        "mib": f"{bench['memory.peak_mib']:.0f}",
        "rounded": f"{bench['normal.seconds']:.0f}",
    }
    yield Claim("README.md", "{deep} of {all} reach the paper's depths", figures)
    yield Claim("README.md", "or 32 N; {good} go 0.6 mm deeper or reach 32 N", figures)
    outcomes = Counter(run["outcome"] for run in runs)
    found = {
        "complete": str(outcomes["complete"]),
        "limit": str(outcomes["force limit"]),
        "early": str(len(runs) - len(good)),
    }
    yield Claim("docs/results/twin.md", "later has {complete}, {limit} and {early}.", found)
    yield Claim("README.md", "finite elements: {unknowns} unknowns", figures)
    yield Claim("README.md", "| {seconds} s (goal 8; the paper's model", figures)
    yield Claim("README.md", "on six processors), {mib} MiB", figures)
    yield Claim("README.md", "an indentation of 3 mm in {rounded} s", figures)
    slots = _read("fem-batched/slots.json")["runs"]
    figures = {_name_of(run): f"{run['ms_while_full']:.0f}" for run in slots}
    whole = {f"whole_{_name_of(run)}": f"{run['ms_a_trajectory']:.0f}" for run in slots}
    yield Claim(
        "README.md",
        "a press takes {ms192} ms while all 192 slots are taken (goals 100 and 30), {whole_ms192}"
        " ms over the whole run, at whose end slots are empty. Processes that share the GPU: two"
        " {ms192xm} and {whole_ms192xm} ms, three with 384 slots {ms384xxm} and {whole_ms384xxm}"
        " ms. With 16 slots {ms16} ms, alone {ms1} ms",
        figures | whole,
    )
    yield Claim(
        "docs/adr/0026-many-at-once.md",
        "takes **{ms192} ms with 192 slots taken**",
        figures,
    )
    yield Claim(
        "docs/adr/0026-many-at-once.md",
        "under NVIDIA's MPS two take **{ms192xm} ms**, three {ms192xxm}, four {ms192xxxm}, "
        "and three with 384 slots **{ms384xxm} ms**",
        figures,
    )
    yield Claim(
        "docs/twin.md", "{ms192xxm} ms a press with all slots taken instead of {ms192},", figures
    )
    one, three, *_ = _read("fem-batched/sweeps.json")["runs"]
    figures = {
        f"{name}_{count}": f"{value:.0f}"
        for count, run in (("one", one), ("three", three))
        for name, value in (
            ("s", run["whole_s"]),
            ("whole", 1e3 * run["whole_s"] / run["results"]),
            ("most", run["ms_a_trajectory"]),
        )
    }
    yield Claim(
        "README.md",
        "files included, takes {s_one} s in all ({whole_one} ms a press), {most_one} ms a press"
        " from its first result to 99 % of them; with three processes under MPS {s_three} s"
        " ({whole_three} ms), and {most_three} ms |",
        figures,
    )


def _name_of(run: dict[str, Any]) -> str:
    """Of a run's figure: its slots, an x for each further process, m = MPS."""
    further = "x" * (run.get("together", 1) - 1)
    return f"ms{run['slots']}{further}{'m' * run.get('mps', False)}"


def _rows(name: str) -> dict[tuple[str, str], dict[str, float]]:
    """(held out, model) -> metrics of a result file of training."""
    return {(row["held_out"], row["model"]): row["metrics"] for row in _read(name)["results"]}


def _real_force() -> Iterator[Claim]:
    rows = _rows("force-real.json")
    for label, model, bold in (
        ("constant", "constant (training mean)", ""),
        ("linear fit", "linear fit", ""),
        ("network (mean of five seeds)", "MLP", "**"),
        ("network trained on the *other* finger", "MLP", ""),
    ):
        held_out = "unseen" if "other" in label else "20 blocks"
        figures = {}
        for finger in "12":
            metrics = rows[f"lasa-finger{finger}, {held_out}", model]
            figures[f"force{finger}"] = f"{metrics['force_magnitude_median_n']:.3f}"
            figures[f"angle{finger}"] = f"{metrics['force_angle_median_rad']:.3f}"
        cells = (f"{bold}{{force{finger}}} N, {{angle{finger}}} rad{bold}" for finger in "12")
        yield Claim("README.md", f"| {label} | {' | '.join(cells)} |", figures)
    for label, name in (
        ("`palpate train transfer` from the *other* finger, tare only", "tare only"),
        ("the same after five labelled presses of 2 s", "5 presses"),
    ):
        (way,) = [way for way in _read("transfer.json")["ways"] if way["name"] == name]
        figures = {}
        for finger, result in zip("12", way["results"], strict=True):
            figures[f"force{finger}"] = f"{result['magnitude_median_n']:.3f}"
            figures[f"angle{finger}"] = f"{result['angle_median_rad']:.3f}"
        cells = (f"{{force{finger}}} N, {{angle{finger}}} rad" for finger in "12")
        yield Claim("README.md", f"| {label} | {' | '.join(cells)} |", figures)
    figures = {
        f"{model}{finger}{metric}": f"{rows[f'lasa-finger{finger}, {held}', name][key]:.{digits}f}"
        for finger in "12"
        for model, name, held, metric, key, digits in (
            ("net", "MLP", "20 blocks", "n", "force_magnitude_median_n", 3),
            ("net", "MLP", "20 blocks", "rad", "force_angle_median_rad", 3),
            (
                "constant",
                "constant (training mean)",
                "20 blocks",
                "n",
                "force_magnitude_median_n",
                3,
            ),
            ("line", "linear fit", "20 blocks", "n", "force_magnitude_median_n", 3),
            ("long", "MLP", "10 blocks", "n", "force_magnitude_median_n", 3),
            ("unseen", "MLP", "unseen", "n", "force_magnitude_median_n", 2),
        )
    }
    yield Claim(
        "training/README.md",
        "magnitude {net1n} N and {net2n} N, angle {net1rad} rad and {net2rad} rad (medians;"
        " constant {constant1n} and {constant2n} N, line {line1n} and {line2n} N). With 18 s blocks"
        " finger 2 has {long2n} N, and an unseen finger {unseen1n} to {unseen2n} N",
        figures,
    )


def _elsewhere() -> Iterator[Claim]:
    """How much worse a force is on a real finger that training has not met."""
    rows = _rows("force-real.json")
    found = _read("transfer.json")
    (unseen,) = (way["results"] for way in found["ways"] if way["name"] == "tare only")
    figures = {}
    for number, (other, met) in enumerate(zip(unseen, found["later"], strict=True), 1):
        net, own = (
            rows[f"lasa-finger{number}, {held}", "MLP"]["force_magnitude_median_n"]
            for held in ("unseen", "20 blocks")
        )
        figures[f"net{number}"] = f"{net / own:.1f}"
        ratio = other["magnitude_median_n"] / met["magnitude_median_n"]
        figures[f"transfer{number}"] = f"{ratio:.1f}"
    yield Claim("docs/comparison.md", "errs {net1} and {net2} times as much on another", figures)
    yield Claim(
        "docs/comparison.md",
        "`palpate train transfer` errs {transfer1} and {transfer2} times as much as on",
        figures,
    )


def _calibrated() -> Iterator[Claim]:
    """What simulated fingers learn from ten presses: those that ship, and drawn ones."""
    cells = [
        cell
        for some in _read("calibrate.json")["simulated"].values()
        for cell in some
        if cell["shots"] == 10
    ]
    told = [
        found
        for cell in cells
        for found in cell.values()
        if isinstance(found, dict) and "location_mm" in found
    ]
    figures = {
        "force": f"{statistics.mean(one['magnitude_n'] for one in told):.2f}",
        "location": f"{statistics.mean(one['location_mm'] for one in told):.2f}",
        "fingers": str(len({cell["specimen"] for cell in cells})),
        "hard": f"{statistics.mean(one['from_2n_percent'] for one in told):.0f}",
    }
    yield Claim(
        "README.md",
        "a simulated finger that no training has met: {force} N and {location} mm after ten presses"
        " ({fingers} fingers; from 2 N on {hard} % of the force;",
        figures,
    )


def _chaos() -> Iterator[Claim]:
    """Half an hour in which one thing after another breaks."""
    found = _read("chaos.json")
    figures = {
        "minutes": f"{found['minutes']:.0f}",
        "faults": str(len(found["events"])),
        "missing": f"{found['frames']['missing']:,}",
    }
    yield Claim(
        "README.md",
        "for {minutes} minutes: processes, disk, clock, network and sensor broken {faults} times",
        figures,
    )
    yield Claim("README.md", "stale or repeated; {missing} missing frames, each counted", figures)
    lost_s = found["recordings"]["lost_s"]
    figures = {"lost": _at_most(max(lost_s), 2), "kills": str(len(lost_s))}
    yield Claim("README.md", "| at most {lost} s of frames lost, {kills} times (goal", figures)
    longest_s = {one["fault"]: one["max_s"] for one in found["faults"]}
    figures = {
        "kill": _at_most(longest_s["kill fem"]),
        "hang": _at_most(longest_s["hang fem"]),
        "hung": _at_most(longest_s["hang palpate up"], 0),
        "all": _at_most(
            max(
                longest_s[fault]
                for fault in ("kill supervisord", "kill palpate up", "systemctl kill, all at once")
            )
        ),
    }
    yield Claim(
        "README.md",
        "the finite-element service took up to {kill} s (killed) and {hang} s (hung), a station"
        " whose supervisors or processes were all killed {all} s, and one whose supervisor hung"
        " {hung} s.",
        figures,
    )


def _at_most(value: float, digits: int = 1) -> str:
    """A bound, rounded up."""
    # What a clock adds in nanoseconds is no digit.
    return f"{math.ceil(round(value * 10**digits, 3)) / 10**digits:.{digits}f}"


def _attacks() -> Iterator[Claim]:
    """How many attacks were tried."""
    figures = {"count": str(len(_read("attacks.json")["attacks"]))}
    yield Claim("README.md", "the {count} attacks that were tried", figures)


def _twin() -> Iterator[Claim]:
    """Errors of the networks that ship, on new presses, and of the paper's in the study."""
    found = {
        (one["name"], one["where"]): one
        for bundle in _read("shipped.json")["points"]
        for one in bundle["figures"]
    }

    def shown(name: str, factor: float, digits: int, where: str = "all") -> str:
        return f"{factor * found[name, where]['value']:.{digits}f}"

    scores = _read("study/twin/study.json")["scores"]

    def papers(task: str, metric: str, factor: float, digits: int, test: str = "all units") -> str:
        best = min(
            one["metrics"][metric]
            for one in scores
            if one["system"].endswith("(the paper's)")
            and (one["task"], one["split"], one["test"]) == (task, "trajectory", test)
        )
        return f"{factor * best:.{digits}f}"

    figures = {
        "field": shown("displacement_128_nodes", 1e3, 3),
        "zero": f"{1e3 * found['displacement_128_nodes', 'all']['zero']:.2f}",
        "location": shown("contact_location", 1e3, 2),
        "force": shown("force_magnitude", 1.0, 2),
        "hard": shown("force_magnitude_over_norm", 100.0, 1, "from_2n"),
        "counts": shown("electrodes", 1.0, 0),
        "papers_field": papers("field", "subset_m_mean", 1e3, 3),
        "papers_location": papers("location", "distance_m_median", 1e3, 2),
        "papers_force": papers("force", "magnitude_n_median", 1.0, 2),
        "papers_hard": papers("force", "magnitude_over_norm_median_from_2n", 100.0, 1),
        "papers_counts": papers("synthesis", "rmse_counts", 1.0, 0, "biotac-2"),
    }
    yield Claim(
        "README.md",
        "(no displacement at all: {zero} mm) | {field} mm | {papers_field} mm | 0.22 mm |\n"
        "| contact location | {location} mm | {papers_location} mm | 2.0 mm |\n"
        "| force | {force} N | {papers_force} N | 0.64 N |\n"
        "| force from 2 N on, share of the true force | {hard} % | {papers_hard} % | |\n"
        "| electrodes of one simulated BioTac, from the field | {counts} counts |"
        " {papers_counts} counts | 66 to 80 counts |",
        figures,
    )


def _serving() -> Iterator[Claim]:
    """Latency of an estimate beside the bare floor, and the load on one host."""
    bench = _read("serving/e2e.json")
    ours, load = bench["e2e.palpate"], bench["load.features"]
    fields = bench["load.field"]
    figures = {
        "p50": f"{1e3 * ours['p50_s']:.2f}",
        "p99": f"{1e3 * ours['p99_s']:.2f}",
        "runs": str(len(bench["e2e.runs"])),
        "p50_ratio": f"{bench['e2e.p50_ratio']:.2f}",
        "p99_ratio": f"{bench['e2e.p99_ratio']:.2f}",
        **{
            f"{key}_{end}": f"{value:.2f}"
            for key in ("p50", "p99")
            for end, value in zip(("least", "most"), bench[f"e2e.{key}_ratio_range"], strict=True)
        },
        "lost": f"{load['lost']:,}",
        "frames": f"{load['published']:,}",
        "load_p99": f"{1e3 * load['p99_s']:.1f}",
        "fields_lost": f"{fields['lost']:,}",
        "fields": f"{fields['published']:,}",
    }
    yield Claim(
        "README.md",
        "| p50 {p50} ms, p99 {p99} ms (medians of {runs} runs). The *floor* is the same path"
        " without palpate's code, measured in turns. Ratio to it: p50 {p50_ratio} in the median of"
        " runs ({p50_least} to {p50_most}; goal 1.15), p99 {p99_ratio} ({p99_least} to {p99_most};",
        figures,
    )
    slow = _read("serving/e2e-slow-host.json")
    ratios = {key: f"{slow[f'e2e.{key}_ratio']:.2f}" for key in ("p50", "p99")}
    yield Claim("README.md", "up to {p50} and {p99}. palpate warms", ratios)
    yield Claim("README.md", "| {lost} of {frames} frames lost, p99 {load_p99} ms (on", figures)
    yield Claim("README.md", "mesh at 100 Hz: {fields_lost} of {fields} lost", figures)


def _restarts() -> Iterator[Claim]:
    """Killed and hung processes of a station."""
    trials = [
        one
        for name in ("restart", "restart-more")
        for one in _read(f"serving/{name}.json")["restart"]
    ]
    broken = [one for one in trials if one["fault"] in ("kill", "hang")]
    back = sum(len(one["publishing_s"]) for one in broken)
    longest_s = {
        fault: max(max(one["publishing_s"]) for one in broken if one["fault"] == fault)
        for fault in ("kill", "hang")
    }
    figures = {
        "processes": str(len({one["service"] for one in broken})),
        "back": f"{back:,}",
        "tried": f"{back + sum(one['failed'] for one in broken):,}",
        "kill": _at_most(longest_s["kill"]),
        "hang": _at_most(longest_s["hang"]),
    }
    yield Claim(
        "README.md",
        "| {back} of {tried} times back ({processes} processes): killed ones within {kill} s, hung"
        " ones within {hang} s",
        figures,
    )
    yield Claim(
        "README.md",
        "is killed publishes again within {kill} s, one that hangs within {hang} s (20 times each",
        figures,
    )


def _demo() -> Iterator[Claim]:
    """Errors of a demo by force, and its picture."""
    touches = _read("demo.json")["touches"]
    bins = touches["bins"]
    touched = bins[">= 0.5 N"]
    figures = {
        "estimates": f"{touches['estimates']:,}",
        "touched": f"{touched['frames']:,}",
        "force": f"{touched['force_median_n']:.2f}",
        "place": f"{1e3 * touched['location_median_m']:.2f}",
        "light": f"{bins['0.5 to 1 N']['force_median_n']:.2f}",
        "hard": f"{bins['>= 8 N']['force_median_n']:.1f}",
        "all": f"{bins['all frames']['force_median_n']:.2f}",
    }
    yield Claim(
        "README.md",
        "{touched} of the {estimates} frames have a touch of 0.5 N or more; their median error is"
        " {force} N and {place} mm. From 0.5 to 1 N the median error of force is {light} N, from 8"
        " N on {hard} N. Over all frames, most of them untouched, it would be {all} N.",
        figures,
    )


def _readers() -> Iterator[Claim]:
    """How long the pages take that the index sends its readers to."""
    index = {
        "laptop": "[quick start](quick-start.md) | {minutes} + {install} |",
        "lab": "(first-biotac.md) | {minutes} + {install} emulated",
        "files": "(guides/train-on-your-files.md) | {minutes} + {install} |",
        "robot": "[palpate and ROS](ros.md) | {minutes} + {install} |",
        "mechanics": "(guides/press-the-fingertip.md) | {minutes} + {install} |",
    }
    for one in _read("readers.json")["readers"]:
        if one["reader"] not in index or "found" not in one:
            continue
        figures = {
            "minutes": str(math.ceil(one["minutes"])),
            "install": str(math.ceil(one["install_minutes"])),
        }
        yield Claim("docs/README.md", index[one["reader"]], figures)
        yield Claim(
            f"docs/{one['pages'][0]}",
            ": {minutes} min on two shared cores, and {install} min of installation",
            figures,
        )


def _wheel() -> Iterator[Claim]:
    """Where wheel and source archive were tried."""
    versions = [one["python"] for one in _read("wheel.json")["tried"]]
    figures = {f"v{number}": version for number, version in enumerate(versions)}
    names = ", ".join(f"{{v{number}}}" for number in range(len(versions)))
    yield Claim("docs/releases.md", f"Last tried with CPython {names}:", figures)


def claims() -> list[Claim]:
    """Every figure of the documents that a result file holds."""
    return [
        *_demo(),
        *_fem(),
        *_real_force(),
        *_twin(),
        *_elsewhere(),
        *_calibrated(),
        *_chaos(),
        *_attacks(),
        *_serving(),
        *_restarts(),
        *_readers(),
        *_wheel(),
    ]


def main() -> None:
    """Write or check the pages."""
    pages: dict[str, str] = {}
    for claim in claims():
        page = pages.get(claim.page) or (ROOT / claim.page).read_text(encoding="utf-8")
        pages[claim.page] = claim.fresh(page)
    stale = [name for name, page in pages.items() if page != (ROOT / name).read_text("utf-8")]
    if sys.argv[1:] == ["--check"]:
        if stale:
            raise SystemExit(
                f"{', '.join(stale)}: figures differ from docs/results; run: make docs"
            )
        return
    for name in stale:
        (ROOT / name).write_text(pages[name], encoding="utf-8")


if __name__ == "__main__":
    main()
