"""BioTac or BioTac SP: by the electrodes that answer, or as the user says.

The serial number does not tell: the public capture of an SP (BTSP...) is sampled as a BioTac, with
19 electrodes in 44 slots (hardware reference 1.7).


A BioTac at one port of a line that several fingers may share.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

from pydantic import Field

from palpate.config import StrictConfig
from palpate.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from palpate.messages import BIOTAC_SP_LAYOUT, Origin, SensorType
from palpate_gateway.biotac.frames import FrameAssembler
from palpate_gateway.biotac.slot_link import FingerQueue, SlotLink, SlotSource
from palpate_gateway.biotac.slots import SlotBlock
from palpate_gateway.device import SERIAL_MAX, Device, DeviceIdentity, DeviceInfo
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import Reading

TypeOption = Literal["auto", "biotac", "biotac_sp"]
"""What a user may say; ``auto`` = by the electrodes that answer."""

LEARNT_FROM = 2 * BIOTAC_SP_LAYOUT.slots
"""Slots that hold a whole frame of either kind, wherever they begin."""


def answering_type(slots: SlotBlock) -> SensorType:
    """The type whose electrodes answer; one that is only asked for them answers by error words."""
    more = (slots.channel >= ch.FIRST_ELECTRODE + ch.ELECTRODES) & slots.good
    return SensorType.BIOTAC_SP if more.any() else SensorType.BIOTAC


def agreed_type(wanted: TypeOption, slots: SlotBlock, what: str) -> SensorType:
    """The type to read a finger as.

    Args:
        wanted: What the user says.
        slots: At least ``LEARNT_FROM`` slots of the finger, unless it ceased to answer.
        what: The finger, for errors.

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
"""After a whole frame of words that say "no finger here" there is none."""

_FIRST_S = 2.0
"""How long a line may take to bring the first word of a finger [s]."""


class FingerOptions(StrictConfig):
    """Options of every driver of a BioTac on a shared line.

    Attributes:
        port: Which finger of the line, from 1.
        serial: Serial number to publish; empty = what the line tells, else line and port.
        sensor_type: Kind of finger; ``auto`` = by the electrodes that answer, which takes 25 ms at
            the start.
    """

    port: int = Field(default=1, ge=1, le=5)
    serial: str = Field(default="", max_length=SERIAL_MAX, pattern=r"^[ -~]*$")
    # No setting of the line, whose fingers may differ: left out of what they must agree on.
    sensor_type: TypeOption = Field(default="auto", exclude=True)


class FingerDevice(Device):
    """A live BioTac whose slots come over a shared line. Subclasses say which.

    Args:
        driver: Name in the driver table.
        model: One line for people.
        options: Port and serial.
    """

    def __init__(self, driver: str, model: str, options: FingerOptions) -> None:
        told = options.sensor_type
        kind = SensorType.BIOTAC if told == "auto" else SensorType[told.upper()]
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
        self._early: SlotBlock | None = None
        self._assembler = FrameAssembler(1.0 / ch.SLOT_RATE_HZ)

    @abstractmethod
    def _line(self) -> tuple[object, object, SlotSource, int]:
        """Key and settings of the line, the line itself for the first that opens it, its ports."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of frames, of the line, and of what this process was too slow to take."""
        finger = self._finger
        if finger is None:
            return self._assembler.counters
        line = finger.source.counters(finger.index)
        return {**line, **self._assembler.counters, "dropped_slots": finger.dropped}

    def _open(self) -> DeviceIdentity:
        key, settings, source, ports = self._line()
        port = self._options.port
        if port > ports:
            raise ConfigError(
                f"{self.info.model}: the line has {ports} ports", remedy="correct port or fingers"
            )
        self._finger = finger = SlotLink.join(key, settings, source, port - 1)
        try:
            self._early = self._wait_for_words(finger)
            kind = agreed_type(self._options.sensor_type, self._early, self.info.model)
        except BaseException:
            self._close()
            raise
        self._assembler = FrameAssembler(finger.source.slot_period_s, kind.layout)
        told = finger.source.serial(port - 1)
        name = "-".join(str(part) for part in key) if isinstance(key, tuple) else str(key)
        return DeviceIdentity(
            self._options.serial or told or f"{name}-port{port}",
            finger.source.slot_period_s,
            sensor_type=kind,
        )

    def _close(self) -> None:
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
            self._check_there(finger)
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
        """Wait until the finger has answered, so that an empty port is not taken for a sensor.

        And until all of its electrodes have been asked.
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
                raise DeviceError(
                    f"{self.info.model}: no slot within {_FIRST_S:g} s",
                    remedy="check power, wiring and bit rate, and that the sender is on",
                ) from error
            answered = answered or bool(came[-1].good.any())
            if answered and sum(map(len, came)) >= LEARNT_FROM:
                return SlotBlock.joined(came)
            self._check_there(finger)

    def _check_there(self, finger: FingerQueue) -> None:
        if finger.absent >= ABSENT_SLOTS:
            raise DeviceLost(
                f"{self.info.model}: no finger answers (every word is 00 00 or FF FF)",
                remedy="check its plug and cable; it is looked for again by itself",
            )
