"""Readings to messages: stamps, sequence numbers, tares, and the account of what was lost."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from math import inf
from typing import Literal

from palpate.bus.topics import ELECTRODES, FIELD_TRUTH, POSE, TARE, WRENCH
from palpate.codec import ELECTRODE_FRAME
from palpate.codec import TARE as TARE_CODEC
from palpate.errors import DeviceError, WireError
from palpate.messages import (
    NO_TARE,
    ElectrodeFrame,
    FieldFrame,
    IndenterPoseFrame,
    Tare,
    WrenchFrame,
)
from palpate_gateway.condition.condition import Condition, Retare
from palpate_gateway.condition.stillness import StillLimits
from palpate_gateway.device import DeviceIdentity, DeviceInfo
from palpate_gateway.readings import (
    ElectrodeReading,
    FieldReading,
    PoseReading,
    Reading,
    RecordedMessage,
    WrenchReading,
)
from palpate_gateway.tare import TARE_FRAMES, TareLedger
from palpate_gateway.taring import Taring
from palpate_gateway.timing.clock_map import ClockMap
from palpate_gateway.timing.stamps import Stamps

TareMode = Literal["still", "first", "query"]
"""When a sensor is tared first: when it is still; when its electrodes do not vary; when asked."""

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
        tare: When to tare first; a recording is never as ``still`` says, but as ``first``.
        tare_frames: Frames in a tare.
        limits: What a sensor that nothing touches does not exceed.
        retare: When to tare again without being asked; None = never.
    """

    def __init__(
        self,
        info: DeviceInfo,
        *,
        tare: TareMode = "still",
        tare_frames: int = TARE_FRAMES,
        limits: StillLimits | None = None,
        retare: Retare | None = None,
    ) -> None:
        self._limits = limits or StillLimits()
        electrodes_only = replace(self._limits, pac_sd=inf, pdc_sd=inf)
        if tare == "first":
            self._limits = electrodes_only
        # A recording cannot wait for better frames.
        taring = self._limits if info.live else electrodes_only
        self._tares_itself = tare != "query"
        self._taring = Taring(tare_frames, taring, at_start=self._tares_itself)
        self._retare = retare
        self.condition: Condition | None = None
        """How the sensor does; None = it has no electrodes, or was not opened yet."""
        self._counts = dict.fromkeys(
            ("frames_published", "missing_frames", "frames_untared", "retares"), 0
        )
        self._info = info
        self._kind = info.sensor_type
        self.tare_frames = tare_frames
        self._serial = ""
        self._slot_period_ns = 0
        self._stamps = Stamps(info.origin)
        self._held: list[Outgoing] = []
        self._held_frames = 0
        # What has no electrodes is never tared: it would be held to its end.
        self._holding = not info.live and info.sensor_type is not None and self._tares_itself

    @property
    def ledger(self) -> TareLedger:
        """Every tare of this run."""
        return self._taring.ledger

    @property
    def counters(self) -> dict[str, int]:
        """What was published, lost, tared and found wrong."""
        condition = {} if self.condition is None else self.condition.counters
        return {**self._counts, **self._taring.counters, **condition}

    @property
    def tare_error(self) -> DeviceError | None:
        """Why the last attempt to tare failed; None after a success."""
        return self._taring.error

    def begin(self, identity: DeviceIdentity, clock: ClockMap) -> None:
        """The device was opened, or opened again; sequences and tares go on."""
        self._serial = identity.serial
        self._slot_period_ns = max(1, round(identity.slot_period_s * 1e9))
        kind = identity.sensor_type or self._info.sensor_type
        if kind is not self._kind and self.ledger.current_id != NO_TARE:
            # A finger with other electrodes: the old baseline is not its own.
            self.ledger.leave()
            if self._tares_itself:
                self._taring.attempt()
        if kind is not None and (self.condition is None or kind is not self._kind):
            rate_hz = 1.0 / (identity.slot_period_s * kind.layout.slots)
            self.condition = Condition(kind.layout, rate_hz, self._limits, self._retare)
        elif self.condition is not None:
            self.condition.begin()
        self._kind = kind
        self._stamps.begin(clock)

    def ask_tare(self, frames: int) -> Future[Tare]:
        """Tare with the next frames (0 = the usual number); from any thread.

        Raises:
            DeviceError: No further frames will come to be averaged.
        """
        is_record = self._info.driver == "record"
        return self._taring.ask(
            frames,
            sensor=self._serial or "the sensor",
            never="it is a record, which brings its own tares" if is_record else "",
        )

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
                stamp, due_ns = self._stamps.stamp(
                    POSE.name, reading, arrival_ns, reading.missed_before
                )
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
        self._taring.finish(why)
        if self._held_frames and self.tare_error is None:
            self._taring.error = DeviceError(
                f"{self._serial} delivered {self._held_frames} frames, a tare needs "
                f"{self.tare_frames}",
                remedy="replay a longer recording, or lower tare_frames",
            )
        return self._release(NO_TARE)

    def _electrodes(self, reading: ElectrodeReading, arrival_ns: int, out: list[Outgoing]) -> None:
        stamp, due_ns = self._stamps.stamp(
            ELECTRODES.name, reading, arrival_ns, reading.missed_before
        )
        kind = self._kind
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
        self._counts["missing_frames"] += reading.missed_before
        if self._holding:
            self._held.append(Outgoing(ELECTRODES.name, frame, due_ns))
            self._held_frames += 1
        else:
            self._emit(frame, due_ns, out)
        self._watch(frame)
        for tare in self._taring.offer(frame):
            self._enter(tare, due_ns, out)
        if self._held_frames >= _HELD_WINDOWS * self.tare_frames:
            out.extend(self._release(NO_TARE))

    def _watch(self, frame: ElectrodeFrame) -> None:
        """Let the sensor's condition follow; it may ask for another tare."""
        condition = self.condition
        assert condition is not None, "begin() comes before push()"
        if condition.add(frame) and condition.wants_tare and not self._taring.attempting:
            self._counts["retares"] += 1
            self._taring.attempt()

    def _enter(self, tare: Tare, due_ns: int, out: list[Outgoing]) -> None:
        """Tell of a tare, and let go what was held back for it."""
        if self.condition is not None:
            self.condition.tared(tare)
        out.append(Outgoing(TARE.name, tare, self._held[0].due_ns if self._held else due_ns))
        if self._holding:
            out.extend(self._release(tare.tare_id))

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
        self._counts["frames_published"] += 1
        if frame.tare_id == NO_TARE:
            self._counts["frames_untared"] += 1
        out.append(Outgoing(ELECTRODES.name, frame, due_ns))

    def _recorded(self, reading: RecordedMessage, arrival_ns: int) -> Outgoing:
        """A recorded message goes out as it is; its tare is kept for those who ask."""
        if reading.topic == ELECTRODES.name:
            self._counts["frames_published"] += 1
            self._count_recorded_loss(reading.payload)
        elif reading.topic == TARE.name:
            try:
                self._taring.recorded(TARE_CODEC.decode(reading.payload))
            except WireError:  # it still goes out as recorded; whoever needs it will reject it
                self._taring.counters["tares_refused"] += 1
        _, due_ns = self._stamps.times(reading.time_s, arrival_ns)
        return Outgoing(reading.topic, reading.payload, due_ns)

    def _count_recorded_loss(self, payload: bytes) -> None:
        try:
            frame = ELECTRODE_FRAME.decode(payload)
        except WireError:  # it still goes out as recorded; whoever needs it will reject it
            return
        self._counts["missing_frames"] += frame.stamp.missed_before
        self._counts["frames_untared"] += frame.tare_id == NO_TARE
