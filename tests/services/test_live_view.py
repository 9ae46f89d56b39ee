"""The process that draws a view, attacked from outside: hung, killed, orphaned, flooded."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from palpate.codec import ELECTRODE_FRAME
from palpate.messages import ElectrodeFrame
from palpate_services.viewer import live_view
from palpate_services.viewer.live_view import LiveView, ViewMessage, ViewPlan

Frames = Callable[..., ElectrodeFrame]
Until = Callable[[Callable[[], bool]], None]

pytest.importorskip("rerun")


@pytest.fixture
def plan(tmp_path: Path) -> ViewPlan:
    return ViewPlan(tmp_path / "view.rrd", "view", 1 << 30, ())


def path_of(plan: ViewPlan) -> Path:
    assert plan.path is not None
    return plan.path


@pytest.fixture
def message(make_frame: Frames) -> Callable[[int], ViewMessage]:
    return lambda sequence: ViewMessage(
        "finger", "electrodes", ELECTRODE_FRAME.encode(make_frame(sequence))
    )


def children_of(pid: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            child = int(entry.name)
            stat = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(stat[1]) == pid and stat[0] != "Z":
                if b"draw_view" in (entry / "cmdline").read_bytes():
                    found.append(child)
    return found


def rows_of(view: Path) -> int:
    """Rows of the electrodes in a view."""
    from rerun.chunk import RrdReader

    chunks = RrdReader(str(view)).stream()
    return sum(
        chunk.to_record_batch().num_rows
        for chunk in chunks
        if chunk.entity_path == "/finger/electrodes/raw" and not chunk.is_static
    )


@contextlib.contextmanager
def drawn(plan: ViewPlan, first: ViewMessage, until: Until) -> Iterator[tuple[LiveView, int]]:
    """A live view that has drawn a message, and the id of its process."""
    view = LiveView(plan)
    try:
        view.offer(first)
        until(lambda: path_of(plan).exists() and path_of(plan).stat().st_size > 0)
        (child,) = children_of(os.getpid())
        yield view, child
    finally:
        view.close(20.0)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_view, "PERIOD_S", 0.05)


def test_all_is_drawn_and_the_process_ends(
    plan: ViewPlan, message: Callable[[int], ViewMessage], until: Until
) -> None:
    with drawn(plan, message(1), until) as (view, _):
        for sequence in range(2, 101):
            view.offer(message(sequence))
        view.finish()
        assert view.join(20.0)
        assert children_of(os.getpid()) == []
        assert rows_of(path_of(plan)) == 100
        assert view.take_counts() == Counter()


def test_the_recorder_does_not_load_rerun() -> None:
    """It keeps memory of all that it ever drew, and a recorder may run for months."""
    code = "import sys, palpate_services.recorder.service; assert 'rerun' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_process_that_hangs_is_ended(
    plan: ViewPlan,
    message: Callable[[int], ViewMessage],
    until: Until,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(live_view, "ANSWER_S", 8.0)  # its start counts, too
    with drawn(plan, message(1), until) as (view, child):
        os.kill(child, signal.SIGSTOP)
        view.offer(message(2))
        assert not view.join(0.0)
        until(lambda: view.join(0.0))
        assert children_of(os.getpid()) == []
        assert view.take_counts()["view_failed"] == 1
        view.offer(message(3))  # nothing waits for ever
    assert "hangs" in caplog.text


def test_a_process_that_hangs_at_the_end_is_not_waited_for(
    plan: ViewPlan,
    message: Callable[[int], ViewMessage],
    until: Until,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with drawn(plan, message(1), until) as (view, child):
        os.kill(child, signal.SIGSTOP)
        view.close(0.2)
        assert children_of(os.getpid()) == []
        assert view.take_counts()["view_failed"] == 1
    assert "it was not done 0.2 s after the record" in caplog.text


def test_a_process_that_is_killed_is_reported(
    plan: ViewPlan,
    message: Callable[[int], ViewMessage],
    until: Until,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with drawn(plan, message(1), until) as (view, child):
        os.kill(child, signal.SIGKILL)
        view.offer(message(2))
        until(lambda: view.join(0.0))
        assert view.take_counts()["view_failed"] == 1
    assert "has ended" in caplog.text


def test_a_killed_recorder_leaves_a_whole_view(
    plan: ViewPlan, message: Callable[[int], ViewMessage], tmp_path: Path, until: Until
) -> None:
    code = (
        "import pickle, sys, time\n"
        "from palpate_services.viewer import live_view\n"
        "live_view.PERIOD_S = 0.05\n"
        "plan, messages = pickle.load(sys.stdin.buffer)\n"
        "view = live_view.LiveView(plan)\n"
        "for message in messages: view.offer(message)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) as recorder:
        assert recorder.stdin is not None
        recorder.stdin.write(pickle.dumps((plan, [message(n) for n in range(1, 51)])))
        recorder.stdin.close()
        until(lambda: path_of(plan).exists() and path_of(plan).stat().st_size > 0)
        (child,) = children_of(recorder.pid)
        os.kill(child, signal.SIGTERM)  # as to a whole group; it ends by the recorder's end alone
        recorder.kill()
    until(lambda: not Path(f"/proc/{child}").exists() or b"draw_view" not in _command(child))
    assert rows_of(path_of(plan)) == 50


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def test_messages_that_find_no_room_are_counted(
    plan: ViewPlan, message: Callable[[int], ViewMessage], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_view, "PERIOD_S", 60.0)
    first = message(1)
    each = live_view.MESSAGE_BYTES + len(first.payload)
    monkeypatch.setattr(live_view, "CAPACITY_BYTES", 10 * each)
    view = LiveView(plan)
    for sequence in range(1, 26):
        view.offer(message(sequence)._replace(payload=first.payload))
    assert view.take_counts() == {"view_dropped": 15}
    view.close(20.0)
    assert rows_of(path_of(plan)) == 10


def test_a_bundle_that_is_gone_costs_the_view_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    view = LiveView(ViewPlan(tmp_path / "view.rrd", "view", 1 << 30, ("no-such",)))
    view.close(20.0)
    assert view.take_counts() == {"view_failed": 1}
    assert "no-such" in caplog.text
