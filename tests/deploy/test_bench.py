"""Benchmarks run and account for every frame. How fast they are is not a test."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.errors import ConfigError, LinkError
from palpate.messages import COUNTS_MAX, ServiceState, Status
from palpate_deploy.bench import alignment, codec, load, soak, swap
from palpate_deploy.bench.e2e import Run
from palpate_deploy.bench.e2e import _lost as e2e_lost
from palpate_deploy.bench.e2e import _median as e2e_median
from palpate_deploy.bench.fleet import _gap as fleet_gap
from palpate_deploy.bench.fleet import _latency as fleet_latency
from palpate_deploy.bench.harness import SourceGate, bench_counts, read_rows, write_rows
from palpate_deploy.bench.results import (
    Latency,
    append_history,
    finish,
    latency,
    progress_bar,
    rounds,
)
from palpate_deploy.cli.app import app

Palpate = Callable[..., "subprocess.CompletedProcess[str]"]


def test_codec(palpate: Palpate) -> None:
    result = palpate("bench", "codec", "--rounds", "1", "--json")
    assert result.returncode == 0, result.stderr
    values = json.loads(result.stdout)
    assert values["codec.frame.encode_decode_s"] > 0
    assert values["codec.frame.bytes"] > 82


@pytest.mark.slow
def test_e2e_reports_both_sides_and_the_load(palpate: Palpate, bundle: str) -> None:
    result = palpate(
        *("bench", "e2e", "--seconds", "2", "--rounds", "1", "--sensors", "3", "--fields", "1"),
        *("--load-seconds", "2", "--no-ramp", "--json"),
        timeout=180,
    )
    assert result.returncode == 0, result.stderr
    values = json.loads(result.stdout)
    for side in ("palpate", "floor"):
        numbers = values[f"e2e.{side}"]
        # One turn of 2 s at 100 Hz; the one of 1.5 s that warms up is not counted.
        assert 20 < numbers["count"] < 250
        assert 0 < numbers["p50_s"] <= numbers["p99_s"] <= numbers["max_s"]
    assert values["e2e.p50_ratio"] > 0
    assert values["e2e.bundle"].startswith("features-virtual:")
    for service, fingers in (("features", 3), ("field", 1)):
        account = values[f"load.{service}"]
        assert account["published"] >= 200 * fingers
        assert account["lost"] == account["published"] - account["received"] >= 0
        assert set(account["cores"]) == {"gateway", "service", "client", "router"}
        assert account["stages_s"]["infer"] > 0


def test_the_largest_latency_and_all_losses_of_several_runs_are_told() -> None:
    one, two = (
        Run(side, side, {})
        for side in (Latency(0.1, 0.2, 0.3, 10, 0), Latency(0.3, 0.4, 0.9, 10, 1))
    )
    told = e2e_median([one, two, one], "palpate")
    assert told["p50_s"] == pytest.approx(0.1)
    assert told["max_s"] == pytest.approx(0.9)
    assert told["lost"] == 1


@pytest.mark.parametrize(
    ("without", "lost"),
    [
        ((), 0),
        (range(110, 120), 10),
        (range(100, 180), 80),  # it comes again in the next turn
        (range(150, 400), 250),  # it does not, nor in the turn after that one
        (range(398, 400), 0),  # on their way when the last turn ends
    ],
)
def test_a_stream_that_ends_before_the_last_turn_has_lost_frames(
    without: Sequence[int], lost: int
) -> None:
    """Four turns of a second at 100 Hz, with a second of the other side between them."""
    turns = [(2 * n * 10**9, (2 * n + 1) * 10**9) for n in range(4)]
    taken_ns = [begin + n * 10**7 for begin, _ in turns for n in range(100)]
    rows = [(n, at, at + 10**6) for n, at in enumerate(taken_ns) if n not in without]
    assert e2e_lost(np.array(rows, np.int64), turns) == pytest.approx(lost, abs=1)


def test_the_latency_of_a_phase_leaves_out_what_came_before(tmp_path: Path) -> None:
    rows = [(number, 1000 * number, 1000 * number + 100 * (number % 3)) for number in range(6)]
    write_rows(tmp_path / "out.npz", ["a"] * 6, rows, dropped=0)
    assert fleet_latency(tmp_path / "out.npz", 1, 6000)["received"] == 6
    found = fleet_latency(tmp_path / "out.npz", 1, 6000, since_ns=3000)
    assert (found["received"], found["lost"]) == (3, 0)


@pytest.mark.parametrize("stations", ["ab", "b"])
def test_a_station_that_falls_silent_has_lost_what_it_would_have_sent(
    tmp_path: Path, stations: str
) -> None:
    """At 100 Hz for 2 s; one station, or the only one, stops after half of it."""
    arrived = [(name, n) for n in range(200) for name in stations if name == "a" or n < 100]
    rows = [(n, 10_000_000 * n, 10_000_000 * n + 1_000_000) for _, n in arrived]
    write_rows(tmp_path / "out.npz", [name for name, _ in arrived], rows, dropped=0)
    found = fleet_latency(tmp_path / "out.npz", len(stations), 2 * 10**9)
    assert found["lost"] == pytest.approx(100, abs=1)


@pytest.mark.parametrize("count", [0, 1, 20])
def test_estimates_that_are_all_of_the_warm_up_have_no_latency(count: int) -> None:
    rows = np.array([(n, 10**7 * n, 10**7 * n + 10**6) for n in range(count)], np.int64)
    with pytest.raises(LinkError, match=f"{count} estimates came"):
        latency(rows.reshape(-1, 3), warm_up=20, lost=0)


@pytest.mark.parametrize(
    ("arrived_ms", "gap_ms", "after"),
    [
        ([*range(10, 1010, 10), *range(1300, 6000, 10)], 300, 299),  # another takes over
        (range(10, 1010, 10), 2000, 0),  # none does, and the fault's end does not help
        ([*range(10, 1010, 10), *range(2990, 6000, 10)], 1990, 299),  # just before the fault's end
        ([*range(10, 1010, 10), *range(3500, 6000, 10)], 2500, 250),  # only after it
        (range(10, 700, 10), 2310, 0),  # silent before the fault already
        ((), 2000, 0),
    ],
)
def test_a_takeover_that_never_comes_is_the_longest_gap(
    tmp_path: Path, arrived_ms: Sequence[int], gap_ms: int, after: int
) -> None:
    """Of a fault that lasts from 1.001 s to 3.001 s; the last estimate before it came at 1 s."""
    rows = [(number, 0, 1_000_000 * at) for number, at in enumerate(arrived_ms)]
    write_rows(tmp_path / "out.npz", ["a"] * len(rows), rows, dropped=0)
    found = fleet_gap(tmp_path / "out.npz", 1_001_000_000, 3_001_000_000)
    assert found["gap_s"] == pytest.approx(1e-3 * gap_ms, abs=2e-3)
    assert found["estimates_after_heal"] == after


def test_rounds_are_cut_at_pauses_and_warmed_up() -> None:
    stamps = np.concatenate([np.arange(5), 100 + np.arange(4)]) * 10_000_000
    rows = np.stack([np.arange(9), stamps, stamps + 1_000_000 + (np.arange(9) % 2)], axis=1)
    assert [len(part) for part in rounds(rows)] == [5, 4]
    side = latency(rows, warm_up=2, lost=0)
    assert side.count == 5
    assert side.p50_s == pytest.approx(1e-3, rel=1e-3)


def test_frames_of_the_benchmark_are_valid_counts() -> None:
    counts = bench_counts()
    assert counts.shape[1] == 44
    assert counts.max() <= COUNTS_MAX
    assert (counts == bench_counts()).all()


def test_gate_is_seen_by_another_mapping(tmp_path: Path) -> None:
    first, second = (SourceGate(tmp_path / "gate", 1) for _ in range(2))
    assert not second.is_open
    first.set(True)
    assert second.is_open


def test_rows_survive(tmp_path: Path) -> None:
    write_rows(tmp_path / "out.npz", ["a"], [(1, 2, 3)], dropped=4)
    names, rows, dropped = read_rows(tmp_path / "out.npz")
    assert (names.tolist(), rows.tolist(), dropped) == (["a"], [[1, 2, 3]], 4)


def test_history_is_kept_in_the_working_tree_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="tests/benchmarks"):
        append_history("codec", {"a": 1})
    (tmp_path / "tests" / "benchmarks").mkdir(parents=True)
    line = json.loads(append_history("codec", {"a": 1}).read_text(encoding="utf-8"))
    assert (line["benchmark"], line["a"]) == ("codec", 1)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("swap", "--out", "a-file/x.json"), "a-file is no folder"),
        (("swap", "--out", "x.txt"), "does not end in .json"),
        (("soak", "--out", "a-folder.json"), "is a folder"),
        (("alignment", "--page", "a-file/x.md"), "a-file is no folder"),
        (("codec", "--save"), "--save: "),
    ],
)
def test_what_cannot_be_written_is_told_before_the_measurement(
    words: tuple[str, ...], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a-file").touch()
    Path("a-folder.json").mkdir()
    for module, name in (
        (alignment, "run_alignment"),
        (codec, "run_codec"),
        (soak, "run_soak"),
        (swap, "run_swap"),
    ):
        monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("it measures"))
    told = CliRunner().invoke(app, ["bench", *words])
    assert told.exit_code == 2, told.output
    assert says in " ".join(told.output.split())


def test_a_result_makes_its_folder(tmp_path: Path) -> None:
    out = tmp_path / "new" / "folder" / "x.json"
    finish("codec", {"a": 1}, lambda: None, as_json=False, save=False, out=out)
    assert json.loads(out.read_text(encoding="utf-8"))["a"] == 1


def test_the_share_of_a_core_is_of_the_time_in_which_frames_are_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 10 s and 50 frames at 100 Hz: neither of the gateway's start nor of its rest."""
    sending_s = 0.4
    now_s, used_s, until_s = 0.0, 0.0, 0.0

    def passes(seconds: float) -> None:
        nonlocal now_s, used_s
        used_s += sending_s * max(min(until_s - now_s, seconds), 0.0)
        now_s += seconds

    def starts(*_: object) -> None:
        nonlocal used_s, until_s
        used_s += 5.0
        until_s = now_s + 10.5
        passes(0.6)  # until it is known that it is ready

    children = SimpleNamespace(folder=tmp_path, pid=lambda _: 1, stop_one=lambda _: 0)
    finished = Status("gateway", "gateway", ServiceState.FINISHED, 1, 1, 1.0, "1")
    write_rows(tmp_path / "client.npz", ["finger0"], [(1, 2, 3)], dropped=0)
    monkeypatch.setattr(load, "time", SimpleNamespace(monotonic=lambda: now_s, sleep=passes))
    monkeypatch.setattr(load, "FiniteRun", lambda _: nullcontext(children))
    monkeypatch.setattr(load, "join", lambda *_, **__: nullcontext())
    monkeypatch.setattr(load, "start_palpate", lambda *_, **__: None)
    monkeypatch.setattr(load, "wait_ready", starts)
    monkeypatch.setattr(load, "ask_status", lambda _: [finished])
    monkeypatch.setattr(load, "_cpu_s", lambda _: {"gateway": used_s})
    with progress_bar() as bar:
        result = load.run_load("field", sensors=1, rate_hz=100, seconds=10, bundle="b", bar=bar)
    assert result.cores["gateway"] == pytest.approx(sending_s, abs=1e-3)


@pytest.mark.parametrize("untared", [(), (1,), (0, 1)])
def test_fingers_without_a_tare_are_no_load(tmp_path: Path, untared: tuple[int, ...]) -> None:
    """Their frames need no estimate, so that none is lost."""
    tared = [number for number in (0, 1) if number not in untared]
    rows = [(n, n, n + 1) for _ in tared for n in range(100)]
    names = [f"finger{number}" for number in tared for _ in range(100)]
    write_rows(tmp_path / "client.npz", names, rows, dropped=0)
    gateway = {f"finger{number}.frames_published": 150 for number in (0, 1)}
    gateway |= {f"finger{number}.frames_untared": 150 if number in untared else 50
                for number in (0, 1)}  # fmt: skip
    counters = {"gateway": gateway, "features": {"estimates_published": len(rows)}}
    result = load._account(tmp_path / "client.npz", "features", 2, 100.0, counters, 1.5, {})
    assert (result.lost, result.silent) == (0, len(untared))
    assert result.met is not bool(untared)
    assert ("without any estimate" in result.sentences()[0]) is bool(untared)


@pytest.mark.slow
def test_swap_mixes_no_bundles(palpate: Palpate, bundle: str) -> None:
    """How many frames a loaded host loses is measured, not tested."""
    done = palpate(
        "bench", "swap", "--changes", "2", "--hold-seconds", "0.1", "--json", timeout=180
    )
    assert done.returncode in (0, 1), done.stderr
    values = json.loads(done.stdout)
    assert values["swap.changes"] == 4
    changing = values["swap.changing"]
    assert changing["mixed"] == changing["repeated"] == 0
    assert len(changing["bundles"]) > 1
    assert "unknown" not in changing["bundles"]
