"""One sensor's way from readings to messages: stamp, condition, tare, and the account of losses."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import replace
from math import inf

from palpate.bus.continuity import Holes
from palpate.bus.topics import ELECTRODES, TARE
from palpate.codec import ELECTRODE_FRAME
from palpate.codec import TARE as TARE_CODEC
from palpate.errors import DeviceError, WireError
from palpate.messages import NO_TARE, ElectrodeFrame, Tare
from palpate_gateway.clock.stamps import ClockMap, DueMessage, Stamper
from palpate_gateway.condition.condition import Condition, RetareRules, TouchState
from palpate_gateway.condition.stillness import StillLimits
from palpate_gateway.device import DeviceIdentity, DeviceInfo
from palpate_gateway.kept_tare import KeptTare
from palpate_gateway.readings import Reading, RecordedMessage
from palpate_gateway.tare import TARE_FRAMES, TareAttempts, TareLedger, TareMode

_log = logging.getLogger(__name__)

Put = Callable[[DueMessage], None]
"""Takes the next message that is to be published."""

_HELD_WINDOWS = 10
"""A recording is held back for this many attempts to tare before it goes out untared."""


class Pipeline:
    """One sensor's way from readings to messages; ``push`` to ``finish`` belong to one thread.

    A live sensor's frames go out at once, before its first tare with ``tare_id`` 0. A recording is
    held back until its first tare exists, so that every frame carries one. Each frame is published
    first; only then it counts for the sensor's condition and for tares (``follow_up``).

    Args:
        info: The device's facts.
        tare: When to tare first; ``still`` means ``first`` for a recording.
        tare_frames: Frames in a tare.
        limits: Noise up to which a sensor counts as still.
        retare: When to tare again without a request; None = never.
        session_id: Names this run of the gateway in the stamps; 0 = unknown.
        kept: Where the tare of a live sensor is kept for a gateway that is started again; None =
            nowhere.
    """

    def __init__(
        self,
        info: DeviceInfo,
        *,
        tare: TareMode = "still",
        tare_frames: int = TARE_FRAMES,
        limits: StillLimits | None = None,
        retare: RetareRules | None = None,
        session_id: int = 0,
        kept: KeptTare | None = None,
    ) -> None:
        self._kept = kept if info.live and info.sensor_type is not None else None
        self._limits = limits or StillLimits()
        electrodes_only = replace(self._limits, pac_sd=inf, pdc_sd=inf)
        if tare == "first":
            self._limits = electrodes_only
        # A recording cannot wait for better frames.
        tare_limits = self._limits if info.live else electrodes_only
        self._tares_itself = tare != "query"
        self._tares = TareAttempts(
            tare_frames, tare_limits, at_start=self._tares_itself, distance=self._distance
        )
        self._retare = retare
        self.condition: Condition | None = None
        """Condition of the sensor; None = it has no electrodes, or was not opened yet."""
        self._counts = dict.fromkeys(
            ("frames_published", "missing_frames", "frames_untared", "retares"), 0
        )
        self._holes = Holes()
        self._info = info
        self._kind = info.sensor_type
        self.tare_frames = tare_frames
        self._serial = ""
        self._stamper = Stamper(info.origin, session_id)
        self._published: deque[tuple[ElectrodeFrame, int]] = deque()  # and not followed up yet
        self._held: list[DueMessage] = []
        self._held_frames = 0
        # Without electrodes there is never a tare: the recording would be held back to its end.
        self._holding = not info.live and info.sensor_type is not None and self._tares_itself

    @property
    def ledger(self) -> TareLedger:
        """Every tare of this run."""
        return self._tares.ledger

    @property
    def counters(self) -> dict[str, int]:
        """Frames published, lost and untared; tares; faults of channels."""
        condition = {} if self.condition is None else self.condition.channels.counters
        return {**self._counts, **self._tares.counters, **condition}

    @property
    def tare_error(self) -> DeviceError | None:
        """Why the sensor is not tared, or not again without a request; None after a success."""
        return self._tares.error

    def begin(self, identity: DeviceIdentity, clock: ClockMap) -> None:
        """The device was opened, or opened again; sequences go on, and the tares of its finger."""
        exchanged, first = identity.serial != self._serial, not self._serial
        self._serial = identity.serial
        kind = identity.sensor_type or self._info.sensor_type
        if (exchanged or kind is not self._kind) and self.ledger.current_id != NO_TARE:
            # Of another finger: the old baseline is not its own, and no service would use it.
            self.ledger.leave()
            if self._tares_itself:
                self._tares.attempt()
        if kind is not None and (self.condition is None or kind is not self._kind):
            rate_hz = identity.rate_hz or 1.0 / (identity.slot_period_s * kind.layout.slots)
            self.condition = Condition(
                kind.layout, rate_hz, self._limits, self._retare, unfilled=identity.unfilled
            )
        elif self.condition is not None:
            self.condition.begin(exchanged=exchanged)
        self._kind = kind
        if first:
            self._resume()
        self._published.clear()  # of the time before, perhaps of another finger
        self._stamper.begin(
            clock,
            serial=identity.serial,
            sensor_type=kind,
            slot_period_s=identity.slot_period_s,
        )

    def _resume(self) -> None:
        """Go on with the tare of a gateway that was killed, or hung, and that this one replaces."""
        if self._kept is None or self._kind is None or self.condition is None:
            return
        tare = self._kept.find(self._serial, self._kind.layout.electrodes)
        if tare is not None:
            _log.info("%s: goes on with tare %d of before the restart", self._serial, tare.tare_id)
            self._tares.resume(tare)
            self.condition.tared(tare)

    def ask_tare(self, frames: int, *, anyway: bool = False) -> Future[Tare]:
        """Tare with the next frames (0 = the usual number); may be called from any thread.

        ``anyway`` = also where the sensor rests farther from its untouched level than it drifts.
        A request that is cancelled before it has its frames leaves no tare.

        Raises:
            DeviceError: No further frames will come to be averaged.
        """
        never = ""
        if self._info.sensor_type is None:
            never = "it has no electrodes"
        elif self._info.driver == "record":
            never = "it is a record, which brings its own tares"
        return self._tares.ask(
            frames,
            anyway=anyway,
            sensor=self._serial or "the sensor",
            never=never,
        )

    def give_up(self, why: str) -> None:
        """The sensor is away: nobody waits for its frames to tare."""
        self._tares.give_up(why)

    def push(
        self, readings: Iterable[Reading], arrival_ns: int, put: Put, *, follow_later: bool = False
    ) -> None:
        """Stamp readings, publish them, and follow up.

        Args:
            readings: In order of time.
            arrival_ns: Host monotonic clock when they arrived [ns].
            put: Gets what is to be published, in order.
            follow_later: The last frame is not followed up; the caller does so, when it has time.
        """
        ledger = self.ledger
        for reading in readings:
            self.follow_up(put)
            item = self._stamper.message(reading, arrival_ns, ledger.current_id)
            if isinstance(item.message, ElectrodeFrame):
                self._pass(item, put)
                self._counts["missing_frames"] += item.message.stamp.missed_before
                self._published.append((item.message, item.due_ns))
            elif isinstance(reading, RecordedMessage):
                self._count_recorded(reading)
                put(item)
            else:
                self._pass(item, put)
        if not follow_later:
            self.follow_up(put)

    def follow_up(self, put: Put) -> None:
        """Judge the sensor's condition by the frames that are out, and offer them to the tares.

        With nothing to follow up it does nothing. ``put`` is that of ``push``.
        """
        while self._published:
            frame, due_ns = self._published.popleft()
            self._watch(frame)
            self._tare(frame, due_ns, put)

    def finish(self, put: Put) -> None:
        """The source has ended: what is still held goes out untared."""
        self.follow_up(put)
        self._tares.finish()
        if self._held_frames and self.tare_error is None:
            self._tares.error = DeviceError(
                f"{self._serial} delivered {self._held_frames} frames, a tare needs "
                f"{self.tare_frames}",
                remedy="replay a longer recording, or lower tare_frames",
            )
        self._release(NO_TARE, put)

    def _watch(self, frame: ElectrodeFrame) -> None:
        """Update the condition of the sensor, and tare again where its rules say so."""
        condition = self.condition
        assert condition is not None, "begin() comes before push()"
        if not condition.add(frame):
            return
        if condition.level.touch is not TouchState.UNTOUCHED:
            self._tares.touched()
        elif condition.wants_tare and not self._tares.attempting:
            self._counts["retares"] += 1
            self._tares.attempt()

    def _distance(self, tare: Tare) -> str:
        return "" if self.condition is None else self.condition.distance(tare)

    def _tare(self, frame: ElectrodeFrame, due_ns: int, put: Put) -> None:
        """Offer the frame to the tares that are under way, and publish those it completes."""
        for tare in self._tares.offer(frame):
            if self.condition is not None:
                self.condition.tared(tare)
            # Published before the frames that were held back for it, and due with the first.
            put(DueMessage(TARE.name, tare, self._held[0].due_ns if self._held else due_ns))
            if self._kept is not None:
                self._kept.keep(tare)
            if self._holding:
                self._release(tare.tare_id, put)
        if self._held_frames >= _HELD_WINDOWS * self.tare_frames:
            self._release(NO_TARE, put)

    def _pass(self, item: DueMessage, put: Put) -> None:
        """Publish a message, or hold it back until the first tare exists."""
        frame = item.message if isinstance(item.message, ElectrodeFrame) else None
        if self._holding:
            self._held.append(item)
            self._held_frames += frame is not None
            return
        if frame is not None:
            self._counts["frames_published"] += 1
            self._counts["frames_untared"] += frame.tare_id == NO_TARE
        put(item)

    def _release(self, tare_id: int, put: Put) -> None:
        """Stop holding back: all that was held, its frames with this tare."""
        held, self._held = self._held, []
        self._holding = False
        self._held_frames = 0
        for item in held:
            if isinstance(item.message, ElectrodeFrame):
                item = replace(item, message=replace(item.message, tare_id=tare_id))
            self._pass(item, put)

    def _count_recorded(self, reading: RecordedMessage) -> None:
        """A recorded message goes out as it is; its tare is kept for later requests.

        One that does not decode goes out as well: it was recorded so, and each consumer rejects it.
        """
        try:
            if reading.topic == ELECTRODES.name:
                self._counts["frames_published"] += 1
                frame = ELECTRODE_FRAME.decode(reading.payload)
                self._counts["missing_frames"] += frame.stamp.missed_before
                # Frames that its recorder never got are missing as well. By its times of arrival:
                # a fast replay reads them all at once.
                arrived_ns = round(reading.time_s * 1e9)
                hole = self._holes.take("", frame.stamp, arrived_ns=arrived_ns)
                self._counts["missing_frames"] += hole
                self._counts["frames_untared"] += frame.tare_id == NO_TARE
            elif reading.topic == TARE.name:
                self._tares.recorded(TARE_CODEC.decode(reading.payload))
        except WireError:
            if reading.topic == TARE.name:
                self._tares.counters["tares_refused"] += 1
