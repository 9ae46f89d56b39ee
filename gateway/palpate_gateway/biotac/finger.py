"""A BioTac or BioTac SP at one port of a line that several fingers may share."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from palpate.config import StrictConfig
from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate.messages import BIOTAC_SP_LAYOUT, Origin, SensorType
from palpate_gateway.biotac.frames import FrameAssembler
from palpate_gateway.biotac.slot_link import FingerQueue, SlotLink, SlotSource
from palpate_gateway.biotac.slots import SlotBlock
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo, SerialOption, silence_of
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import Reading

TypeOption = Literal["auto", "biotac", "biotac_sp"]
"""Setting of the sensor type; ``auto`` = by the electrodes that answer."""

SequenceOption = Literal[
    "learn", "biotac_e1_first", "biotac_pac_first", "biotac_sp_e1_first", "biotac_sp_pac_first"
]
"""Setting of the order of sampling; ``learn`` = from the stream."""

LEARNT_FROM = 2 * BIOTAC_SP_LAYOUT.slots
"""So many slots hold a whole frame of either type, wherever they begin."""


def answering_type(slots: SlotBlock) -> SensorType:
    """BioTac or BioTac SP, by the electrodes that answer; missing ones answer by error words.

    The serial number is no guide: the public capture of an SP (BTSP...) is sampled as a BioTac,
    with 19 electrodes in 44 slots (hardware reference 1.7).
    """
    more = (slots.channel >= ch.FIRST_ELECTRODE + ch.ELECTRODES) & slots.good
    return SensorType.BIOTAC_SP if more.any() else SensorType.BIOTAC


def agreed_type(wanted: TypeOption, slots: SlotBlock, what: str) -> SensorType:
    """The sensor type by which to read a finger.

    Args:
        wanted: The setting.
        slots: At least ``LEARNT_FROM`` slots of the finger, unless it stopped answering.
        what: Name of the finger, for errors.

    Raises:
        DeviceError: The finger answers as another type.
    """
    found = answering_type(slots)
    if wanted in ("auto", found.name.lower()):
        return found
    raise DeviceError(
        f"{what}: sensor_type is {wanted}, but {found.layout.electrodes} electrodes answer",
        remedy=f"set sensor_type = {found.name.lower()!r} or 'auto', or correct what the sender "
        "samples",
    )


ABSENT_SLOTS = ch.SLOTS_PER_FRAME
"""A whole frame of absent words (00 00 or FF FF) shows that no finger is plugged in."""

_FIRST_S = 2.0
"""Longest time to the first word of a finger [s]."""


class FingerOptions(StrictConfig):
    """Options of every driver of a BioTac on a shared line.

    Attributes:
        port: Which finger of the line, from 1.
        serial: Serial number to publish; empty = the one that the line sends, else line and port.
        sensor_type: Type of finger; ``auto`` = by the electrodes that answer, which takes 25 ms at
            the start.
        sequence: Order of sampling; ``learn`` = from the stream, which takes 30 ms at the start.
    """

    port: int = Field(default=1, ge=1, le=5)
    serial: SerialOption = ""
    # Excluded from the settings of the line: its fingers may be of different types.
    sensor_type: TypeOption = Field(default="auto", exclude=True)
    sequence: SequenceOption = "learn"


class FingerDevice(Device):
    """A live BioTac whose slots come over a shared line. Subclasses open the line."""

    def __init__(self, driver: str, model: str, options: FingerOptions) -> None:
        wanted = options.sensor_type
        kind = SensorType.BIOTAC if wanted == "auto" else SensorType[wanted.upper()]
        super().__init__(
            DeviceInfo(
                driver=driver,
                sensor_type=kind,
                model=f"{model}, port {options.port}",
                rate_hz=ch.frame_rate_hz(kind.layout),
                live=True,
                finite=False,
                origin=Origin.LIVE,
            )
        )
        self._options = options
        self._finger: FingerQueue | None = None
        self._line_before: Mapping[str, int] = {}
        self._line_last: Mapping[str, int] = {}
        self._early: SlotBlock | None = None
        self._assembler = FrameAssembler(1.0 / ch.SLOT_RATE_HZ)

    @abstractmethod
    def _line(self) -> tuple[object, object, SlotSource, int]:
        """Key of the line, its settings, a source if it is not open yet, number of ports."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of frames, of the line, and of slots that this process was too slow to take.

        They stay after closing, and after an opening that failed.
        """
        # Those of the line are exact where both have one: the assembler takes any bad word for a
        # parity error, and sees no slot that the line has dropped.
        return {**self._assembler.counters, **self._line_counters()}

    def _line_counters(self) -> Mapping[str, int]:
        finger = self._finger
        if finger is None:
            return self._line_last
        before = self._line_before
        line = finger.source.counters(finger.index).items()
        since = {name: count - before.get(name, 0) for name, count in line}
        return {**since, "dropped_slots": finger.dropped}

    def _open(self) -> DeviceIdentity:
        key, settings, source, ports = self._line()
        port = self._options.port
        if port > ports:
            raise ConfigError(
                f"{self.info.model}: the line has {ports} ports", remedy="correct port or fingers"
            )
        self._assembler = FrameAssembler(1.0 / ch.SLOT_RATE_HZ)  # its counters begin anew
        self._line_last = {}
        try:
            finger = SlotLink.join(key, settings, source, port - 1)
        except DeviceError:
            self._line_last = source.counters(port - 1)
            raise
        # Other fingers may have the line open for long.
        self._line_before = finger.source.counters(finger.index)
        self._finger = finger
        try:
            self._early = self._wait_for_words(finger)
            kind = agreed_type(self._options.sensor_type, self._early, self.info.model)
        except BaseException:
            self._close()
            raise
        self._assembler = FrameAssembler(finger.source.slot_period_s, kind.layout)
        known = finger.source.serial(port - 1)
        name = "-".join(str(part) for part in key) if isinstance(key, tuple) else str(key)
        return DeviceIdentity(
            self._options.serial or known or f"{name}-port{port}",
            finger.source.slot_period_s,
            sensor_type=kind,
        )

    def _close(self) -> None:
        self._line_last = self._line_counters()
        finger, self._finger = self._finger, None
        if finger is not None:
            finger.leave()

    def _read(self, timeout_s: float) -> list[Reading]:
        finger = self._finger
        assert finger is not None
        if self._assembler.counters["other_electrodes"]:
            known = self._assembler.layout.electrodes
            raise DeviceLost(
                f"{self.info.model}: more than {known} electrodes answer",
                remedy="another finger was plugged in; it is opened again by itself",
            )
        until = time.monotonic() + timeout_s
        while True:
            slots, self._early = self._early, None
            if slots is None:
                slots = finger.take(max(0.0, until - time.monotonic()))
            good = np.flatnonzero(slots.good)
            if not len(good):
                # Only then: what came before the plug was pulled is delivered first.
                self._check_there(finger)
            elif finger.absent >= ABSENT_SLOTS:
                slots = slots.part(0, int(good[-1]) + 1)
            readings = self._assembler.push(slots)
            if readings:
                observed = finger.source.observed
                return [replace(reading, observed=observed) for reading in readings]
            if time.monotonic() >= until:
                raise DeviceTimeout(
                    f"{self.info.model}: no whole frame within {timeout_s:g} s",
                    remedy="slots come, but no frame: check the order of sampling",
                )

    def _wait_for_words(self, finger: FingerQueue) -> SlotBlock:
        """Wait until the finger has answered and all of its electrodes have been sampled.

        An empty port must not count as a sensor.
        """
        came: list[SlotBlock] = []
        answered = False
        until = time.monotonic() + _FIRST_S
        while True:
            try:
                came.append(finger.take(max(0.0, until - time.monotonic())))
            except DeviceTimeout as error:
                if answered:
                    return SlotBlock.joined(came)
                raise self._no_word(bool(came)) from error
            answered = answered or bool(came[-1].good.any())
            if answered and sum(map(len, came)) >= LEARNT_FROM:
                return SlotBlock.joined(came)
            self._check_there(finger)

    def _no_word(self, slots_came: bool) -> DeviceError:
        if slots_came:
            return DeviceError(
                f"{self.info.model}: slots come, but no word of this finger is good",
                remedy="look its counters up on the device's page (parity_errors, device_error_...)"
                "; check its cable and 'port'",
            )
        problem, remedy = silence_of(
            self.info.model,
            _FIRST_S,
            self.counters,
            {},
            "check power, wiring and bit rate, and that the sender is on",
        )
        return DeviceError(problem, remedy=remedy)

    def _check_there(self, finger: FingerQueue) -> None:
        if finger.absent >= ABSENT_SLOTS:
            raise DeviceLost(
                f"{self.info.model}: no finger answers (every word is 00 00 or FF FF)",
                remedy="check its plug and cable; it is looked for again by itself",
            )
