"""Killed writers, a full disk, several writers: what was finished stays, nothing half is done."""

from __future__ import annotations

import errno
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpate_fem.result import IndentationResult
from palpate_fem.store.content import StoredFingertip
from palpate_fem.store.files import StoreDiskError, StoreTakenError
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.writer import StoreWriter

sample: Any = importlib.import_module("stored_sample")
sample_fingertip: Callable[..., StoredFingertip] = sample.sample_fingertip
sample_trajectory: Callable[..., IndentationResult] = sample.sample_trajectory

PRELUDE = f"""
import json, os, random, select, signal, sys, time
sys.path.append({str(Path(__file__).parent)!r})
from pathlib import Path
from palpate.files.simulation_store import FINGERTIP
from palpate_fem.store.read import SimulationStore
from palpate_fem.store.files import StoreTakenError, StoreDiskError
from stored_sample import sample_fingertip, sample_trajectory
from palpate_fem.store.writer import StoreWriter
path = Path(sys.argv[1])
tip = sample_fingertip(divisions=4)
press = sample_trajectory(tip, steps=5)
"""

# A clean process that forks writers and kills each at a random moment; what a writer says it has
# written goes through a pipe that outlives it.
KILL = (
    PRELUDE
    + """
kills, shared = int(sys.argv[2]), sys.argv[3] == "shared"
chance = random.Random(20261121)
acknowledged, cut = set(), 0
for number in range(kills):
    reading, writing = os.pipe()
    writer = os.fork()
    if writer == 0:
        with StoreWriter(path, tip, shared=shared) as store:
            for at in range(1000):
                store.write(f"press/{number}/{at}", press)
                os.write(writing, f"press/{number}/{at}\\n".encode())
        os._exit(0)
    os.close(writing)
    if number % 2:  # on a busy machine, too, every second one gets as far as its first file
        select.select([reading], [], [], 60)
    time.sleep(chance.uniform(0.0, 0.08))
    os.kill(writer, signal.SIGKILL)
    os.waitpid(writer, 0)
    with os.fdopen(reading) as pipe:
        acknowledged |= set(pipe.read().split())
    parts = list(path.rglob("*.part"))
    cut += bool(parts)
    if (path / FINGERTIP).exists():
        store = SimulationStore.open(path)
        done = store.done()
        assert acknowledged <= done, acknowledged - done
        assert len(done - acknowledged) <= number + 1, "at most one a writer, not yet said"
        if number % 5 == 4:
            store.check()
    else:
        assert not acknowledged
with StoreWriter(path, tip) as store:  # alone again: what was cut off is swept away
    assert not list(path.rglob("*.part"))
    store.write("after/0", press)
    print(json.dumps({"done": store.check(), "said": len(acknowledged), "cut": cut}))
"""
)

WORKER = (
    PRELUDE
    + """
wrote = []
with StoreWriter(path, tip, shared=True) as store:
    while open_ids := sorted({f"press/{at}" for at in range(16)} - store.done()):
        for id in open_ids:
            try:
                with store.claim(id) as place:
                    time.sleep(0.005)
                    place.write(press)
                    wrote.append(id)
            except StoreTakenError:
                continue
print(json.dumps(wrote))
"""
)

FULL = (
    PRELUDE
    + """
import resource
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
with StoreWriter(path, tip) as store:
    store.write("press/0", press)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
    try:
        store.write("press/1", press)
    except StoreDiskError as error:
        print(error)
"""
)


def _python(program: str, *arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _output(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out


@pytest.fixture(scope="module")
def tip() -> StoredFingertip:
    return sample_fingertip(divisions=4)


@pytest.fixture(scope="module")
def press(tip: StoredFingertip) -> IndentationResult:
    return sample_trajectory(tip, steps=5)


KILLS = 15
"""Of each kind; 200 of each were run once, with the same outcome."""


@pytest.mark.parametrize("mode", ["alone", "shared"])
def test_killed_at_random_moments(tmp_path: Path, mode: str) -> None:
    report = json.loads(_output(_python(KILL, tmp_path / "sweep.sim", KILLS, mode)))
    assert report["said"] >= 1, "the writers were killed before they wrote anything"
    assert report["done"] >= report["said"]


def test_many_processes_share_the_work(tmp_path: Path, tip: StoredFingertip) -> None:
    path = tmp_path / "sweep.sim"  # not there yet: the workers also race to begin it
    workers = [_python(WORKER, path) for _ in range(3)]
    wrote = [name for worker in workers for name in json.loads(_output(worker))]
    assert sorted(wrote) == sorted({f"press/{at}" for at in range(16)}), "each once"
    store = SimulationStore.open(path)
    assert store.check() == 16
    assert not store.fingertip().differences(tip)
    assert not list(path.rglob("*.part"))


def test_second_writer_is_refused(
    tmp_path: Path, tip: StoredFingertip, press: IndentationResult
) -> None:
    path = tmp_path / "sweep.sim"
    with StoreWriter(path, tip) as store:
        for shared in (False, True):
            with pytest.raises(StoreTakenError, match=f"process {os.getpid()}"):
                StoreWriter(path, tip, shared=shared)
        store.write("press/0", press)
        assert SimulationStore.open(path).ids() == ["press/0"], "reading is free"
    with StoreWriter(path, tip, shared=True) as one, StoreWriter(path, tip, shared=True) as two:
        with pytest.raises(StoreTakenError, match="others"):
            StoreWriter(path, tip)
        with one.claim("press/1") as place:
            with pytest.raises(StoreTakenError, match=r"press/1\.h5 is being written"):
                two.claim("press/1")
            two.write("press/2", press)
            place.write(press)
            with pytest.raises(ValueError, match="has ended"):
                place.write(press)
        assert two.done() == {"press/0", "press/1", "press/2"}
    with pytest.raises(ValueError, match="is closed"):
        one.claim("press/3")


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENOSPC, "free some space"), (errno.EDQUOT, "free some space"), (errno.EIO, "disk is")],
)
def test_disk_error_keeps_what_was_finished(
    tmp_path: Path,
    tip: StoredFingertip,
    press: IndentationResult,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    words: str,
) -> None:
    path = tmp_path / "sweep.sim"

    def refuse(file: int, data: bytes) -> int:
        raise OSError(number, os.strerror(number))

    with StoreWriter(path, tip) as store:
        store.write("press/0", press)
        with monkeypatch.context() as patched:
            patched.setattr(os, "write", refuse)
            with pytest.raises(StoreDiskError, match=words) as caught:
                store.write("press/1", press)
        assert "press/1.h5" in str(caught.value)
        assert "what was finished before is kept" in caught.value.remedy
        assert store.done() == {"press/0"}
        assert not list(path.rglob("*.part")), "half a file takes no space on a full disk"
        store.write("press/1", press)
    assert SimulationStore.open(path).check() == 2


def test_a_disk_that_becomes_read_only_is_told_and_releases_every_claim(
    tmp_path: Path, tip: StoredFingertip, press: IndentationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with StoreWriter(tmp_path / "sweep.sim", tip, shared=True) as store:
        claims = [store.claim(f"press/{k}") for k in range(2)]
        with monkeypatch.context() as patched:
            for name in ("write", "unlink"):
                patched.setattr(os, name, refuse)
            with pytest.raises(StoreDiskError, match="Read-only"), claims[0] as claim:
                claim.write(press)
            claims[1].close()
        for k in range(2):
            store.write(f"press/{k}", press)
        assert store.check() == 2


def test_write_that_stops_halfway(tmp_path: Path) -> None:
    """The kernel itself cuts the file off, at 4096 bytes."""
    said = _output(_python(FULL, tmp_path / "sweep.sim"))
    assert "free some space" in said
    assert SimulationStore.open(tmp_path / "sweep.sim").done() == {"press/0"}
    assert not list((tmp_path / "sweep.sim").rglob("*.part"))
