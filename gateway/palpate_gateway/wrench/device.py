"""The base of all force/torque sensors: where one is mounted, its zero, its readings.

A sensor under the BioTac measures the load on the BioTac; one that carries the indenter measures
the reaction. In both cases the frames that leave the gateway hold the wrench *on the BioTac*, in
the sensor frame, about the origin of the sensor frame (docs/conventions.md).
"""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from palpate.config import StrictConfig
from palpate.errors import DeviceLost, DeviceTimeout
from palpate.messages import FloatArray, Origin
from palpate.rigid import is_rotation, quaternion_length, rotation_matrices
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo, SerialOption
from palpate_gateway.readings import ClockObservation, Reading, WrenchReading

Floats = npt.NDArray[np.float64]
Sample = TypeVar("Sample")

_PROMPT_EACH_S = 0.1
"""Time between two samples that are read without gathering others [s]."""


_GARBAGE = 1e9
"""No sensor measures as much [N, N m]; with any arm it is still a number in float32."""


def is_measured(wrench: Sequence[float]) -> bool:
    """Whether a sensor can have measured these: numbers, and no garbage like 1e39."""
    # False also of NaN.
    return all(-_GARBAGE < value < _GARBAGE for value in wrench)


_ARM_M = 1.0
"""No finger is further from the sensor that measures its load [m]: a larger origin is in mm."""


class MountOptions(StrictConfig):
    """How a force/torque sensor is mounted.

    Attributes:
        carries: What is fixed to its measuring side; ``indenter`` reverses the sign of the wrench.
        orientation_wxyz: Unit quaternion of the force/torque sensor's frame in the sensor frame.
        origin_m: Origin of the force/torque sensor's frame in the sensor frame [m].
    """

    carries: Literal["biotac", "indenter"] = "biotac"
    orientation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _is_rotation(self) -> MountOptions:
        if not is_rotation(self.orientation_wxyz):
            raise ValueError(
                f"orientation_wxyz {self.orientation_wxyz} has length "
                f"{quaternion_length(self.orientation_wxyz):.4g}, not 1: "
                "give a unit quaternion w x y z"
            )
        if not all(math.isfinite(part) for part in self.origin_m):
            raise ValueError(f"origin_m {self.origin_m} is not finite")
        if math.hypot(*self.origin_m) >= _ARM_M:
            raise ValueError(
                f"origin_m {self.origin_m} is {math.hypot(*self.origin_m):g} m from the finger: "
                "give metres, not mm"
            )
        return self


class Mount:
    """The transformation that `MountOptions` describe."""

    def __init__(self, options: MountOptions) -> None:
        quaternion = np.array(options.orientation_wxyz)
        rotation = rotation_matrices(quaternion / np.linalg.norm(options.orientation_wxyz))
        x, y, z = options.origin_m
        # The matrix of the cross product with ``origin_m``: torque gets the force times its arm.
        arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        sign = 1.0 if options.carries == "biotac" else -1.0
        zero = np.zeros((3, 3))
        # One matrix product per sample: some sensors send 7000 samples per second.
        self._matrix = sign * np.block([[rotation, zero], [arm @ rotation, rotation]])
        self._plain = bool((self._matrix == np.eye(6)).all())

    def on_biotac(self, wrench: Floats) -> tuple[FloatArray, FloatArray]:
        """Wrench on the BioTac in the sensor frame.

        Args:
            wrench: As measured: force [N] and torque about the force/torque sensor's own origin
                [N m], shape (6,).

        Returns:
            Force [N] and torque about the sensor frame's origin [N m], float32, shape (3,).
        """
        turned = (wrench if self._plain else self._matrix @ wrench).astype(np.float32)
        return turned[:3], turned[3:]


class WrenchOptions(StrictConfig):
    """Options of every force/torque driver.

    Attributes:
        mount: How the sensor is mounted.
        serial: Serial number to publish; empty = the device's own, or its address.
        zero_at_start: Take the load at the first opening as zero; choose it only if nothing
            touches the BioTac then. A sensor that was lost and comes back is not zeroed, because it
            may be loaded; nor is one whose gateway was killed and started again, or follows
            another gateway.
        zero_max_sd_n: Standard deviation of a force above which no zero is taken on request [N].
        zero_max_sd_nm: The same of a torque [N m].
        gather_s: How long samples may wait for one another [s]: to wake for each of 1000 samples
            per second costs more than to process them. 0 = no sample waits, e.g. when they control
            a robot. Their time stamps are equally good.
    """

    mount: MountOptions = MountOptions()
    serial: SerialOption = ""
    zero_at_start: bool = False
    zero_max_sd_n: float = Field(default=0.5, gt=0.0)
    zero_max_sd_nm: float = Field(default=0.02, gt=0.0)
    gather_s: float = Field(default=8e-3, ge=0.0, le=0.05)


class WrenchDevice(Device):
    """A live force/torque sensor. Subclasses implement its protocol."""

    def __init__(self, driver: str, model: str, rate_hz: float, options: WrenchOptions) -> None:
        super().__init__(
            DeviceInfo(driver, None, model, rate_hz, live=True, finite=False, origin=Origin.LIVE)
        )
        self._mount = Mount(options.mount)
        self._counts: Counter[str] = Counter()
        self._serial = options.serial
        self.zero_limits = options
        """Limits of the standard deviation for a zero on request."""
        self.zero_lost = False
        """Whether its zero may be lost: it was opened again and does not report a zero, or it
        refused a new one and has given up the old one."""
        self._has_zero = False
        self._zero_at_start = options.zero_at_start
        self._keep_note: Callable[[bytes], None] = lambda note: None
        self._gather_s = options.gather_s
        self._prompt_s = 0.0
        self._tick = 0
        self._silent_since: float | None = None
        self._has_clock = True
        """Whether its readings have the device's time; final once it is connected."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Events since the last opening; those of the protocol and of status bits, too."""
        return dict(self._counts) | dict(self._protocol_counters())

    @abstractmethod
    def zero(self) -> None:
        """Take the present load as zero, in the device; only for the thread that reads.

        Raises:
            DeviceError: The device is not open, refuses, or cannot do it.
        """

    def take_zero(self) -> None:
        """Take a zero with ``zero``, and count it."""
        self.zero()
        self._has_zero, self.zero_lost = True, False
        self._counts["zeros"] += 1
        self._keep_note(self._zero_note())

    def _lose_zero(self) -> None:
        """The zero that it has taken, if any, may be gone."""
        if self._has_zero:
            self._has_zero, self.zero_lost = False, True
            self._counts["zero_lost"] += 1

    def keep_zero(self, keep: Callable[[bytes], None], note: bytes | None) -> None:
        """Note each zero for a gateway that is started again; call it before the first opening.

        Args:
            keep: Keeps the note of a zero.
            note: That of the gateway before, whose zero counts as taken; None = it took none.
        """
        self._keep_note = keep
        if note is not None:
            self._has_zero, self._zero_at_start = True, False
            self._resume_zero(note)

    def expect_load(self) -> None:
        """A zero at the start would come too late: another gateway took it, and may be loaded."""
        if self._zero_at_start:
            self._has_zero, self._zero_at_start = True, False

    def _zero_note(self) -> bytes:
        """What ``_resume_zero`` needs of a zero that is not in the device."""
        return b""

    def _resume_zero(self, note: bytes) -> None:
        """Go on with a zero that another process has taken; what its ``_zero_note`` was."""

    def _keeps_zero(self) -> bool:
        """Whether the device reports, when it is connected again, that it still has its zero."""
        return False

    @abstractmethod
    def _connect(self) -> str:
        """Open ports, set up the sensor, start the stream; its serial number or its address."""

    @abstractmethod
    def _receive(self, timeout_s: float) -> Sequence[WrenchReading]:
        """Readings that came; may be none, e.g. from half a frame."""

    @abstractmethod
    def _protocol_counters(self) -> Mapping[str, int]: ...

    def _open(self) -> DeviceIdentity:
        self._counts.clear()
        self._tick = 0
        self._silent_since = None
        try:
            serial = self._connect()
            if self._zero_at_start:
                self.take_zero()
                self._zero_at_start = False
            elif not self._keeps_zero():
                # No known product stores its zero: a sensor that was without power has lost it.
                self._lose_zero()
        except BaseException:
            self._close()
            raise
        return DeviceIdentity(
            self._serial or serial,
            slot_period_s=1.0 / self.info.rate_hz,
            has_clock=self._has_clock,
        )

    def _read(self, timeout_s: float) -> list[Reading]:
        until, came = time.monotonic() + timeout_s, False
        if self._gather_s and time.monotonic() >= self._prompt_s:
            # The map of the device's clock needs samples that were read as soon as they came: if
            # all were read at regular times, their delay would hide in the clock for minutes.
            self._prompt_s = time.monotonic() + _PROMPT_EACH_S
        elif self._gather_s:
            time.sleep(min(self._gather_s, timeout_s))
        while True:
            # Half a frame is not a reading, and an empty list would mean the end of the source.
            left_s = until - time.monotonic()
            try:
                readings = self._receive(max(left_s, 0.0))
            except DeviceTimeout:
                if not came:
                    raise
                readings, left_s = [], 0.0
            if readings:
                self._counts["samples"] += len(readings)
                return list(readings)
            if left_s <= 0.0:
                raise DeviceTimeout(
                    f"{self.info.model}: something came, but no valid reading within "
                    f"{timeout_s:.3g} s",
                    remedy="its counters say what came; check baud, model and wiring",
                )
            came = True

    def _unless_silent(
        self, take: Callable[[float], Sequence[Sample]], timeout_s: float, silence_s: float
    ) -> Sequence[Sample]:
        """Samples of a sensor that streams by itself and does not report its restarts.

        A silence of ``silence_s`` is taken as a restart.

        Raises:
            DeviceTimeout: None came yet.
            DeviceLost: None came for too long. A timeout of the port would not show it on a bus
                where other devices continue.
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
        """A reading on the BioTac; None, and counted, if a value is not finite or garbage.

        Args:
            wrench: Fx Fy Fz [N] Tx Ty Tz [N m] in the force/torque sensor's frame.
            time_s: The device's time [s]; None = use the host's time of arrival.
            arrival_ns: Host's monotonic clock at arrival [ns]; None = now.
            tick: The device's unwrapped counter; None = use a count of our own.
            overload: Whether the range is exceeded.
        """
        if not is_measured(wrench):
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
