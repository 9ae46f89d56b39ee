"""Robotous RFT over a serial line or CAN (hardware reference 3.5).

Samples have neither number nor time: they get the host's time, and a lost sample looks like a late
one. The sensor does not report a restart: it falls silent.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.clock.sample_times import ArrivalTimes
from palpate_gateway.ports.can_bus import CanBus, check_bitrate
from palpate_gateway.ports.serial_port import SerialPort
from palpate_gateway.protocols import robotous as wire
from palpate_gateway.protocols.robotous import (
    FIRST_ID,
    REQUEST_ID,
    SECOND_ID,
    RobotousCanDecoder,
    RobotousCommand,
    RobotousData,
    RobotousRecord,
    RobotousSerialDecoder,
    serial_frame,
)
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.device import WrenchDevice, WrenchOptions

_APART = 0.75
"""Halves that are further apart belong to two samples [periods]."""

_SCATTER_S = 2e-3
"""But so far apart may be the stamps of two halves of one sample [s]: a stamp scatters by 0.9 ms
(hardware reference 5.1), and a USB adapter delivers once a millisecond."""


class RobotousSerialLine:
    """A serial line to one sensor: requests go out, the data bytes of answers come in."""

    def __init__(self, port: str, baud: int) -> None:
        self.name = f"{port} at {baud} bit/s"
        self._port = SerialPort(port, baud)
        self._decoder = RobotousSerialDecoder()

    @property
    def counters(self) -> Mapping[str, int]:
        """Events since the last opening."""
        return self._decoder.counters

    def open(self) -> None:
        """Connect; raises the errors of the port."""
        self._decoder = RobotousSerialDecoder()
        self._port.open()

    def close(self) -> None:
        """Disconnect; never raises."""
        self._port.close()

    def send(self, request: bytes) -> None:
        """Send the data bytes of a request."""
        self._port.write(serial_frame(request))

    def read(self, timeout_s: float) -> list[bytes]:
        """Data bytes of the answers that are now complete; may be none, e.g. from half a frame.

        Raises:
            DeviceTimeout: Nothing came.
            DeviceLost: The line is gone.
        """
        return self._decoder.feed(self._port.read(timeout_s))


class RobotousCanLine:
    """A CAN bus to one sensor, as ``RobotousSerialLine``; other devices may use the bus, too."""

    def __init__(
        self, bus: CanBus, *, request_id: int, first_id: int, second_id: int, period_s: float
    ) -> None:
        self.name = bus.name
        self._bus = bus
        self._request_id, self._ids = request_id, (first_id, second_id)
        self._apart_ns = round(1e9 * max(_APART * period_s, _SCATTER_S))
        self._first_ns = 0
        self._decoder = RobotousCanDecoder(*self._ids)

    @property
    def counters(self) -> Mapping[str, int]:
        """Events since the last opening."""
        return {**self._decoder.counters, **self._bus.counters}

    def open(self) -> None:
        """Connect; raises the errors of the port."""
        self._decoder = RobotousCanDecoder(*self._ids)
        self._bus.counters.update(dict.fromkeys(self._bus.counters, 0))
        self._bus.open()

    def close(self) -> None:
        """Disconnect; never raises."""
        self._bus.close()

    def send(self, request: bytes) -> None:
        """Send the data bytes of a request."""
        self._bus.write(self._request_id, request)

    def read(self, timeout_s: float) -> list[bytes]:
        """See ``RobotousSerialLine``."""
        out = []
        for can_id, data, arrival_ns in self._bus.read(timeout_s).messages():
            # Samples have no numbers: only the times show that two halves do not belong together.
            if self._decoder.pending and arrival_ns - self._first_ns > self._apart_ns:
                self._decoder.reset()
            if can_id == self._ids[0]:
                self._first_ns = arrival_ns
            out += self._decoder.feed(can_id, data)
        return out


_ANSWER_S = 0.3
_ATTEMPTS = 3
_QUIET_S = 0.03
_DRAIN_S = 0.3
_SILENCE_S = 0.3
"""Silence that is taken as a restart; longer at low rates [s]."""

_CROWDED = 1.3
"""A sensor does not send so many times the samples that it was set to; two of them do."""

_ZERO_SAMPLES = 5
_ROUNDING = 2.0
"""Counts that a sensor without noise may still read after its zero."""


class RobotousOptions(WrenchOptions):
    """Options of the ``wrench_robotous`` driver; ``port``, or ``interface`` and ``channel``.

    Attributes:
        port: Serial line, e.g. ``/dev/serial/by-id/usb-...``.
        baud: Speed that is set in the sensor [bit/s].
        interface: python-can's name of the kind of bus, e.g. ``socketcan``.
        channel: Its name, e.g. ``can0``.
        bitrate: Bit rate of the bus [bit/s]; 0 = leave its setting, as ``socketcan`` requires.
        bus_options: Further options of python-can; for ``udp_multicast`` also ``listen``, the
            address of the network that is joined: without it only this host is heard.
        request_id: CAN identifier of requests.
        first_id: CAN identifier of the first half of an answer.
        second_id: CAN identifier of the second half.
        rate_hz: Samples each second; a serial line must be fast enough for it.
        cutoff_hz: Cutoff of the sensor's low-pass [Hz]; 0 = none.
        filter_order: Order in which the sensor numbers its cutoffs; check it by the noise.
        model: E.g. ``RFT64-SB01``; empty = as the sensor reports.
        torque_divisor: Counts per N m; None = by the model.
    """

    port: str = ""
    baud: int = 115200
    interface: str = ""
    channel: str = ""
    bitrate: int = Field(default=0, ge=0)
    bus_options: dict[str, Any] = Field(default_factory=dict)
    request_id: int = Field(default=REQUEST_ID, ge=1, le=255)
    first_id: int = Field(default=FIRST_ID, ge=1, le=255)
    second_id: int = Field(default=SECOND_ID, ge=1, le=255)
    rate_hz: int = 200
    cutoff_hz: int = 0
    filter_order: wire.RobotousFilterOrder = wire.RobotousFilterOrder.MANUALS
    model: str = ""
    torque_divisor: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _fits(self) -> RobotousOptions:
        if bool(self.port) == bool(self.interface and self.channel):
            raise ValueError("give either port (serial line), or interface and channel (CAN)")
        wire.rate_request(self.rate_hz)
        wire.filter_request(self.cutoff_hz or None, order=self.filter_order)
        if self.model:
            wire.scale_of(self.model, torque_divisor=self.torque_divisor)
        if self.port:
            wire.baud_request(self.baud)
            highest = wire.HIGHEST_RATE_HZ[self.baud]
            if self.rate_hz > highest:
                raise ValueError(f"rate_hz {self.rate_hz} is above {highest} for {self.baud} bit/s")
        else:
            RobotousCanDecoder(self.first_id, self.second_id)
            check_bitrate(self.interface, self.bitrate)
        return self


def _line_of(options: RobotousOptions) -> RobotousSerialLine | RobotousCanLine:
    if options.port:
        return RobotousSerialLine(options.port, options.baud)
    return RobotousCanLine(
        CanBus(
            options.interface,
            options.channel,
            bitrate=options.bitrate,
            options=options.bus_options,
        ),
        request_id=options.request_id,
        first_id=options.first_id,
        second_id=options.second_id,
        period_s=1.0 / options.rate_hz,
    )


class WrenchRobotous(WrenchDevice):
    """An RFT sensor."""

    options_class = RobotousOptions
    needs = ("serial", "can")

    def __init__(self, options: RobotousOptions) -> None:
        self._line = _line_of(options)
        model = f"Robotous RFT on {self._line.name}"
        super().__init__("wrench_robotous", model, float(options.rate_hz), options)
        self._options = options
        self.address = options.port or f"{self._line.name}, identifier {options.first_id}"
        self._has_clock = False
        self._silence_s = max(_SILENCE_S, 5.0 / options.rate_hz)
        self._scale = wire.RobotousScale(1.0)
        self._arrivals = ArrivalTimes(1.0 / options.rate_hz)
        self._crowded = False

    def zero(self) -> None:
        """See ``WrenchDevice``; what comes meanwhile is thrown away.

        The request has no answer, so the samples after it must show that it was taken.
        """
        before, spread_before = self._load()
        for _ in range(_ATTEMPTS):
            self._line.send(wire.BIAS_REQUEST)
            self._load()  # some of these samples may have been on their way
            after, spread = self._load()
            noise = spread_before + spread + _ROUNDING
            if np.all(abs(after) <= 0.5 * abs(before) + noise):
                return
        raise DeviceError(
            f"{self.info.model}: it took no zero: {after.round().astype(int).tolist()} counts "
            "are left",
            remedy="leave the load unchanged while zero is taken",
        )

    def _connect(self) -> str:
        self._line.open()
        self._line.send(wire.STOP_REQUEST)
        until = time.monotonic() + _DRAIN_S
        with contextlib.suppress(DeviceTimeout):
            while time.monotonic() < until:
                self._line.read(_QUIET_S)
        reported = self._text(RobotousCommand.MODEL)
        serial = self._text(RobotousCommand.SERIAL)
        self._scale = self._scale_of(reported)
        cutoff_hz = self._options.cutoff_hz or None
        self._set(wire.filter_request(cutoff_hz, order=self._options.filter_order))
        self._set(wire.rate_request(self._options.rate_hz))
        self._answer(wire.START_REQUEST, RobotousCommand.START)
        self._arrivals = ArrivalTimes(1.0 / self.info.rate_hz)
        if self._crowded:
            until = time.monotonic() + self._arrivals.check_s
            while time.monotonic() < until:
                with contextlib.suppress(DeviceTimeout):
                    self._receive(_QUIET_S)
            self._crowded = False
        return serial or self._line.name

    def _scale_of(self, reported: str) -> wire.RobotousScale:
        model, divisor = self._options.model or reported, self._options.torque_divisor
        try:
            scale = wire.scale_of(model, torque_divisor=divisor)
        except ValueError as error:
            raise DeviceError(
                f"{self.info.model}: {error}", remedy="set model or torque_divisor (its manual)"
            ) from error
        with contextlib.suppress(ValueError):
            if divisor is None and wire.scale_of(reported) != scale:
                raise DeviceError(
                    f"{self.info.model}: it says that it is a {reported}, not a {model}",
                    remedy="correct model, or set torque_divisor",
                )
        return scale

    def _close(self) -> None:
        with contextlib.suppress(DeviceError):
            self._line.send(wire.STOP_REQUEST)
        self._line.close()

    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        samples = self._unless_silent(self._samples, timeout_s, self._silence_s)
        return self._readings(samples) if samples else []

    def _readings(self, samples: Sequence[RobotousData]) -> list[WrenchReading]:
        times_ns = self._arrivals.times_ns(len(samples), time.monotonic_ns())
        if self._options.interface and self._arrivals.rate_hz > _CROWDED * self.info.rate_hz:
            self._crowded = True
            raise DeviceLost(
                f"{self.info.model}: {self._arrivals.rate_hz:.0f} samples/s come, not "
                f"{self.info.rate_hz:g}: more than one sensor has its CAN identifiers",
                remedy="give each sensor on the bus its own CAN identifiers",
            )
        readings = []
        for arrival_ns, sample in zip(times_ns, samples, strict=True):
            for axis in wire.overloaded_axes(sample.overload):
                self._counts[f"status_overload_{axis.lower()}"] += 1
            wrench = self._scale.wrench(sample.counts)
            reading = self._reading(wrench, arrival_ns=arrival_ns, overload=sample.overload != 0)
            if reading is not None:
                readings.append(reading)
        return readings

    def _samples(self, timeout_s: float) -> list[RobotousData]:
        records = [wire.decode(payload) for payload in self._line.read(timeout_s)]
        samples = [
            r for r in records if isinstance(r, RobotousData) and r.command == RobotousCommand.START
        ]
        self._counts["other_answers"] += len(records) - len(samples)
        return samples

    def _load(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Mean and spread of the next samples [counts], shape ``(6,)`` each."""
        samples: list[RobotousData] = []
        until = time.monotonic() + self._silence_s + 2.0 * _ZERO_SAMPLES / self.info.rate_hz
        while len(samples) < _ZERO_SAMPLES:
            samples += self._samples(max(until - time.monotonic(), 0.0))
        self._arrivals.begin()
        if any(sample.overload for sample in samples):
            raise DeviceError(f"{self.info.model}: it is overloaded", remedy="take the load off")
        counts = np.array([sample.counts for sample in samples], np.float64)
        return counts.mean(axis=0), np.ptp(counts, axis=0)

    def _text(self, command: RobotousCommand) -> str:
        record = self._answer(wire.request(command), command)
        return record.text if isinstance(record, wire.RobotousText) else ""

    def _set(self, request: bytes) -> None:
        record = self._answer(request, RobotousCommand(request[0]))
        if not (isinstance(record, wire.RobotousResult) and record.ok):
            why = wire.ERRORS.get(getattr(record, "error", 0), "no reason given")
            raise DeviceError(
                f"{self.info.model}: {_name(request)} was refused: {why}",
                remedy="choose another rate or filter, or raise the sensor's baud",
            )

    def _answer(self, request: bytes, command: RobotousCommand) -> RobotousRecord:
        """The first answer to a request; the request is repeated if none comes.

        Raises:
            DeviceTimeout: None came.
        """
        patience_s = _ANSWER_S + 2.0 / self.info.rate_hz
        for attempt in range(_ATTEMPTS):
            if attempt:  # while it streams it ignores most requests
                self._line.send(wire.STOP_REQUEST)
            self._line.send(request)
            until = time.monotonic() + patience_s
            with contextlib.suppress(DeviceTimeout):
                while (left_s := until - time.monotonic()) > 0.0:
                    for payload in self._line.read(left_s):
                        if payload[0] == command:
                            return wire.decode(payload)
        came = ", ".join(f"{count} {name}" for name, count in self._line.counters.items() if count)
        raise DeviceTimeout(
            f"{self.info.model}: {_name(request)} was not answered; it sent: {came or 'nothing'}",
            remedy="check power, wiring, terminators, and baud or CAN identifiers",
        )

    def _protocol_counters(self) -> Mapping[str, int]:
        return {**self._line.counters, **self._arrivals.counters}


def _name(request: bytes) -> str:
    return f"request {request[0]} ({RobotousCommand(request[0]).name.lower()})"
