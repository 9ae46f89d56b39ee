"""When the messages of a palpate record follow one another, whatever became of the wall clock."""

from __future__ import annotations

from pathlib import Path

from palpate.bus.topics import ELECTRODES, FIELD_TRUTH, POSE, TOPICS, WRENCH
from palpate.errors import WireError
from palpate.files.record import RecordItem, read_record
from palpate.messages import Stamp

_PACED = frozenset(topic.name for topic in (ELECTRODES, WRENCH, POSE, FIELD_TRUTH))
"""Topics that come as they are stamped; a tare may be much older than the record."""


_SWAPPED_NS = 100_000_000
"""A stamp that is earlier than one before it by no more is of a message that came late [ns]."""


class RecordPace:
    """Times of one sensor's messages, by the monotonic clocks that stamped them.

    Log times are of a wall clock, which may have been set while it recorded; they say only where a
    clock begins. A message that is stamped earlier than one before it, or has no stamp, is due with
    that one.

    Args:
        path: The record.
        sensor: The sensor.

    Raises:
        RecordingError: The file is damaged before the sensor's first stamp.
    """

    def __init__(self, path: Path, sensor: str) -> None:
        self._zeros_ns: dict[int, int] = {}  # by the clock's id: its zero, as a log time
        self._last_ns: dict[tuple[str, int], int] = {}  # by key and clock: the latest stamp
        self._log_ns = self._now_ns = 0
        for item in read_record(path):
            if (stamp := _stamp_of(item)) is None:
                continue
            begin_ns = item.log_time_ns - stamp.monotonic_ns
            zero_ns = self._zeros_ns.setdefault(stamp.clock_id, begin_ns)
            if item.address.sensor == sensor:
                self._now_ns = zero_ns + stamp.monotonic_ns
                return

    def time_ns(self, item: RecordItem) -> int:
        """When the sensor's next message is due, never before the one before it.

        Returns:
            Its log time, had the wall clock not been set [ns since the Unix epoch].
        """
        if (stamp := _stamp_of(item)) is not None:
            stream = item.key, stamp.clock_id
            last_ns = self._last_ns.get(stream, 0)
            played_again = stamp.monotonic_ns < last_ns - _SWAPPED_NS
            if played_again or stamp.clock_id not in self._zeros_ns:  # how much later: the log's
                self._now_ns += max(0, item.log_time_ns - self._log_ns)
                self._zeros_ns[stamp.clock_id] = self._now_ns - stamp.monotonic_ns
            now_ns = stamp.monotonic_ns
            self._last_ns[stream] = now_ns if played_again else max(last_ns, now_ns)
            here_ns = self._zeros_ns[stamp.clock_id] + stamp.monotonic_ns
            self._now_ns, self._log_ns = max(self._now_ns, here_ns), item.log_time_ns
        return self._now_ns


def _stamp_of(item: RecordItem) -> Stamp | None:
    """The stamp of a message that paces; None if it breaks the contract, too."""
    if item.address.topic not in _PACED:
        return None
    topic = TOPICS[item.address.topic]
    try:
        return topic.stamp_of(topic.codec.decode(item.payload))
    except WireError:
        return None
