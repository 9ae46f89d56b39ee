"""What Zenoh refuses is told by sender, and standard output is otherwise as it was."""

from __future__ import annotations

import subprocess
import sys

import pytest

from palpate.bus.refusals import AGAIN_S, MOST_LINES, MOST_SENDERS, RefusalReader

LINE = (
    "2026-11-26T15:03:08.972907Z TRACE  rx-0 ThreadId(07) demux{{zid=e174889e6bbb "
    "src=south:0:{kind}/{sender}:1}}: zenoh::net::routing::interceptor: Msg intercepted!"
)


class Told:
    """A reader, its clock and what it has told."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.now_s = 0.0
        self.reader = RefusalReader(self.lines.append, lambda: self.now_s)

    def refuse(self, sender: str, kind: str = "peer") -> None:
        assert self.reader.read(LINE.format(sender=sender, kind=kind).encode())


@pytest.fixture
def told() -> Told:
    return Told()


def test_the_first_message_of_a_sender_is_told_and_more_are_counted(told: Told) -> None:
    for _ in range(20):
        told.refuse("89a289d7")
    told.refuse("4eef1fc5", "client")
    assert [line.split(":")[1] for line in told.lines] == [
        " a message of 89a289d7",
        " a message of 4eef1fc5",
    ]
    told.reader.sum_up()
    assert len(told.lines) == 2
    told.now_s = AGAIN_S
    told.reader.sum_up()
    assert told.lines[2:] == [f"refused: 19 messages more of 89a289d7 in {AGAIN_S:g} s"]
    told.refuse("89a289d7")
    assert len(told.lines) == 4


def test_many_senders_do_not_fill_the_log(told: Told) -> None:
    for number in range(10 * MOST_SENDERS):
        told.refuse(f"{number:08x}")
    told.now_s = AGAIN_S
    told.reader.sum_up()
    assert len(told.lines) == MOST_SENDERS + 1
    assert f"{9 * MOST_SENDERS} messages more of others" in told.lines[-1]


def test_a_flood_is_told_once_and_its_sum_is_a_least(told: Told) -> None:
    told.refuse("89a289d7")
    told.refuse("89a289d7")
    told.reader.flood()
    told.reader.flood()
    told.now_s = AGAIN_S
    told.reader.sum_up()
    assert len(told.lines) == 3
    assert "at least 1 messages more" in told.lines[2]


@pytest.mark.parametrize(
    "line", [b"", b"counts 1 2 3", b"WARN zenoh_link_tls::unicast: peer sent no certificates"]
)
def test_other_lines_are_left_alone(line: bytes, told: Told) -> None:
    assert not told.reader.read(line)
    assert not told.lines


PROGRAM = f"""
import logging, os, sys
from palpate.bus.refusals import RefusalLog
logging.basicConfig(format="%(message)s")
line = {LINE.format(sender="89a289d7", kind="peer")!r}
with RefusalLog():
    print("before", flush=True)
    os.write(1, (line + "\\n").encode() * {20 * MOST_LINES})
    print("half a line", end="", flush=True)
print()
print("after", flush=True)
"""


def test_standard_output_is_passed_on_and_given_back() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120, check=True
    )
    assert ran.stdout.splitlines()[0] == "before"
    assert ran.stdout.splitlines()[-1] == "after"
    assert "intercepted" not in ran.stdout
    assert "a message of 89a289d7" in ran.stderr
    assert f"more than {MOST_LINES} messages" in ran.stderr
