"""What comes from a device: how much of each stream, how fast, and the last of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from palpate.errors import DeviceTimeout
from palpate_gateway.cli.reading_text import stream_of
from palpate_gateway.device import Device
from palpate_gateway.readings import Reading

_READ_S = 0.2


@dataclass(slots=True)
class Stream:
    """One kind of reading.

    Attributes:
        first: The first that came.
        last: The last.
        readings: How many came.
        heard_s: When the last came, by the host's monotonic clock [s].
        told_hz: Its rate in the time before the last ``restart`` [Hz]; None = not known.
    """

    first: Reading
    last: Reading
    readings: int
    heard_s: float
    _since_s: float
    _counted: int = 0
    told_hz: float | None = None

    @property
    def rate_hz(self) -> float | None:
        """Readings each second since ``restart``, from arrival to arrival; None = not known."""
        passed_s = self.heard_s - self._since_s
        # Those that came first came together after a wait of unknown length.
        return self._counted / passed_s if self._counted and passed_s > 0.0 else None

    def add(self, reading: Reading, now_s: float) -> None:
        """Count one more."""
        self.last = reading
        self.readings += 1
        if now_s > self._since_s:
            self._counted += 1
        self.heard_s = now_s

    def restart(self) -> None:
        """Measure the rate anew, from the last that came."""
        self.told_hz = self.rate_hz
        self._since_s, self._counted = self.heard_s, 0


class Streams:
    """All streams of a device."""

    def __init__(self) -> None:
        self.by_name: dict[str, Stream] = {}

    def add(self, readings: Sequence[Reading], now_s: float) -> None:
        """Count readings that came together."""
        for reading in readings:
            stream = self.by_name.get(stream_of(reading))
            if stream is None:
                new = Stream(reading, reading, 1, now_s, now_s)
                self.by_name[stream_of(reading)] = new
            else:
                stream.add(reading, now_s)

    def restart(self) -> None:
        """Measure all rates anew."""
        for stream in self.by_name.values():
            stream.restart()


def measure(device: Device, seconds: float) -> Streams:
    """Read an open device for a time, or until it ends.

    Raises:
        DeviceError: It is lost, or nothing came.
    """
    streams = Streams()
    until = time.monotonic() + seconds
    silence: DeviceTimeout | None = None
    while (left_s := until - time.monotonic()) > 0.0:
        try:
            readings = device.read(min(left_s, _READ_S))
        except DeviceTimeout as error:
            silence = error
            continue
        if not readings:
            break
        streams.add(readings, time.monotonic())
    if not streams.by_name and silence is not None:
        raise DeviceTimeout(
            f"{device.info.model}: opened, but no reading came within {seconds:g} s",
            remedy=silence.remedy,
        ) from silence
    return streams
