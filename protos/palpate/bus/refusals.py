"""Whose messages Zenoh has refused by role or by size, in the log of a process of a station.

Zenoh 1.10 says of each message that it drops that it does, at level ``trace``, on standard output.
Here these lines are counted by sender. Zenoh would also say which key and why, but only beside a
line for each message that it lets through, and a flood of those lines holds up whoever publishes
(docs/adr/0030-security.md).
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import select
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator

import zenoh

from palpate.process import Closing

_log = logging.getLogger(__name__)

WINDOW_S = 0.1
MOST_LINES = 200
"""Lines of Zenoh that are read within ``WINDOW_S``. Zenoh waits while nobody reads: the rest of a
flood goes nowhere."""

AGAIN_S = 60.0
"""So long more of the same sender is only counted [s]."""

MOST_SENDERS = 50
"""Senders that are told within ``AGAIN_S``."""

_LEVELS = ",".join(
    (
        "error",
        "zenoh_link_tls=warn",
        "zenoh_transport=warn",
        "zenoh::net::routing::interceptor=trace",
        # These say what is let through, too.
        "zenoh::net::routing::interceptor::access_control=off",
        "zenoh::net::routing::interceptor::low_pass=off",
        "zenoh::net::primitives::demux=trace",  # names the sender in the lines
    )
)
_DROPPED = b" zenoh::net::routing::interceptor: Msg intercepted"
_SENDER = re.compile(rb" src=\S*/([0-9a-f]+):")

_READ_BYTES = 1 << 18
_LOOK_S = 0.05
_CLOSE_S = 5.0


class RefusalReader:
    """Counts what was refused, by sender, and tells it.

    ``tell`` gets a sentence: at the first message of a sender, and after ``AGAIN_S`` how many came
    since. ``clock`` is a monotonic clock [s].
    """

    def __init__(
        self, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._tell, self._clock = tell, clock
        self._more: Counter[str] = Counter()
        self._told: set[str] = set()
        self._since_s = clock()
        self._flooded = False

    def read(self, line: bytes) -> bool:
        """Take one line; whether it is of a message that was dropped."""
        head, dropped, _ = line.partition(_DROPPED)
        if not dropped:
            return False
        sender = _SENDER.search(head)
        if sender is None:  # not on its way in
            return True
        name = sender[1].decode()
        if name in self._told:
            self._more[name] += 1
        elif len(self._told) >= MOST_SENDERS:
            self._more["others"] += 1
        else:
            self._told.add(name)
            self._tell(
                f"refused: a message of {name}: its role may not send that, or it is too large"
            )
        return True

    def flood(self) -> None:
        """There are more lines than are read."""
        if not self._flooded:
            self._tell(f"more than {MOST_LINES} messages are refused within {WINDOW_S:g} s")
        self._flooded = True

    def sum_up(self) -> None:
        """Tell once in ``AGAIN_S`` what came again meanwhile."""
        now_s = self._clock()
        if now_s - self._since_s < AGAIN_S:
            return
        for name, count in self._more.items():
            least = "at least " if self._flooded else ""
            self._tell(f"refused: {least}{count} messages more of {name} in {AGAIN_S:g} s")
        self._since_s, self._flooded = now_s, False
        self._more.clear()
        self._told.clear()


class RefusalLog(Closing):
    """Writes whose messages are refused into the log of this process, until it is closed.

    Who it is, the log of the router says (``router``). Standard output goes through here, since
    Zenoh writes there only; all other lines are passed on. ``RUST_LOG`` sets what Zenoh writes
    instead.
    """

    def __init__(self) -> None:
        self._reader = RefusalReader(_log.warning)
        sys.stdout.flush()
        self._out = os.dup(1)
        self._nowhere = os.open(os.devnull, os.O_WRONLY)
        self._pipe, self._end = os.pipe()
        os.set_blocking(self._pipe, False)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="refusals", daemon=True)
        os.dup2(self._end, 1)
        os.environ["NO_COLOR"] = "1"  # for Zenoh: its lines are read, and end in files
        zenoh.init_log_from_env_or(_LEVELS)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._follow()
        except Exception:
            _log.exception("what is refused is not told any more")
        finally:
            os.dup2(self._out, 1)  # a pipe that nobody reads would block Zenoh

    def _follow(self) -> None:
        window_s, lines = time.monotonic(), 0
        for whole in self._lines():
            now_s = time.monotonic()
            if now_s - window_s >= WINDOW_S:
                window_s, lines = now_s, 0
                os.dup2(self._end, 1)
            lines += len(whole)
            for line in whole:
                if not self._reader.read(line):
                    os.write(self._out, line + b"\n")
            if lines > MOST_LINES:
                os.dup2(self._nowhere, 1)
                self._reader.flood()
            self._reader.sum_up()

    def _lines(self) -> Iterator[list[bytes]]:
        """Lines as they come, perhaps none, until the log is closed and all are read."""
        rest = b""
        while True:
            select.select([self._pipe], [], [], _LOOK_S)
            got = b""
            with contextlib.suppress(BlockingIOError):
                got = os.read(self._pipe, _READ_BYTES)
            if not got and self._closed.is_set():
                os.write(self._out, rest)
                return
            *whole, rest = (rest + got).split(b"\n")
            yield whole

    def close(self) -> None:
        """Give standard output back."""
        sys.stdout.flush()
        os.dup2(self._out, 1)
        self._closed.set()
        self._thread.join(_CLOSE_S)
        if not self._thread.is_alive():
            for one in (self._pipe, self._end, self._out, self._nowhere):
                os.close(one)
