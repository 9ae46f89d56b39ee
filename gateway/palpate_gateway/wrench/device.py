"""What all force/torque sensors share: a mount, a zero, the meaning of their status."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from pydantic import Field

from palpate.config import StrictConfig
from palpate.errors import DeviceLost, DeviceTimeout
from palpate.messages import Origin
from palpate_gateway.device import SERIAL_MAX, Device, DeviceIdentity, DeviceInfo
from palpate_gateway.readings import ClockObservation, Reading, WrenchReading
from palpate_gateway.wrench.mount import Mount, MountOptions

Sample = TypeVar("Sample")

_PROMPT_EACH_S = 0.1
"""How often a sample is read as it comes, though others wait for one another [s]."""


class WrenchOptions(StrictConfig):
    """Options of every force/torque driver.

    Attributes:
        mount: Where the sensor sits.
        serial: Serial number to publish; empty = the device's own, or its address.
        zero_at_start: Take the load at the first opening as zero; only if nothing touches the
            BioTac then. A sensor that was lost and comes back is not zeroed: it may be pressed.
        zero_max_sd_n: A force that varies more is not taken as zero on request [N].
        zero_max_sd_nm: A torque that varies more is not taken as zero on request [N m].
        gather_s: How long samples may wait for one another [s]: who wakes for each of 1000 a second
            spends more on waking than on them. 0 = none waits, e.g. where a robot is controlled by
            them. Their times are as good either way.
    """

    mount: MountOptions = MountOptions()
    serial: str = Field(default="", max_length=SERIAL_MAX, pattern=r"^[ -~]*$")
    zero_at_start: bool = False
    zero_max_sd_n: float = Field(default=0.5, gt=0.0)
    zero_max_sd_nm: float = Field(default=0.02, gt=0.0)
    gather_s: float = Field(default=8e-3, ge=0.0, le=0.05)


class WrenchDevice(Device):
    """A live force/torque sensor. Subclasses speak its protocol.

    Args:
        driver: Name in the driver table.
        model: One line for people.
        rate_hz: Nominal rate [Hz].
        options: Mount, serial, zero.
    """

    def __init__(self, driver: str, model: str, rate_hz: float, options: WrenchOptions) -> None:
        super().__init__(
            DeviceInfo(
                driver=driver,
                sensor_type=None,
                model=model,
                rate_hz=rate_hz,
                live=True,
                finite=False,
                origin=Origin.LIVE,
            )
        )
        self._mount = Mount(options.mount)
        self._counts: Counter[str] = Counter()
        self._serial = options.serial
        self.zero_limits = options
        """What varies more is not taken as zero."""
        self.zero_lost = False
        """Whether the zero it had may be gone: it was opened again and does not tell."""
        self._has_zero = False
        self._zero_at_start = options.zero_at_start
        self._gather_s = options.gather_s
        self._prompt_s = 0.0
        self._tick = 0
        self._silent_since: float | None = None
        self._tells_time = True
        """Whether its readings have the device's time; known at the latest when it is connected."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Events since it was opened last; names of the protocol's own and of status bits."""
        return dict(self._counts) | dict(self._protocol_counters())

    @abstractmethod
    def zero(self) -> None:
        """Take the present load as zero, in the device; belongs to the thread that reads.

        Raises:
            DeviceError: The device is not open, refuses, or cannot do it.
        """

    def take_zero(self) -> None:
        """``zero``, and remember that it has one."""
        self.zero()
        self._has_zero, self.zero_lost = True, False
        self._counts["zeros"] += 1

    def _keeps_zero(self) -> bool:
        """Whether the device, connected again, says that it still has its zero."""
        return False

    @abstractmethod
    def _connect(self) -> str:
        """Open ports, ask who it is, set it up, start the stream; its serial number or address."""

    @abstractmethod
    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        """Readings that came; may be none, e.g. half a frame."""

    @abstractmethod
    def _protocol_counters(self) -> Mapping[str, int]: ...

    def _open(self) -> DeviceIdentity:
        self._counts.clear()
        self._tick = 0
        self._silent_since = None
        try:
            told = self._connect()
            if self._zero_at_start:
                self.take_zero()
                self._zero_at_start = False
            elif self._has_zero and not self._keeps_zero():
                # No product at hand stores a zero; who was without power has lost it.
                self._has_zero, self.zero_lost = False, True
                self._counts["zero_lost"] += 1
        except BaseException:
            self._close()
            raise
        return DeviceIdentity(
            self._serial or told,
            slot_period_s=1.0 / self.info.rate_hz,
            tells_time=self._tells_time,
        )

    def _read(self, timeout_s: float) -> list[Reading]:
        until = time.monotonic() + timeout_s
        if self._gather_s and time.monotonic() >= self._prompt_s:
            # A sample that never waits tells its clock: what is read at even times would come
            # late by the same for minutes.
            self._prompt_s = time.monotonic() + _PROMPT_EACH_S
        elif self._gather_s:
            time.sleep(min(self._gather_s, timeout_s))
        while True:
            # Half a frame is not a reading, and [] would mean the end of the source.
            left_s = until - time.monotonic()
            readings = self._receive(max(left_s, 0.0))
            if readings:
                self._counts["samples"] += len(readings)
                return list(readings)
            if left_s <= 0.0:
                raise DeviceTimeout(
                    f"{self.info.model}: no whole reading within {timeout_s:g} s",
                    remedy="bytes come, but no frame: check baud, model and wiring",
                )

    def _unless_silent(
        self, take: Callable[[float], Sequence[Sample]], timeout_s: float, silence_s: float
    ) -> Sequence[Sample]:
        """Samples of a sensor that streams by itself, and says nothing when it restarts.

        Args:
            take: Takes what comes within a time [s]; may give none, e.g. half a frame.
            timeout_s: How long to wait [s].
            silence_s: Silence after which it is taken to have restarted [s].

        Raises:
            DeviceTimeout: None came yet.
            DeviceLost: None came for too long. Others on a bus may talk on, so that a timeout of
                the port alone would not tell.
        """
        since_s = self._silent_since = self._silent_since or time.monotonic()
        left_s = max(since_s + silence_s - time.monotonic(), 0.0)
        timeout: DeviceTimeout | None = None
        samples: Sequence[Sample] = ()
        try:
            samples = take(min(timeout_s, left_s))
        except DeviceTimeout as error:
            timeout = error
        if samples:
            self._silent_since = None
        elif time.monotonic() - since_s >= silence_s:
            raise DeviceLost(
                f"{self.info.model}: no sample came for {silence_s:g} s",
                remedy="check its power and cable; it is set up and started again by itself",
            ) from timeout
        elif timeout is not None:
            raise timeout
        return samples

    def _reading(
        self,
        wrench: Sequence[float],
        *,
        time_s: float | None = None,
        arrival_ns: int | None = None,
        tick: int | None = None,
        overload: bool = False,
    ) -> WrenchReading | None:
        """A reading on the BioTac; None, and counted, where the device tells no numbers.

        Args:
            wrench: Fx Fy Fz [N] Tx Ty Tz [N m] in the force/torque sensor's frame.
            time_s: The device's time [s]; None = it tells none, the host's time of arrival.
            arrival_ns: Host monotonic clock when it arrived [ns]; None = now.
            tick: The device's unwrapped counter; None = it has none, ours.
            overload: Its range is exceeded.
        """
        if not all(map(math.isfinite, wrench)):
            self._counts["not_finite"] += 1
            return None
        force, torque = self._mount.on_biotac(np.array(wrench, np.float64))
        self._tick = self._tick + 1 if tick is None else tick
        if overload:
            self._counts["overloads"] += 1
        if arrival_ns is None:
            arrival_ns = time.monotonic_ns()
        stamp_s = 1e-9 * arrival_ns if time_s is None else time_s
        return WrenchReading(
            tick=self._tick,
            time_s=stamp_s,
            force=force,
            torque=torque,
            serial=self.identity.serial if self.is_open else self._serial,
            overload=overload,
            observed=ClockObservation(stamp_s, arrival_ns),
        )
