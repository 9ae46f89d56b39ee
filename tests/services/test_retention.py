"""Retention: the oldest whole records of this recorder go first, and nothing else ever."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import pytest

from palpate.bus.topics import ELECTRODES, sensor_key
from palpate.errors import ConfigError
from palpate.files.bounded import open_regular
from palpate.files.record_writer import RecordWriter
from palpate.health import Health
from palpate_services.config import EVERYTHING, RecorderConfig
from palpate_services.recorder import retention
from palpate_services.recorder.retention import FACT, OLDEST_FIRST, Retention

DAY_S = 86400.0
KEY = sensor_key("lab", "finger", "electrodes")


def name_of(number: int, station: str = "lab") -> str:
    return f"{station}-20261122T1000{number:02d}.000Z.mcap"


def record(
    folder: Path,
    name: str,
    *,
    age_s: float = 0.0,
    mine: bool = True,
    view: int = 0,
) -> Path:
    """A closed record of at least 100 kB that ended ``age_s`` ago."""
    path = folder / name
    facts = {"station": "lab", **({FACT: OLDEST_FIRST} if mine else {})}
    with RecordWriter(path, facts) as writer:
        writer.write(KEY, ELECTRODES.codec.schema, os.urandom(100_000), log_time_ns=1)
    if view:
        path.with_suffix(".rrd").write_bytes(bytes(view))
    ended = time.time() - age_s
    os.utime(path, (ended, ended))
    return path


def keeper(folder: Path, **keys: Any) -> tuple[Retention, Health]:
    health = Health("recorder", "recorder")
    settings = {**EVERYTHING, "rotate_bytes": 65536, **keys}
    return Retention(RecorderConfig(out=folder, **settings), "lab", health), health


def left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_oldest_go_until_the_rest_fits(tmp_path: Path) -> None:
    for number in range(6):
        record(tmp_path, name_of(number), age_s=100.0 - number)
    kept, health = keeper(tmp_path, keep_bytes=310_000)
    kept.apply()
    assert left(tmp_path) == [name_of(number) for number in (4, 5)] or left(tmp_path) == [
        name_of(number) for number in (3, 4, 5)
    ]
    assert health.counters["removed_records"] in (3, 4)
    assert health.counters["removed_bytes"] > 300_000
    assert health.status().gauges["kept_records_bytes"] <= 310_000


def test_the_open_record_counts_and_stays(tmp_path: Path) -> None:
    old = record(tmp_path, name_of(1), age_s=50.0)
    facts = {"station": "lab", FACT: OLDEST_FIRST}
    with RecordWriter(tmp_path / name_of(2), facts) as writer:
        writer.write(KEY, ELECTRODES.codec.schema, os.urandom(500_000), log_time_ns=1)
        writer.flush()
        kept, _ = keeper(tmp_path, keep_bytes=150_000)
        kept.apply(writer.bytes_written)
        assert not old.exists()
        assert writer.part.exists()
    assert (tmp_path / name_of(2)).exists()


def test_a_view_goes_with_its_record_and_counts(tmp_path: Path) -> None:
    first = record(tmp_path, name_of(1), age_s=9.0, view=400_000)
    second = record(tmp_path, name_of(2), age_s=5.0)
    kept, _ = keeper(tmp_path, keep_bytes=300_000)
    kept.apply()
    assert left(tmp_path) == [second.name]
    assert not first.with_suffix(".rrd").exists()


def test_nothing_else_is_ever_removed(tmp_path: Path) -> None:
    record(tmp_path, name_of(1, "other"), age_s=99 * DAY_S)  # of another station
    record(tmp_path, name_of(1, "lab-2"), age_s=99 * DAY_S)  # of another one, named alike
    record(tmp_path, name_of(2), age_s=99 * DAY_S, mine=False)  # of `palpate record`, or older
    record(tmp_path, "lab-20261122T100003.000Z-good-one.mcap", age_s=99 * DAY_S)  # renamed
    (tmp_path / name_of(4)).write_bytes(b"not a record")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "elsewhere").mkdir()
    target = record(tmp_path / "elsewhere", name_of(5), age_s=99 * DAY_S)
    (tmp_path / name_of(5)).symlink_to(target)
    before = left(tmp_path)
    kept, health = keeper(tmp_path, keep_bytes=131_072, keep_s=DAY_S)
    kept._steady_since_s = float("-inf")
    kept.apply()
    assert left(tmp_path) == before
    assert health.counters.get("removed_records", 0) == 0


def refuse(*_: object) -> NoReturn:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


@pytest.mark.parametrize("cut_off", [False, True])
def test_a_record_that_cannot_be_read_for_a_moment_is_as_old_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cut_off: bool
) -> None:
    """It counted as just closed, and newer ones were removed in its place."""
    old = record(tmp_path, name_of(1), age_s=50.0)
    if cut_off:
        old = old.rename(old.with_name(f"{old.name}.part"))
    record(tmp_path, name_of(2))
    kept, health = keeper(tmp_path, keep_bytes=150_000)
    opens: dict[str, Callable[..., Any]] = {
        "palpate.files.record.open_regular": open_regular,
        "builtins.open": open,
    }

    def refuse_old(at: str) -> Callable[..., Any]:
        return lambda path, *rest: refuse() if path == old else opens[at](path, *rest)

    with monkeypatch.context() as many_open:
        for at in opens:
            many_open.setattr(at, refuse_old(at))
        kept.apply()
    assert left(tmp_path) == [old.name, name_of(2)]
    kept.apply()
    assert left(tmp_path) == [name_of(2)]
    assert health.counters["removed_records"] == 1


def test_a_folder_that_cannot_be_read_for_a_moment_is_looked_at_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ended the recorder."""
    record(tmp_path, name_of(1), age_s=50.0)
    record(tmp_path, name_of(2))
    kept, _ = keeper(tmp_path, keep_bytes=150_000)
    with monkeypatch.context() as many_open:
        many_open.setattr(os, "listdir", refuse)
        many_open.setattr(os, "scandir", refuse)
        kept.apply()
    kept.apply()
    assert left(tmp_path) == [name_of(2)]


def test_a_record_that_was_open_at_the_first_look_ends_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cut off later, by a clock that is years behind at its last write."""
    clocks = [1000.0, time.time()]
    monkeypatch.setattr(Retention, "_read_clocks", staticmethod(lambda: (clocks[0], clocks[1])))
    part = record(tmp_path, name_of(1), age_s=400 * DAY_S)
    part = part.rename(part.with_name(f"{part.name}.part"))
    kept, _ = keeper(tmp_path, keep_s=DAY_S)
    with open(part, "rb") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        kept.apply()
    for at in (0, 1):
        clocks[at] += retention.STEADY_S
    kept.apply()
    assert left(tmp_path) == [part.name]
    for at in (0, 1):
        clocks[at] += 1.1 * DAY_S
    kept.apply()
    assert left(tmp_path) == []


def test_what_was_cut_off_and_recovered_counts_too(tmp_path: Path) -> None:
    cut = record(tmp_path, name_of(1), age_s=9.0)
    cut.rename(cut.with_name(f"{cut.name}.part"))
    stem = name_of(2).removesuffix(".mcap")
    record(tmp_path, f"{stem}.recovered.mcap", age_s=5.0)
    newest = record(tmp_path, name_of(3))
    kept, _ = keeper(tmp_path, keep_bytes=150_000)
    kept.apply()
    assert left(tmp_path) == [newest.name]


def test_age_counts_only_after_the_clock_was_steady(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A host that starts with a clock years ahead must not remove everything."""
    clocks = [1000.0, time.time()]
    monkeypatch.setattr(Retention, "_read_clocks", staticmethod(lambda: (clocks[0], clocks[1])))
    record(tmp_path, name_of(1), age_s=3 * DAY_S)
    record(tmp_path, name_of(2), age_s=DAY_S)
    kept, _ = keeper(tmp_path, keep_s=2 * DAY_S)

    def later(seconds: float, jump_s: float = 0.0) -> None:
        clocks[0] += seconds
        clocks[1] += seconds + jump_s
        kept.apply()

    later(retention.STEADY_S / 2)
    later(retention.STEADY_S / 2 - 1, jump_s=1000 * DAY_S)
    later(retention.STEADY_S - 1)
    assert len(left(tmp_path)) == 2
    later(1.0, jump_s=-1000 * DAY_S)  # set right
    later(retention.STEADY_S - 1)
    assert len(left(tmp_path)) == 2
    later(1.0)
    assert left(tmp_path) == [name_of(2)]


def test_a_record_of_today_stays_after_the_clock_was_put_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A host without a clock of its own that was off the network for a while."""
    clocks = [1000.0, time.time() - 400 * DAY_S]
    monkeypatch.setattr(Retention, "_read_clocks", staticmethod(lambda: (clocks[0], clocks[1])))
    record(tmp_path, name_of(1), age_s=3 * DAY_S)
    kept, _ = keeper(tmp_path, keep_s=2 * DAY_S)

    def later(seconds: float, jump_s: float = 0.0) -> None:
        clocks[0] += seconds
        clocks[1] += seconds + jump_s
        kept.apply()

    kept.apply()
    record(tmp_path, name_of(2), age_s=400 * DAY_S)
    later(1.0)
    later(1.0, jump_s=400 * DAY_S)
    later(retention.STEADY_S)
    assert left(tmp_path) == [name_of(2)], "the other one is from before the start"
    later(1.9 * DAY_S)
    assert left(tmp_path) == [name_of(2)]
    later(0.2 * DAY_S)
    assert left(tmp_path) == []


def test_a_record_of_before_the_clock_was_set_is_not_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A host with a flat battery starts in 2000 or 1970; it removed a record of yesterday."""
    clocks = [1000.0, time.time()]
    monkeypatch.setattr(Retention, "_read_clocks", staticmethod(lambda: (clocks[0], clocks[1])))
    for number, wall_s in ((1, 946_713_600), (2, 60)):
        os.utime(record(tmp_path, name_of(number)), (wall_s, wall_s))
    record(tmp_path, name_of(3), age_s=3 * DAY_S)
    kept, _ = keeper(tmp_path, keep_s=2 * DAY_S)

    def later(seconds: float) -> None:
        clocks[0] += seconds
        clocks[1] += seconds
        kept.apply()

    kept.apply()
    later(retention.STEADY_S)
    assert left(tmp_path) == [name_of(1), name_of(2)]
    later(1.9 * DAY_S)
    assert left(tmp_path) == [name_of(1), name_of(2)]
    later(0.1 * DAY_S)
    assert left(tmp_path) == []


class SleepingHost:
    """Clocks of a host that may be suspended, by hand."""

    CLOCK_MONOTONIC, CLOCK_BOOTTIME = time.CLOCK_MONOTONIC, time.CLOCK_BOOTTIME

    def __init__(self) -> None:
        self.awake_s, self.slept_s, self.began_s = 1000.0, 0.0, time.time()

    def monotonic(self) -> float:
        return self.awake_s

    def clock_gettime(self, clock: int) -> float:
        return self.awake_s + (self.slept_s if clock == time.CLOCK_BOOTTIME else 0.0)

    def time(self) -> float:
        return self.began_s + self.awake_s - 1000.0 + self.slept_s


def test_the_days_of_a_suspended_host_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = SleepingHost()
    monkeypatch.setattr(retention, "time", host)
    kept, _ = keeper(tmp_path, keep_s=2 * DAY_S)
    kept.apply()
    record(tmp_path, name_of(1))
    host.awake_s += retention.STEADY_S
    kept.apply()
    assert left(tmp_path) == [name_of(1)]
    host.slept_s += 10 * DAY_S
    for _ in range(2):
        host.awake_s += retention.STEADY_S
        kept.apply()
    assert left(tmp_path) == []


def test_a_recorder_without_retention_marks_nothing_and_removes_nothing(tmp_path: Path) -> None:
    record(tmp_path, name_of(1), age_s=99 * DAY_S)
    kept, _ = keeper(tmp_path)
    assert kept.facts == {}
    kept.apply()
    assert left(tmp_path) == [name_of(1)]


def test_by_default_records_rotate_and_the_oldest_go() -> None:
    config = RecorderConfig()
    assert 0 < config.rotate_bytes < config.keep_bytes
    # As README.md, services/README.md and docs/install.md say.
    assert (config.rotate_s, config.keep_bytes, config.keep_s) == (3600, 20 * 2**30, 14 * DAY_S)
    assert config.field_rate_hz == 0.5


@pytest.mark.parametrize(
    "keys",
    [
        {"rotate_bytes": 1000},
        {"rotate_s": 0.1},
        {"keep_bytes": 10**9, "rotate_bytes": 0},
        {"keep_bytes": 10**6, "rotate_bytes": 10**6},
    ],
)
def test_settings_that_cannot_work_are_refused(keys: dict[str, Any]) -> None:
    from palpate.config import parse_config

    with pytest.raises(ConfigError, match="rotate"):
        parse_config(RecorderConfig, keys, where="a test")
