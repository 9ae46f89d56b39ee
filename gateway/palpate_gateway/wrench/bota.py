"""Bota SensONE and Rokubi over a serial line (hardware reference 3.6).

The sensor streams by itself once it has booted; the driver stops it only for settings. Its samples
have no numbers: lost samples and restarts are found by its clock.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import Field, model_validator

from palpate.errors import DeviceError, DeviceLost, DeviceTimeout
from palpate_gateway.clock.sample_times import SampleClock, SampleVerdict
from palpate_gateway.ports.port import settle
from palpate_gateway.ports.serial_port import SerialPort
from palpate_gateway.protocols import bota as wire
from palpate_gateway.protocols.bota import BotaDecoder, BotaFrame
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.device import WrenchDevice, WrenchOptions

_ANSWER_S = 1.0
_CALLS, _CALL_S = 3, 0.2
"""Requests at one speed before the next one is tried, and the wait after each [s]."""

_QUIET_S = 0.03
_SILENCE_S = 0.3
"""Silence that is taken as a restart [s]."""

_BITS_PER_BYTE = 10
_WRAP_US = 1 << 32
_NO_WRENCH = wire.INVALID | 1 << wire.STATUS_NAMES.index("raw")
"""Bits of the status of a frame without a wrench."""

_ZERO_S = 0.2
_NO_OFFSETS = (0.0,) * 6


class BotaOptions(WrenchOptions):
    """Options of the ``wrench_bota`` driver.

    Attributes:
        port: Serial line, e.g. ``/dev/serial/by-id/usb-...``.
        baud: Speed that is set in the sensor [bit/s]; 0 = try 460800, then 230400.
        rate_hz: Samples each second: 100, 200, 250, 400, 800 or 1000 (nominal).
        chop: The sensor's chopping.
        fast: Its fast settling.
        fir: Its FIR filter.
        temperature_compensation: The sensor corrects for temperature.
        boot_s: Longest time that it takes to boot [s].
    """

    port: str = Field(min_length=1)
    baud: int = 0
    rate_hz: float = Field(default=400.0, gt=0.0, allow_inf_nan=False)
    chop: bool = False
    fast: bool = False
    fir: bool = False
    temperature_compensation: bool = False
    boot_s: float = Field(default=4.0, ge=0.0, le=60.0)

    @model_validator(mode="after")
    def _fits(self) -> BotaOptions:
        true_hz = 1.0 / wire.period_s(sinc_of(self.rate_hz))
        if abs(true_hz / self.rate_hz - 1.0) > 0.02:
            known = ", ".join(f"{1.0 / wire.period_s(sinc):.0f}" for sinc in wire.SINC_LENGTHS)
            raise ValueError(f"rate_hz {self.rate_hz:g} is none of {known}")
        if self.baud:
            wire.communication_request(baud=self.baud)
            if (highest_hz := _highest_hz(self.baud)) < true_hz:
                raise ValueError(
                    f"rate_hz {self.rate_hz:g} is above {highest_hz:.0f} for {self.baud} bit/s"
                )
        return self


def sinc_of(rate_hz: float) -> int:
    """Filter length with the nearest rate."""
    return min(wire.SINC_LENGTHS, key=lambda sinc: abs(math.log(rate_hz * wire.period_s(sinc))))


def _highest_hz(baud: int) -> float:
    return baud / (_BITS_PER_BYTE * wire.FRAME_BYTES)


class WrenchBota(WrenchDevice):
    """A SensONE or Rokubi."""

    options_class = BotaOptions
    needs = ("serial",)

    def __init__(self, options: BotaOptions) -> None:
        self._sinc = sinc_of(options.rate_hz)
        period_s = wire.period_s(self._sinc)
        super().__init__("wrench_bota", f"Bota on {options.port}", 1.0 / period_s, options)
        self._options = options
        self._period_us = 1e6 * period_s
        self.address = options.port
        self._baud = options.baud  # 0 while it is not known
        self._port = SerialPort(options.port, options.baud or wire.BAUDS_TO_PROBE[0])
        self._begin()

    def _begin(self) -> None:
        """Reset the state of an earlier connection."""
        self._decoder = BotaDecoder()
        self._boot, self._booted = wire.BotaTextWait(wire.BOOT_TEXT), False
        self._early = b""
        self._clock = SampleClock(self._period_us, _WRAP_US)

    def zero(self) -> None:
        """See ``WrenchDevice``; the stream pauses for it.

        The sensor adds offsets to its measurement. It cannot be asked for its present offsets, so
        they are cleared first. The samples afterwards show whether the sign was right.
        """
        try:
            self._zero_anew()
        except DeviceError:
            self._lose_zero()
            raise

    def _zero_anew(self) -> None:
        self._set_offsets(_NO_OFFSETS)
        before, noise = self._mean()
        self._set_offsets(tuple(-float(value) for value in before))
        after, _ = self._mean()
        left = np.abs(after) > 0.5 * np.abs(before) + 5.0 * noise + 1e-3
        if left.any():
            self._set_offsets(_NO_OFFSETS)
            raise DeviceError(
                f"{self.info.model}: after taking zero it still reads {np.round(after, 4)}",
                remedy="leave the load unchanged while zero is taken",
            )

    def _connect(self) -> str:
        self._begin()
        baud = self._find()
        if _highest_hz(baud) < self.info.rate_hz:
            raise DeviceError(
                f"{self.info.model}: {baud} bit/s carry {_highest_hz(baud):.0f} samples/s, "
                f"not {self.info.rate_hz:.0f}",
                remedy="lower rate_hz, or set the sensor to 460800 bit/s",
            )
        options = self._options
        self._ask(
            wire.communication_request(
                baud=baud, temperature_compensation=options.temperature_compensation
            )
        )
        self._ask(
            wire.filter_request(self._sinc, chop=options.chop, fast=options.fast, fir=options.fir)
        )
        self._run()
        return options.port

    def _find(self) -> int:
        """Open the port at the sensor's speed and enter its configuration mode; the speed."""
        bauds = (self._options.baud,) if self._options.baud else wire.BAUDS_TO_PROBE
        began_s = time.monotonic()
        until = began_s + self._options.boot_s
        while True:
            # A sensor that comes back has the same speed as before; to try others takes time.
            known = self._baud if time.monotonic() - began_s < self._options.boot_s / 2 else 0
            for baud in (known,) if known else bauds:
                self._port.close()
                self._port = SerialPort(self._options.port, baud)
                self._port.open()
                for _ in range(_CALLS):
                    with contextlib.suppress(DeviceTimeout):
                        self._configure(_CALL_S)
                        self._baud = baud
                        return baud
            if time.monotonic() >= until:
                raise DeviceTimeout(
                    f"{self.info.model}: command 'C' was not answered at "
                    f"{' or '.join(map(str, bauds))} bit/s",
                    remedy="check its power, the cable (RS-422: A and B) and baud",
                )

    def _configure(self, within_s: float = _ANSWER_S) -> None:
        self._ask(wire.CONFIG_REQUEST, within_s)
        # Discard answers to earlier requests and the rest of the stream.
        settle(self._port, _QUIET_S, _ANSWER_S)

    def _run(self) -> None:
        self._early = self._ask(wire.RUN_REQUEST)
        self._decoder.reset()
        self._boot, self._booted = wire.BotaTextWait(wire.BOOT_TEXT), False
        self._clock.pause()
        self._silent_since = None

    def _close(self) -> None:
        # The stream is left running, as after power-up.
        self._port.close()

    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        frames = self._unless_silent(self._frames, timeout_s, _SILENCE_S)
        return self._before_error(self._take(frame) for frame in frames)

    def _frames(self, timeout_s: float) -> list[BotaFrame]:
        frames: list[BotaFrame] = []
        if not self._booted:
            data, self._early = self._early, b""
            data = data or self._port.read(timeout_s)
            after = self._boot.feed(data)
            self._booted = after is not None
            # What came before the text was measured before the restart.
            frames = self._decoder.feed(data[: len(data) - len(after or b"")])
        if self._booted and not frames:
            raise self._restarted("it wrote its boot text")
        return frames

    def _take(self, frame: BotaFrame) -> WrenchReading | None:
        """The reading of a frame; None if the frame is not new or not valid."""
        verdict = self._clock.take(frame.device_time_us, time.monotonic())
        if verdict is SampleVerdict.RESTARTED:
            raise self._restarted("its clock started again")
        if verdict is not SampleVerdict.NEW:
            return None
        if status := frame.status & ~wire.OVERRANGE:
            for name in wire.status_names(status):
                self._counts["status_" + name.replace(" ", "_")] += 1
        if frame.status & _NO_WRENCH:
            self._counts["invalid_samples"] += 1
            return None
        return self._reading(
            frame.wrench,
            time_s=self._clock.time_s,
            tick=self._clock.tick,
            overload=bool(frame.status & wire.OVERRANGE),
        )

    def _restarted(self, how: str) -> DeviceLost:
        self._counts["restarts"] += 1
        return DeviceLost(
            f"{self.info.model}: it has restarted: {how}",
            remedy="check its power; it is set up and started again automatically",
        )

    def _mean(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation of the next samples."""
        count = max(8, round(_ZERO_S * self.info.rate_hz))
        frames: list[BotaFrame] = []
        until = time.monotonic() + 2.0 + count / self.info.rate_hz
        while len(frames) < count:
            frames += self._frames(max(until - time.monotonic(), 0.0))
        values = np.array([frame.wrench for frame in frames], np.float64)
        unfit = any(frame.status & (_NO_WRENCH | wire.OVERRANGE) for frame in frames)
        if unfit or not np.isfinite(values).all():
            raise DeviceError(
                f"{self.info.model}: its samples are not valid now",
                remedy="see its status counters",
            )
        return values.mean(axis=0), values.std(axis=0)

    def _set_offsets(self, offsets: Sequence[float]) -> None:
        self._configure()
        self._ask(wire.offsets_request(offsets))
        self._run()

    def _ask(self, request: bytes, within_s: float = _ANSWER_S) -> bytes:
        """Send a request and wait for its reply; the bytes that came after the reply.

        Raises:
            DeviceTimeout: No reply came.
            DeviceError: The sensor refuses.
        """
        self._port.write(request)
        what = f"{self.info.model}: command {request.decode('ascii')!r}"
        wait = wire.BotaTextWait(wire.expected_reply(request))
        until = time.monotonic() + within_s
        while (left_s := until - time.monotonic()) > 0.0:
            with contextlib.suppress(DeviceTimeout):
                after = wait.feed(self._port.read(left_s))
                if after is not None:
                    return after
                ack = wire.find_ack(wait.before)
                if ack is not None and ack.command == chr(request[0]) and ack.code:
                    raise DeviceError(
                        f"{what} was refused (code {ack.code})",
                        remedy="choose another rate or filter that this model has",
                    )
        raise DeviceTimeout(
            f"{what} was not answered; it sent: {wait.before[-40:]!r}",
            remedy="check cable and baud",
        )

    def _protocol_counters(self) -> Mapping[str, int]:
        return {**self._decoder.counters, **self._clock.counters}
