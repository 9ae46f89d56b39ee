"""``palpate topic hz``: what it counts, and what it says of a stream that is silent."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bus import TapSample
from palpate.bus.topics import ELECTRODES, Topic, sensor_key
from palpate.config import LinkConfig
from palpate.files.record import read_record
from palpate_deploy.diagnose import topics


def test_what_it_could_not_take_itself_is_no_loss_of_the_stream(
    virtual_record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = {
        item.sequence: item
        for item in read_record(virtual_record)
        if item.address.topic == ELECTRODES.name
    }
    electrodes: Topic[Any] = ELECTRODES
    rate = topics.StreamRate()
    for sequence, lost_here in ((11, 0), (13, 0), (16, 2), (17, 2)):
        item = frames[sequence]
        arrived_ns = sequence * 10**7
        sample = TapSample(
            ELECTRODES.name,
            item.address.station,
            item.address.sensor,
            item.key,
            ELECTRODES.encoding,
            item.payload,
            arrived_ns,
            arrived_ns,
            lost_here,
        )
        rate.add(electrodes, sample)
    numbers = rate.summary()
    assert (numbers["lost"], numbers["overflow"]) == (1, 2)
    topics.print_rates(electrodes, {"finger": rate})
    assert "lost 1  overflow 2" in capsys.readouterr().out


def test_what_it_keeps_does_not_grow_with_time() -> None:
    """It kept each gap, and went through all of them for each line."""
    gaps_s = 0.01 + 1e-4 * np.random.default_rng(1).standard_normal(20_000)
    arrivals_ns = np.cumsum([10**9, *(gaps_s * 1e9).astype(int)])
    electrodes: Topic[Any] = ELECTRODES
    rate = topics.StreamRate()
    key = sensor_key("lab", "finger", ELECTRODES.name)
    tracemalloc.start()
    try:
        for at_ns in arrivals_ns.tolist():
            rate.add(
                electrodes,
                TapSample("electrodes", "lab", "finger", key, "", b"\xff", at_ns, at_ns),
            )
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 50_000  # a list of the gaps has 600 kB
    numbers = rate.summary()
    seconds = np.diff(arrivals_ns) * 1e-9
    assert numbers["rate_hz"] == pytest.approx(1 / seconds.mean())
    assert numbers["min_s"] == pytest.approx(seconds.min())
    assert numbers["max_s"] == pytest.approx(seconds.max())
    assert numbers["std_s"] == pytest.approx(seconds.std())
    assert numbers["rejected"] == 20_001


@pytest.mark.parametrize("report_s", [0.05, 60.0])
def test_that_nothing_came_is_said_once(
    link: LinkConfig,
    report_s: float,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(topics, "_REPORT_S", report_s)
    assert topics.measure(link, "lab", "electrodes", "*", 0.5, as_json=False) == 1
    said = capsys.readouterr().err.splitlines()
    assert said == ["no electrodes came; see what runs: palpate status"]
