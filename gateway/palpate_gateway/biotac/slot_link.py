"""One line that several fingers share: read once, by one thread, for all of them.

A CAN frame, or a packet of a bridge, holds the words of up to five fingers, and each finger is a
sensor with its own thread. The first finger that joins opens the line, the last one that leaves
closes it. Each finger has a queue of at most ``KEPT`` slots.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Hashable, Mapping
from typing import ClassVar

import numpy as np

from palpate.errors import ConfigError, DeviceError, DeviceTimeout
from palpate_gateway.biotac.slots import LineSlots, SlotBlock
from palpate_gateway.protocols.spi import WordKind
from palpate_gateway.readings import ClockObservation

_log = logging.getLogger(__name__)

KEPT = 8800
"""Most slots in a finger's queue: two seconds; older ones are dropped and counted."""

_READ_S = 0.1


class SlotSource(ABC):
    """A source of slots with their places: a CAN bus or a bridge."""

    slot_period_s: float
    """Time between two slots [s]."""
    observed: ClockObservation | None = None
    """Of the last slots the one with the smallest delay: its time, and when it arrived."""

    @abstractmethod
    def open(self) -> None:
        """Connect; raises DeviceError."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect; never raises."""

    @abstractmethod
    def read(self, timeout_s: float) -> LineSlots | None:
        """Slots that arrived; None = none has a place. Raises DeviceTimeout, DeviceLost."""

    @abstractmethod
    def serial(self, finger: int) -> str:
        """Serial number of a finger, from 0; empty if the line does not send it."""

    @abstractmethod
    def counters(self, finger: int) -> Mapping[str, int]:
        """Counters of the line, and of this finger's words."""


class FingerQueue:
    """Slots of one finger of a shared line, from the line's thread to the finger's."""

    def __init__(self, link: SlotLink, index: int) -> None:
        self._link, self.index = link, index
        self._blocks: deque[SlotBlock] = deque()
        self._kept = 0
        self._error: DeviceError | None = None
        self.dropped = 0
        self.absent = 0
        """Number of absent words in a row, up to now."""

    @property
    def source(self) -> SlotSource:
        """The line."""
        return self._link.source

    def take(self, timeout_s: float) -> SlotBlock:
        """All frames that wait, at least one; the last may be incomplete.

        Whole frames, because a wake-up for each of 4400 slots a second would cost too much.

        Raises:
            DeviceTimeout: None came.
            DeviceError: The line is gone.
        """
        with self._link.news:
            self._link.news.wait_for(lambda: self._blocks or self._error, timeout_s)
            if self._blocks:
                blocks, self._kept = list(self._blocks), 0
                self._blocks.clear()
                return SlotBlock.joined(blocks)
            if self._error is not None:
                raise self._error
        raise DeviceTimeout(
            f"port {self.index + 1}: no slot within {timeout_s:g} s",
            remedy="check the line and the sender's power",
        )

    def put(self, slots: LineSlots, *, all_there: bool) -> None:
        """Keep the finger's part of the slots of all fingers.

        Called by the link, which holds its lock. ``all_there``: no word of any finger is absent.
        """
        self.absent = 0 if all_there else self._absent_behind(slots)
        self._blocks.append(slots.of(self.index))
        self._kept += len(slots)
        while self._kept > KEPT:
            oldest = self._blocks.popleft()
            self._kept -= len(oldest)
            self.dropped += len(oldest)

    def _absent_behind(self, slots: LineSlots) -> int:
        there = np.flatnonzero(slots.kind[:, self.index] != WordKind.ABSENT)
        return len(slots) - 1 - int(there[-1]) if len(there) else self.absent + len(slots)

    def fail(self, error: DeviceError) -> None:
        """The line is gone; raised after the slots before it are taken. Called by the link."""
        self._error = error

    def leave(self) -> None:
        """Leave the line; the last finger closes it."""
        self._link.leave(self)


class SlotLink:
    """An open line and the fingers on it; fingers join by ``join``."""

    _open: ClassVar[dict[Hashable, SlotLink]] = {}
    # One for each line, held while it is opened or closed: that can take seconds, and no other line
    # may wait for it.
    _locks: ClassVar[dict[Hashable, threading.Lock]] = {}
    _locks_guard: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, key: Hashable, settings: object, source: SlotSource) -> None:
        self._key, self._settings, self.source = key, settings, source
        self.news = threading.Condition()
        self._fingers: dict[int, FingerQueue] = {}
        self._stop = threading.Event()
        self._failed = False
        self._begun: list[LineSlots] = []  # slots of the frame that has not ended
        self._thread = threading.Thread(target=self._run, name=f"line {key}", daemon=True)

    @classmethod
    def _lock_of(cls, key: Hashable) -> threading.Lock:
        with cls._locks_guard:
            return cls._locks.setdefault(key, threading.Lock())

    @classmethod
    def join(cls, key: Hashable, settings: object, source: SlotSource, index: int) -> FingerQueue:
        """Join a line as one of its fingers; the first one opens it.

        Args:
            key: Identifies the line, e.g. interface and channel.
            settings: Settings of the line, the same for all of its fingers.
            source: The line, used if it is not open yet.
            index: Which finger, from 0.

        Raises:
            ConfigError: The finger has been joined already, or the settings differ.
            DeviceError: The line cannot be opened.
        """
        with cls._lock_of(key):
            link = cls._open.get(key)
            # A line that failed stays in the table until its last finger leaves it.
            if link is not None and link._failed:
                link = None  # broken; its fingers will leave it
            if link is None:
                source.open()
                link = cls(key, settings, source)
                cls._open[key] = link
                link._thread.start()
            if link._settings != settings:
                raise ConfigError(
                    f"two sensors on {key} are configured differently: {settings} and "
                    f"{link._settings}",
                    remedy="give all fingers of one line the same settings",
                )
            if index in link._fingers:
                raise ConfigError(
                    f"port {index + 1} of {key} is configured twice",
                    remedy="give each sensor a port of its own",
                )
            finger = FingerQueue(link, index)
            with link.news:
                link._fingers[index] = finger
            return finger

    def leave(self, finger: FingerQueue) -> None:
        """A finger leaves."""
        with self._lock_of(self._key):
            with self.news:
                if self._fingers.get(finger.index) is finger:
                    del self._fingers[finger.index]
                last = not self._fingers
            if not last:
                return
            if self._open.get(self._key) is self:
                del self._open[self._key]
            self._stop.set()
            self._thread.join()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    self._share(self.source.read(_READ_S))
                except DeviceTimeout:
                    continue
        except DeviceError as error:
            self._fail(error)
        except BaseException as error:
            # Nobody would see this thread die: the threads of the fingers raise the error.
            _log.exception("line %s: defect", self._key)
            self._fail(DeviceError(f"line {self._key}: {error!r}", remedy="report this defect"))
        finally:
            self.source.close()

    def _fail(self, error: DeviceError) -> None:
        self._failed = True
        with self.news:
            for finger in self._fingers.values():
                finger.fail(error)
            self.news.notify_all()

    def _share(self, slots: LineSlots | None) -> None:
        """Put frames that have ended into the queues: whole ones, and those ended by the next."""
        if slots is None:
            return
        over = slots.over()
        changed = bool(self._begun) and not self._begun[-1].goes_on_with(slots)
        if not over and not changed:
            self._begun.append(slots)
            return
        ready = [*self._begun, slots.part(0, over)] if over else self._begun
        self._begun = [slots.part(over, len(slots))] if over < len(slots) else []
        whole = LineSlots.joined(ready)
        all_there = not (whole.kind == WordKind.ABSENT).any()
        with self.news:
            for finger in self._fingers.values():
                finger.put(whole, all_there=all_there)
            self.news.notify_all()
