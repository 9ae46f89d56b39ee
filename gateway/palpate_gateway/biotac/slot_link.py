"""One line that several fingers share: read once, by one thread, for all of them.

A CAN frame, or a packet of a bridge, holds the words of up to five fingers, and each finger is a
sensor of its own with a thread of its own. Whoever is first opens the line, whoever is last closes
it; what came is kept for each finger until it asks, at most ``KEPT`` slots.
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
"""Slots that wait for a finger's thread: two seconds; older ones are dropped and counted."""

_READ_S = 0.1


class SlotSource(ABC):
    """Where placed slots come from: a CAN bus or a bridge."""

    slot_period_s: float
    """Time between two slots [s]."""
    observed: ClockObservation | None = None
    """The slot of the last ones that was least under way: its time, and when it arrived."""

    @abstractmethod
    def open(self) -> None:
        """Connect; raises DeviceError."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect; never raises."""

    @abstractmethod
    def read(self, timeout_s: float) -> LineSlots | None:
        """Slots that came; None = none of them has a place. Raises DeviceTimeout, DeviceLost."""

    @abstractmethod
    def serial(self, finger: int) -> str:
        """Serial number of a finger, from 0; empty if the line does not tell."""

    @abstractmethod
    def counters(self, finger: int) -> Mapping[str, int]:
        """What went wrong on the line, and with the words of this finger."""


class FingerQueue:
    """One finger's end of a shared line."""

    def __init__(self, link: SlotLink, index: int) -> None:
        self._link, self.index = link, index
        self._blocks: deque[SlotBlock] = deque()
        self._kept = 0
        self._error: DeviceError | None = None
        self.dropped = 0
        self.absent = 0
        """Words in a row that say that no finger is there."""

    @property
    def source(self) -> SlotSource:
        """The line."""
        return self._link.source

    def take(self, timeout_s: float) -> SlotBlock:
        """All frames that wait, one at least, with what is left of a frame that lost its end.

        A thread that woke for each of 4400 slots a second would do little else.

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
        """Keep the finger's part. Called by the link, which holds its lock.

        Args:
            slots: Of all fingers.
            all_there: No word of any finger says that none is there.
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
        """The line is gone; told after what came before it. Called by the link."""
        self._error = error

    def leave(self) -> None:
        """Stop listening; the last one closes the line."""
        self._link.leave(self)


class SlotLink:
    """A line and who listens to it; `join` is the way in."""

    _open: ClassVar[dict[Hashable, SlotLink]] = {}
    _guard: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, key: Hashable, settings: object, source: SlotSource) -> None:
        self._key, self._settings, self.source = key, settings, source
        self.news = threading.Condition()
        self._fingers: dict[int, FingerQueue] = {}
        self._stop = threading.Event()
        self._failed = False
        self._begun: list[LineSlots] = []  # of the frame that is not over
        self._thread = threading.Thread(target=self._run, name=f"line {key}", daemon=True)

    @classmethod
    def join(cls, key: Hashable, settings: object, source: SlotSource, index: int) -> FingerQueue:
        """Listen to one finger of a line, which is opened if nobody listens yet.

        Args:
            key: Names the line, e.g. interface and channel.
            settings: How the line is read; all fingers of it must agree.
            source: The line, if this is the first to listen.
            index: Which finger, from 0.

        Raises:
            ConfigError: The finger is listened to already, or the settings differ.
            DeviceError: The line cannot be opened.
        """
        with cls._guard:
            link = cls._open.get(key)
            if link is not None and link._failed:
                link = None  # its fingers have yet to leave
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
        """A finger stops listening."""
        with self._guard:
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
            # A thread would die unseen: the fingers' own threads carry it on.
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
        """Hand on what is over: whole frames, and those that the next one ends."""
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
