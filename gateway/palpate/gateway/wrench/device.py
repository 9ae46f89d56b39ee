"""What all force/torque sensors share: a mount, a zero, the meaning of their status."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from palpate.gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate.gateway.readings import Reading, WrenchReading
from palpate.gateway.wrench.mount import Mount, MountOptions
from palpate.protos.config import StrictConfig
from palpate.protos.errors import DeviceTimeout
from palpate.protos.messages import Origin


class WrenchOptions(StrictConfig):
    """Options of every force/torque driver.

    Attributes:
        mount: Where the sensor sits.
        serial: Serial number to publish; empty = the device's own, or its address.
        zero_at_start: Take the load at the first opening as zero; only if nothing touches the
            BioTac then. A sensor that was lost and comes back is not zeroed: it may be pressed.
    """

    mount: MountOptions = MountOptions()
    serial: str = ""
    zero_at_start: bool = False


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
        self._zero_at_start = options.zero_at_start
        self._tick = 0

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
        try:
            told = self._connect()
            if self._zero_at_start:
                self.zero()
                self._zero_at_start = False
        except BaseException:
            self._close()
            raise
        return DeviceIdentity(self._serial or told, slot_period_s=1.0 / self.info.rate_hz)

    def _read(self, timeout_s: float) -> list[Reading]:
        until = time.monotonic() + timeout_s
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

    def _reading(
        self,
        wrench: Sequence[float],
        *,
        time_s: float | None = None,
        tick: int | None = None,
        overload: bool = False,
    ) -> WrenchReading | None:
        """A reading on the BioTac; None, and counted, where the device tells no numbers.

        Args:
            wrench: Fx Fy Fz [N] Tx Ty Tz [N m] in the force/torque sensor's frame.
            time_s: The device's time [s]; None = it tells none, the host's time of arrival.
            tick: The device's unwrapped counter; None = it has none, ours.
            overload: Its range is exceeded.
        """
        values = np.asarray(wrench, np.float64)
        if not np.isfinite(values).all():
            self._counts["not_finite"] += 1
            return None
        force, torque = self._mount.on_biotac(values)
        self._tick = self._tick + 1 if tick is None else tick
        if overload:
            self._counts["overloads"] += 1
        stamp_s = time.monotonic() if time_s is None else time_s
        return WrenchReading(
            tick=self._tick,
            time_s=stamp_s,
            force=force,
            torque=torque,
            serial=self.identity.serial if self.is_open else self._serial,
            overload=overload,
        )
