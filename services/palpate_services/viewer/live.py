"""The view beside a running record, in a thread of its own: it may fail, the record may not."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpate.errors import PalpateError
from palpate.messages import FieldEstimate, FieldFrame
from palpate_services.inference.repository import MeshLibrary

if TYPE_CHECKING:
    from palpate_services.viewer.rerun import View

log = logging.getLogger(__name__)

PERIOD_S = 0.5
"""Time between two drawings: long enough to make columns cheap, short enough to follow."""

CAPACITY = 100_000
"""Messages that may wait to be drawn; beyond it they are counted, not drawn."""

FIELDS = 500
"""Fields among them: 42 MB at 7,000 nodes each."""


class ViewWorker:
    """Draws what it is offered into one ``.rrd``.

    Counts ``view_dropped`` (offered too fast), ``view_failed`` (the view was given up), and
    those of the view itself, e.g. ``view_no_mesh``.

    Args:
        path: The file to write.
        title: Shown as the recording's name.
        max_bytes: From this size on nothing more is written [bytes].
        meshes: Where the meshes of fields are found.
    """

    def __init__(self, path: Path, *, title: str, max_bytes: int, meshes: MeshLibrary) -> None:
        self.path = path
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._failed = False
        self._title = title
        self._max_bytes = max_bytes
        self._meshes = meshes
        self._room_for_fields = threading.Semaphore(FIELDS)
        self._waiting: deque[tuple[str, Any]] = deque()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._thread.start()

    def offer(self, sensor: str, message: Any) -> None:
        """Hand over a decoded message; never blocks and never raises."""
        if self._failed:
            return
        full = len(self._waiting) >= CAPACITY
        if full or (_is_field(message) and not self._room_for_fields.acquire(blocking=False)):
            self._count({"view_dropped": 1})
            return
        self._waiting.append((sensor, message))

    def take_counts(self) -> Counter[str]:
        """Hand over what was counted since the last time."""
        with self._lock:
            counts, self._counts = self._counts, Counter()
        return counts

    def finish(self) -> None:
        """Draw the rest and close the file, without waiting for it."""
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """Wait until the file is closed; whether it is."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            # Imported here: Rerun takes half a second to import, the record must not wait for it.
            from palpate_services.viewer.rerun import View

            with View(
                self.path, title=self._title, max_bytes=self._max_bytes, meshes=self._meshes
            ) as view:
                while not self._stop.wait(PERIOD_S):
                    self._draw(view)
                self._draw(view)
        except PalpateError as error:
            log.warning("the view is given up, the record goes on: %s", error)
            self._give_up()
        except Exception:
            # The last line of defence: a defect of the picture must be seen, and the record go on.
            log.exception("the view is given up, the record goes on")
            self._give_up()

    def _give_up(self) -> None:
        self._count({"view_failed": 1})
        self._failed = True
        self._waiting.clear()

    def _draw(self, view: View) -> None:
        for _ in range(len(self._waiting)):
            sensor, message = self._waiting.popleft()
            if _is_field(message):
                self._room_for_fields.release()
            view.add(sensor, message)
        view.flush()
        self._count(view.counters)
        view.counters.clear()

    def _count(self, events: Mapping[str, int]) -> None:
        with self._lock:
            self._counts.update(events)


def _is_field(message: Any) -> bool:
    return isinstance(message, FieldEstimate | FieldFrame)
