"""Readings to messages: stamps, sequence numbers, tares, and the account of what was lost."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from concurrent.futures import Future
from dataclasses import dataclass, replace

from palpate.gateway.device import DeviceIdentity, DeviceInfo
from palpate.gateway.readings import (
    ElectrodeReading,
    FieldReading,
    PoseReading,
    Reading,
    RecordedMessage,
    WrenchReading,
)
from palpate.gateway.tare import MAX_SD_COUNTS, TARE_FRAMES, TareCollector, TareLedger
from palpate.gateway.timing.clock_map import ClockMap
from palpate.gateway.timing.stamps import Stamps
from palpate.protos.codec import ELECTRODE_FRAME
from palpate.protos.codec import TARE as TARE_CODEC
from palpate.protos.errors import DeviceError, PalpateError, WireError
from palpate.protos.messages import (
    NO_TARE,
    ElectrodeFrame,
    FieldFrame,
    IndenterPoseFrame,
    Tare,
    WrenchFrame,
)
from palpate.protos.topics import ELECTRODES, FIELD_TRUTH, POSE, TARE, WRENCH

_HELD_WINDOWS = 10
"""A recording is held back for this many attempts to tare before it goes out untared."""


@dataclass(frozen=True, slots=True)
class Outgoing:
    """What is to be published.

    Attributes:
        topic: Stream name.
        message: A message, or the bytes of a recorded one.
        due_ns: Host monotonic time at which it is to be published [ns]; 0 = at once.
    """

    topic: str
    message: ElectrodeFrame | WrenchFrame | IndenterPoseFrame | FieldFrame | Tare | bytes
    due_ns: int


class Pipeline:
    """One sensor's way from readings to messages. ``push`` and ``finish`` belong to one thread.

    A live sensor's frames go out at once, before its first tare with ``tare_id`` 0. A recording is
    held back until its first tare exists, so that every frame carries one.

    Args:
        info: The device's facts.
        tare_frames: Frames in a tare.
        max_sd_counts: Largest standard deviation of an untouched electrode [counts].
    """

    def __init__(
        self,
        info: DeviceInfo,
        *,
        tare_frames: int = TARE_FRAMES,
        max_sd_counts: float = MAX_SD_COUNTS,
    ) -> None:
        self.ledger = TareLedger()
        self.counters: dict[str, int] = dict.fromkeys(
            ("frames_published", "missing_frames", "frames_untared", "tares", "tares_refused"), 0
        )
        self.tare_error: DeviceError | None = None
        """Why the last attempt to tare failed; None after a success."""
        self._info = info
        self.tare_frames = tare_frames
        self._max_sd_counts = max_sd_counts
        self._serial = ""
        self._slot_period_ns = 0
        self._stamps = Stamps(info.origin)
        self._first_tare: TareCollector | None = TareCollector(tare_frames, max_sd_counts)
        self._held: list[Outgoing] = []
        self._held_frames = 0
        self._holding = not info.live
        self._lock = threading.Lock()
        self._asked: list[tuple[TareCollector, Future[Tare]]] = []
        self._over: str = ""

    def begin(self, identity: DeviceIdentity, clock: ClockMap) -> None:
        """The device was opened, or opened again; sequences and tares go on."""
        self._serial = identity.serial
        self._slot_period_ns = max(1, round(identity.slot_period_s * 1e9))
        self._stamps.begin(clock)

    def ask_tare(self, frames: int) -> Future[Tare]:
        """Tare with the next frames (0 = the usual number); from any thread.

        Raises:
            DeviceError: No further frames will come to be averaged.
        """
        future: Future[Tare] = Future()
        collector = TareCollector(frames or self.tare_frames, self._max_sd_counts)
        with self._lock:
            if self._over or self._info.driver == "record":
                raise DeviceError(
                    f"{self._serial or 'the sensor'} cannot be tared: "
                    f"{self._over or 'it is a record, which brings its own tares'}",
                    remedy="tare a live sensor, or ask for a known tare by its id",
                )
            self._asked.append((collector, future))
        return future

    def push(self, readings: Iterable[Reading], arrival_ns: int) -> list[Outgoing]:
        """Stamp and tare readings.

        Args:
            readings: In order of time.
            arrival_ns: Host monotonic clock when they arrived [ns].

        Returns:
            What is to be published, in order.
        """
        out: list[Outgoing] = []
        for reading in readings:
            if isinstance(reading, ElectrodeReading):
                self._electrodes(reading, arrival_ns, out)
            elif isinstance(reading, WrenchReading):
                stamp, due_ns = self._stamps.stamp(WRENCH.name, reading, arrival_ns)
                wrench = WrenchFrame(
                    stamp, reading.serial, reading.force, reading.torque, reading.overload
                )
                self._pass(Outgoing(WRENCH.name, wrench, due_ns), out)
            elif isinstance(reading, FieldReading):
                stamp, due_ns = self._stamps.stamp(FIELD_TRUTH.name, reading, arrival_ns)
                field = FieldFrame(stamp, self._serial, reading.mesh_sha256, reading.displacement)
                self._pass(Outgoing(FIELD_TRUTH.name, field, due_ns), out)
            elif isinstance(reading, PoseReading):
                stamp, due_ns = self._stamps.stamp(POSE.name, reading, arrival_ns)
                pose = IndenterPoseFrame(
                    stamp,
                    reading.indenter,
                    reading.position,
                    reading.orientation,
                    reading.in_contact,
                )
                self._pass(Outgoing(POSE.name, pose, due_ns), out)
            else:
                out.append(self._recorded(reading, arrival_ns))
        return out

    def finish(self, why: str = "the recording has ended") -> list[Outgoing]:
        """The source has ended: what is still held goes out untared."""
        with self._lock:
            self._over = why
            asked, self._asked = self._asked, []
        for _, future in asked:
            future.set_exception(
                DeviceError(f"not tared: {why}", remedy="tare while the sensor delivers")
            )
        if self._held_frames and self.tare_error is None:
            self.tare_error = DeviceError(
                f"{self._serial} delivered {self._held_frames} frames, a tare needs "
                f"{self.tare_frames}",
                remedy="replay a longer recording, or lower tare_frames",
            )
        return self._release(NO_TARE)

    def _electrodes(self, reading: ElectrodeReading, arrival_ns: int, out: list[Outgoing]) -> None:
        stamp, due_ns = self._stamps.stamp(
            ELECTRODES.name, reading, arrival_ns, reading.missed_before
        )
        kind = self._info.sensor_type
        if kind is None:
            raise RuntimeError(f"driver {self._info.driver!r} has electrodes and no sensor type")
        frame = ElectrodeFrame(
            stamp,
            self._serial,
            kind,
            reading.electrodes,
            reading.pdc,
            reading.pac,
            reading.tac,
            reading.tdc,
            reading.validity,
            self._slot_period_ns,
            self.ledger.current_id,
        )
        self.counters["missing_frames"] += reading.missed_before
        if self._holding:
            self._held.append(Outgoing(ELECTRODES.name, frame, due_ns))
            self._held_frames += 1
        else:
            self._emit(frame, due_ns, out)
        if self._first_tare is not None or self._asked:
            self._tare(frame, due_ns, out)

    def _tare(self, frame: ElectrodeFrame, due_ns: int, out: list[Outgoing]) -> None:
        """Offer the frame to the first tare and to those asked for."""
        if self._first_tare is not None:
            try:
                tare = self._first_tare.add(frame)
            except DeviceError as error:
                self._refused(error)
                tare = None
            if tare is not None:
                self._first_tare = None
                self._enter(tare, self._held[0].due_ns if self._held else due_ns, out)
                out.extend(self._release(tare.tare_id))
            elif self._held_frames >= _HELD_WINDOWS * self.tare_frames:
                out.extend(self._release(NO_TARE))
        with self._lock:
            asked = list(self._asked)
        for collector, future in asked:
            try:
                tare = collector.add(frame)
            except DeviceError as error:
                self._refused(error)
                self._answer(collector, future, error)
                continue
            if tare is not None:
                self._first_tare = None
                self._enter(tare, due_ns, out)
                if self._holding:
                    out.extend(self._release(tare.tare_id))
                self._answer(collector, future, tare)

    def _answer(
        self, collector: TareCollector, future: Future[Tare], answer: Tare | PalpateError
    ) -> None:
        with self._lock:
            self._asked = [item for item in self._asked if item[0] is not collector]
        if not future.set_running_or_notify_cancel():
            return
        if isinstance(answer, PalpateError):
            future.set_exception(answer)
        else:
            future.set_result(answer)

    def _enter(self, tare: Tare, due_ns: int, out: list[Outgoing]) -> None:
        self.ledger.enter(tare)
        self.tare_error = None
        self.counters["tares"] += 1
        out.append(Outgoing(TARE.name, tare, due_ns))

    def _refused(self, error: DeviceError) -> None:
        self.tare_error = error
        self.counters["tares_refused"] += 1

    def _pass(self, item: Outgoing, out: list[Outgoing]) -> None:
        (self._held if self._holding else out).append(item)

    def _release(self, tare_id: int) -> list[Outgoing]:
        """Stop holding back."""
        held, self._held = self._held, []
        self._holding = False
        self._held_frames = 0
        out: list[Outgoing] = []
        for item in held:
            if isinstance(item.message, ElectrodeFrame):
                self._emit(replace(item.message, tare_id=tare_id), item.due_ns, out)
            else:
                out.append(item)
        return out

    def _emit(self, frame: ElectrodeFrame, due_ns: int, out: list[Outgoing]) -> None:
        self.counters["frames_published"] += 1
        if frame.tare_id == NO_TARE:
            self.counters["frames_untared"] += 1
        out.append(Outgoing(ELECTRODES.name, frame, due_ns))

    def _recorded(self, reading: RecordedMessage, arrival_ns: int) -> Outgoing:
        """A recorded message goes out as it is; its tare is kept for those who ask."""
        if reading.topic == ELECTRODES.name:
            self.counters["frames_published"] += 1
            self._count_recorded_loss(reading.payload)
        elif reading.topic == TARE.name:
            try:
                self.ledger.enter(TARE_CODEC.decode(reading.payload))
                self.counters["tares"] += 1
            except WireError:  # it still goes out as recorded; whoever needs it will reject it
                self.counters["tares_refused"] += 1
        _, due_ns = self._stamps.times(reading.time_s, arrival_ns)
        return Outgoing(reading.topic, reading.payload, due_ns)

    def _count_recorded_loss(self, payload: bytes) -> None:
        try:
            frame = ELECTRODE_FRAME.decode(payload)
        except WireError:  # it still goes out as recorded; whoever needs it will reject it
            return
        self.counters["missing_frames"] += frame.stamp.missed_before
        self.counters["frames_untared"] += frame.tare_id == NO_TARE
