"""The live view for browsers: which parts a viewer gets, and that what is kept is bounded."""

from __future__ import annotations

import gzip
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from palpate.bus import Publisher, Session
from palpate.bus.topics import ELECTRODES
from palpate.config import LinkConfig
from palpate.messages import ElectrodeFrame
from palpate_services.viewer import viewer_files, watched_view
from palpate_services.viewer.layout import MAX_SENSORS
from palpate_services.viewer.live_view import DrawnPart
from palpate_services.viewer.viewer_files import VIEWER_FILES, ViewerFiles
from palpate_services.viewer.watched_view import KeptParts, WatchedView

PATIENCE_S = 120.0


def part(data: bytes, layout: bytes = b"") -> DrawnPart:
    return DrawnPart(data, layout, {})


def read(parts: KeptParts, place: str = "") -> tuple[str, list[bytes]]:
    """Everything after a place, as a viewer gets it."""
    found = []
    while (one := parts.after(place)) is not None:
        place = one.place
        found.append(one.data)
    return place, found


def test_a_viewer_gets_the_layout_then_every_part_once() -> None:
    parts = KeptParts()
    assert parts.after("") is None
    parts.add(1, part(b"a", b"L"))
    parts.add(1, part(b"b"))
    place, found = read(parts)
    assert found == [b"L", b"ab"]
    assert read(parts, place) == (place, [])
    parts.add(1, part(b"c"))
    assert read(parts, place)[1] == [b"c"]


def test_a_changed_layout_comes_again_and_an_unchanged_one_does_not() -> None:
    parts = KeptParts()
    parts.add(1, part(b"a", b"L"))
    place, _ = read(parts)
    parts.add(1, part(b"b", b"M"))
    assert read(parts, place)[1] == [b"M", b"b"]
    assert read(parts)[1] == [b"M", b"ab"]


def test_an_answer_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watched_view, "ANSWER_BYTES", 10)
    parts = KeptParts()
    for data in (b"1" * 6, b"2" * 6, b"3" * 30, b"4" * 4, b"5" * 4):
        parts.add(1, part(data))
    assert [len(data) for data in read(parts)[1]] == [6, 6, 30, 8]


def test_the_last_two_chapters_are_kept_for_newcomers() -> None:
    parts = KeptParts()
    for chapter in range(1, 100):
        parts.add(chapter, part(str(chapter).encode() * 3))
    assert read(parts)[1] == [b"989898999999"]


def test_one_that_fell_behind_or_comes_from_another_run_begins_anew() -> None:
    parts, other = KeptParts(), KeptParts()
    other.add(1, part(b"x", b"X"))
    foreign, _ = read(other)
    parts.add(1, part(b"a", b"L"))
    slow, _ = read(parts)
    for chapter in (2, 3, 4):
        parts.add(chapter, part(str(chapter).encode()))
    assert read(parts, slow)[1] == [b"34"]
    assert read(parts, foreign)[1] == [b"L", b"34"]


@pytest.mark.parametrize(
    "place", ["x", "--", "a-b-c", "a-1", "a-1-1-1", "a--1-1", "a-٣-1", f"a-{'9' * 5000}-1", "\0"]
)
def test_a_place_that_is_none_is_the_beginning(place: str) -> None:
    parts = KeptParts()
    parts.add(1, part(b"a", b"L"))
    assert read(parts, place)[1] == [b"L", b"a"]


class Watched:
    """A view of a finger whose frames are published meanwhile, and what its viewer got."""

    def __init__(
        self,
        view: WatchedView,
        publisher: Publisher[ElectrodeFrame],
        make_frame: Callable[..., ElectrodeFrame],
    ) -> None:
        self.view = view
        self.got_bytes = 0
        self.place = ""
        self.counts: Counter[str] = Counter()
        self.wall_later_ns = 0
        self._publisher, self._make_frame = publisher, make_frame
        self._number = 0

    def until(self, done: Callable[[], bool], what: str) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline_s, what
            self._number += 1
            frame = self._make_frame(self._number)
            wall_ns = frame.stamp.wall_ns + self.wall_later_ns
            self._publisher.put(replace(frame, stamp=replace(frame.stamp, wall_ns=wall_ns)))
            self.counts += self.view.turn()
            if (one := self.view.next_part(self.place)) is not None:
                assert one.data.startswith(b"RRF2")
                self.place = one.place
                self.got_bytes += len(one.data)
            time.sleep(0.02)


@pytest.fixture
def watched(
    link: LinkConfig,
    monkeypatch: pytest.MonkeyPatch,
    make_frame: Callable[..., ElectrodeFrame],
) -> Iterator[Watched]:
    pytest.importorskip("rerun", reason="rerun-sdk not installed (extra services)")
    monkeypatch.setattr(watched_view, "CHAPTER_BYTES", 100_000)
    monkeypatch.setattr(watched_view, "_AGAIN_S", 0.5)
    with (
        Session.open(link) as session,
        WatchedView(session, title="lab") as view,
        session.publisher(ELECTRODES, sensor="finger") as publisher,
    ):
        yield Watched(view, publisher, make_frame)


def test_it_draws_while_watched_in_chapters_and_stops_afterwards(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(10):
        watched.view.turn()
    assert watched.view.parts.after("") is None  # nobody watches
    watched.until(lambda: watched.got_bytes > 1_000_000, "several chapters are drawn")
    assert not watched.counts["view_failed"]
    assert not watched.counts["view_rejected"]
    kept = sum(len(data) for data in read(watched.view.parts)[1])
    assert kept < 0.8 * watched.got_bytes
    # Not a layout for each chapter: it would move what the user has moved.
    assert watched.place.split("-")[2] == "1"
    monkeypatch.setattr(watched_view, "UNWATCHED_S", 0.0)
    watched.view.turn()
    assert read(watched.view.parts, watched.place)[1] == []


def test_a_wall_clock_that_is_set_back_begins_another_recording(watched: Watched) -> None:
    """A viewer stays at the latest time of a recording, and would stand still for an hour."""
    watched.until(lambda: watched.got_bytes > 0, "it draws")
    run = watched.place.split("-")[0]
    watched.wall_later_ns -= 500_000_000  # as clocks of two hosts may differ
    before = watched.got_bytes
    watched.until(lambda: watched.got_bytes > before, "it goes on")
    assert watched.place.split("-")[0] == run
    watched.wall_later_ns -= 3600 * 10**9
    watched.until(lambda: watched.place.split("-")[0] != run, "another recording begins")
    begun = watched.got_bytes
    watched.until(lambda: watched.got_bytes > begun, "it is drawn")
    kept = b"".join(read(watched.view.parts)[1])
    assert watched.view.parts.run.encode() in kept
    assert run.encode() not in kept, "nothing of the time before the step is kept"


def test_a_child_that_crashes_is_replaced(watched: Watched) -> None:
    watched.until(lambda: watched.got_bytes > 0, "it draws")
    child = watched.view._view
    assert child is not None
    assert child._process is not None
    child._process.kill()
    watched.until(lambda: watched.counts["view_failed"] > 0, "the crash is counted")
    before = watched.got_bytes
    watched.until(lambda: watched.got_bytes > before + 200_000, "another child goes on")


def test_messages_that_break_the_contract_and_invented_sensors_are_left_out(
    watched: Watched, make_frame: Callable[..., ElectrodeFrame]
) -> None:
    watched.until(lambda: watched.got_bytes > 0, "it draws")
    session = watched.view._session
    for number in range(3 * MAX_SENSORS):
        with session.publisher(ELECTRODES, sensor=f"invented{number}") as stranger:
            stranger.put_payload(b"\xff" * 40)
            stranger.put(make_frame(1))
    watched.until(
        lambda: bool(watched.counts["view_rejected"] and watched.counts["view_no_room"]),
        "they are counted",
    )
    before = watched.got_bytes
    watched.until(lambda: watched.got_bytes > before + 200_000, "the finger is drawn as before")
    assert not watched.counts["view_failed"]


def test_sensors_that_are_gone_make_room_for_others(
    watched: Watched, make_frame: Callable[..., ElectrodeFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watched_view, "GONE_S", 2.0)
    view, names = watched.view, [f"a{number}" for number in range(MAX_SENSORS)]
    with ExitStack() as earlier:
        publishers = [
            earlier.enter_context(view._session.publisher(ELECTRODES, sensor=name))
            for name in names
        ]
        deadline_s = time.monotonic() + PATIENCE_S
        while sorted(view.parts.contents) != names:
            assert time.monotonic() < deadline_s
            view.next_part("")
            for publisher in publishers:
                publisher.put(make_frame(1))
            view.turn()
            time.sleep(0.02)
    watched.until(lambda: "finger" in view.parts.contents, "the finger has a tab")
    assert sorted(view.parts.contents) == ["finger"]
    view.parts.clear()
    assert not view.parts.contents, "nor do they come back when nobody has watched for a while"


def test_the_files_of_the_viewer_come_out_of_the_installed_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun_cli", reason="rerun-sdk not installed (extra services)")
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")  # not asked for this host
    files = viewer_files.fetch_viewer_files()
    assert gzip.decompress(files["re_viewer_bg.wasm"])[:4] == b"\0asm"
    assert b"WebHandle" in gzip.decompress(files["re_viewer.js"])
    assert not list(home.iterdir())  # Rerun's settings and its id of this user: none


def test_a_viewer_that_cannot_be_had_is_said_and_tried_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tries = []

    def fetch() -> dict[str, bytes]:
        tries.append(1)
        time.sleep(0.1)
        if len(tries) == 1:
            raise OSError("no room")
        return dict.fromkeys(VIEWER_FILES, b"x")

    monkeypatch.setattr(viewer_files, "fetch_viewer_files", fetch)
    monkeypatch.setattr(viewer_files, "AGAIN_S", 0.0)
    files = ViewerFiles()
    said = set()
    deadline_s = time.monotonic() + PATIENCE_S
    while files.find("re_viewer.js") != b"x":
        said.add(files.problem)
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    assert any("no room" in problem for problem in said)
    assert files.problem == ""
    with pytest.raises(KeyError):
        files.find("../secret")
