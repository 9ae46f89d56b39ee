"""The live view for browsers: which parts a viewer gets, and that what is kept is bounded."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from palpate.bus import Session
from palpate.bus.topics import ELECTRODES
from palpate.config import LinkConfig
from palpate.messages import ElectrodeFrame
from palpate_services.viewer import watched_view
from palpate_services.viewer.live_view import DrawnPart
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


def test_it_draws_while_watched_in_chapters_and_stops_afterwards(
    link: LinkConfig,
    monkeypatch: pytest.MonkeyPatch,
    make_frame: Callable[..., ElectrodeFrame],
) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk not installed (extra services)")
    monkeypatch.setattr(watched_view, "CHAPTER_BYTES", 100_000)
    monkeypatch.setattr(watched_view, "_AGAIN_S", 0.5)
    with (
        Session.open(link) as session,
        WatchedView(session, title="lab") as view,
        session.publisher(ELECTRODES, sensor="finger") as publisher,
    ):
        number = 1

        def go_on(until: Callable[[], bool], what: str) -> None:
            nonlocal number
            deadline_s = time.monotonic() + PATIENCE_S
            while not until():
                assert time.monotonic() < deadline_s, what
                publisher.put(make_frame(number))
                number += 1
                counts = view.turn()
                assert not counts["view_failed"]
                assert not counts["view_rejected"]
                time.sleep(0.02)

        for _ in range(10):  # nobody watches
            view.turn()
        assert view.parts.after("") is None
        got: list[bytes] = []
        place = ""

        def more(least: int) -> Callable[[], bool]:
            def enough() -> bool:
                nonlocal place
                if (one := view.next_part(place)) is not None:
                    place = one.place
                    got.append(one.data)
                return sum(map(len, got)) > least

            return enough

        go_on(more(1_000_000), "several chapters are drawn")
        assert all(data.startswith(b"RRF2") for data in got)
        kept = sum(len(data) for data in read(view.parts)[1])
        assert kept < 0.8 * sum(map(len, got))
        # Not a layout for each chapter: it would move what the user has moved.
        assert place.split("-")[2] == "1"
        monkeypatch.setattr(watched_view, "UNWATCHED_S", 0.0)
        view.turn()
        assert read(view.parts, place)[1] == []
