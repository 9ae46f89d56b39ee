"""Robotous RFT over a serial line or CAN (hardware reference 3.5).

Samples hold neither counter nor time, so the host's time counts, and a lost sample cannot be told
from one that came late. The sensor says nothing when it restarts: it falls silent.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence

from pydantic import Field, model_validator

from palpate.errors import DeviceError, DeviceTimeout
from palpate_gateway.clock.sample_times import ArrivalTimes
from palpate_gateway.ports.can_bus import CanBus
from palpate_gateway.protocols import robotous as ask
from palpate_gateway.protocols.robotous import (
    FIRST_ID,
    REQUEST_ID,
    SECOND_ID,
    RobotousCanDecoder,
    RobotousCommand,
    RobotousData,
    RobotousRecord,
)
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.device import WrenchDevice, WrenchOptions
from palpate_gateway.wrench.robotous_line import RobotousCanLine, RobotousLine, RobotousSerialLine

_ANSWER_S = 0.3
_ATTEMPTS = 3
_QUIET_S = 0.03
_DRAIN_S = 0.3
_SILENCE_S = 0.3
"""Silence after which the sensor has restarted, unless it is that slow by itself [s]."""

_ZERO_SAMPLES = 5
_NEAR_ZERO = 20.0
"""Noise that a zero may leave [counts]."""


class RobotousOptions(WrenchOptions):
    """Options of the ``wrench_robotous`` driver; ``port``, or ``interface`` and ``channel``.

    Attributes:
        port: Serial line, e.g. ``/dev/serial/by-id/usb-...``.
        baud: Its rate as the sensor is set [bit/s].
        interface: python-can's name of the kind of bus, e.g. ``socketcan``.
        channel: Its name, e.g. ``can0``.
        bitrate: Of the bus [bit/s]; 0 = as it is set up.
        request_id: CAN identifier of requests.
        first_id: CAN identifier of the first half of an answer.
        second_id: CAN identifier of the second half.
        rate_hz: Samples each second; a serial line must be fast enough for it.
        cutoff_hz: Of the sensor's low-pass [Hz]; 0 = none.
        filter_order: How the sensor numbers cutoffs; confirm it by the noise.
        model: E.g. ``RFT64-SB01``; empty = as the sensor tells.
        torque_divisor: Counts per N m; None = by the model.
    """

    port: str = ""
    baud: int = 115200
    interface: str = ""
    channel: str = ""
    bitrate: int = Field(default=0, ge=0)
    request_id: int = Field(default=REQUEST_ID, ge=1, le=255)
    first_id: int = Field(default=FIRST_ID, ge=1, le=255)
    second_id: int = Field(default=SECOND_ID, ge=1, le=255)
    rate_hz: int = 200
    cutoff_hz: int = 0
    filter_order: ask.RobotousFilterOrder = ask.RobotousFilterOrder.MANUALS
    model: str = ""
    torque_divisor: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _fits(self) -> RobotousOptions:
        if bool(self.port) == bool(self.interface and self.channel):
            raise ValueError("give either port (serial line), or interface and channel (CAN)")
        ask.rate_request(self.rate_hz)
        ask.filter_request(self.cutoff_hz or None, order=self.filter_order)
        if self.model:
            ask.scale_of(self.model, torque_divisor=self.torque_divisor)
        if self.port:
            ask.baud_request(self.baud)
            highest = ask.HIGHEST_RATE_HZ[self.baud]
            if self.rate_hz > highest:
                raise ValueError(f"rate_hz {self.rate_hz} is above {highest} for {self.baud} bit/s")
        else:
            RobotousCanDecoder(self.first_id, self.second_id)
        return self


def _line_of(options: RobotousOptions) -> RobotousLine:
    if options.port:
        return RobotousSerialLine(options.port, options.baud)
    return RobotousCanLine(
        CanBus(options.interface, options.channel, bitrate=options.bitrate),
        request_id=options.request_id,
        first_id=options.first_id,
        second_id=options.second_id,
        period_s=1.0 / options.rate_hz,
    )


class WrenchRobotous(WrenchDevice):
    """An RFT sensor."""

    options_class = RobotousOptions

    def __init__(self, options: RobotousOptions) -> None:
        self._line = _line_of(options)
        model = f"Robotous RFT on {self._line.name}"
        super().__init__("wrench_robotous", model, float(options.rate_hz), options)
        self._options = options
        self._tells_time = False
        self._silence_s = max(_SILENCE_S, 5.0 / options.rate_hz)
        self._scale = ask.RobotousScale(1.0, 1.0)
        self._arrivals = ArrivalTimes(1.0 / options.rate_hz)

    def zero(self) -> None:
        """See ``WrenchDevice``; what comes meanwhile is thrown away.

        The request has no answer, so the samples after it must show that it was taken.
        """
        before = self._mean()
        for _ in range(_ATTEMPTS):
            self._line.send(ask.bias_request())
            self._mean()  # some of these may have been on their way
            after = self._mean()
            pairs = zip(before, after, strict=True)
            if all(abs(now) <= max(_NEAR_ZERO, 0.5 * abs(then)) for then, now in pairs):
                return
        raise DeviceError(
            f"{self.info.model}: it took no zero: {tuple(map(round, after))} counts are left",
            remedy="leave the load unchanged while zero is taken",
        )

    def _connect(self) -> str:
        self._line.open()
        self._line.send(ask.stop_request())
        until = time.monotonic() + _DRAIN_S
        with contextlib.suppress(DeviceTimeout):
            while time.monotonic() < until:
                self._line.read(_QUIET_S)
        told = self._text(RobotousCommand.MODEL)
        serial = self._text(RobotousCommand.SERIAL)
        self._scale = self._scale_of(told)
        cutoff_hz = self._options.cutoff_hz or None
        self._set(ask.filter_request(cutoff_hz, order=self._options.filter_order))
        self._set(ask.rate_request(self._options.rate_hz))
        self._answer(ask.start_request(), RobotousCommand.START)
        self._arrivals.begin()
        return serial or self._line.name

    def _scale_of(self, told: str) -> ask.RobotousScale:
        model, divisor = self._options.model or told, self._options.torque_divisor
        try:
            scale = ask.scale_of(model, torque_divisor=divisor)
        except ValueError as error:
            raise DeviceError(
                f"{self.info.model}: {error}", remedy="set model or torque_divisor (its manual)"
            ) from error
        with contextlib.suppress(ValueError):
            if divisor is None and ask.scale_of(told) != scale:
                raise DeviceError(
                    f"{self.info.model}: it says that it is a {told}, not a {model}",
                    remedy="correct model, or set torque_divisor",
                )
        return scale

    def _close(self) -> None:
        with contextlib.suppress(DeviceError):
            self._line.send(ask.stop_request())
        self._line.close()

    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        samples = self._unless_silent(self._samples, timeout_s, self._silence_s)
        return self._readings(samples) if samples else []

    def _readings(self, samples: Sequence[RobotousData]) -> list[WrenchReading]:
        times_ns = self._arrivals.times_ns(len(samples), time.monotonic_ns())
        readings = []
        for arrival_ns, sample in zip(times_ns, samples, strict=True):
            for axis in ask.overloaded_axes(sample.overload):
                self._counts[f"status_overload_{axis.lower()}"] += 1
            wrench = self._scale.wrench(sample.counts)
            reading = self._reading(wrench, arrival_ns=arrival_ns, overload=sample.overload != 0)
            if reading is not None:
                readings.append(reading)
        return readings

    def _samples(self, timeout_s: float) -> list[RobotousData]:
        records = [ask.decode(payload) for payload in self._line.read(timeout_s)]
        samples = [
            r for r in records if isinstance(r, RobotousData) and r.command == RobotousCommand.START
        ]
        self._counts["other_answers"] += len(records) - len(samples)
        return samples

    def _mean(self) -> list[float]:
        """Mean counts of the next samples."""
        samples: list[RobotousData] = []
        until = time.monotonic() + self._silence_s + 2.0 * _ZERO_SAMPLES / self.info.rate_hz
        while len(samples) < _ZERO_SAMPLES:
            samples += self._samples(max(until - time.monotonic(), 0.0))
        self._arrivals.begin()
        if any(sample.overload for sample in samples):
            raise DeviceError(f"{self.info.model}: it is overloaded", remedy="take the load off")
        return [sum(axis) / len(samples) for axis in zip(*(s.counts for s in samples), strict=True)]

    def _text(self, command: RobotousCommand) -> str:
        record = self._answer(ask.get_request(command), command)
        return record.text if isinstance(record, ask.RobotousText) else ""

    def _set(self, request: bytes) -> None:
        record = self._answer(request, RobotousCommand(request[0]))
        if not (isinstance(record, ask.RobotousResult) and record.ok):
            why = ask.ERRORS.get(getattr(record, "error", 0), "no reason given")
            raise DeviceError(
                f"{self.info.model}: {_name(request)} was refused: {why}",
                remedy="choose another rate or filter, or raise the sensor's baud",
            )

    def _answer(self, request: bytes, command: RobotousCommand) -> RobotousRecord:
        """The first answer to a request, which is sent again if none comes.

        Raises:
            DeviceTimeout: None came.
        """
        patience_s = _ANSWER_S + 2.0 / self.info.rate_hz
        for attempt in range(_ATTEMPTS):
            if attempt:  # while it streams it hears nothing else
                self._line.send(ask.stop_request())
            self._line.send(request)
            until = time.monotonic() + patience_s
            with contextlib.suppress(DeviceTimeout):
                while (left_s := until - time.monotonic()) > 0.0:
                    for payload in self._line.read(left_s):
                        if payload[0] == command:
                            return ask.decode(payload)
        came = ", ".join(f"{count} {name}" for name, count in self._line.counters.items() if count)
        raise DeviceTimeout(
            f"{self.info.model}: {_name(request)} was not answered; came: {came or 'nothing'}",
            remedy="check power, wiring, terminators, and baud or CAN identifiers",
        )

    def _protocol_counters(self) -> Mapping[str, int]:
        return self._line.counters


def _name(request: bytes) -> str:
    return f"request {request[0]} ({RobotousCommand(request[0]).name.lower()})"
