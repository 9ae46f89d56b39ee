"""Drivers of ROS in software, which publish as rmw_zenoh does, without ROS.

Written from the page (hardware reference 7) and the public source of rmw_zenoh: the bytes are made
here, field by field, and no decoder is imported. CDR aligns each number to its size, counted from
the end of the four bytes of encapsulation; strings have their length and an end of 0.

Choices where the page leaves something open: the serial numbers are ``BTEMU1`` and so on, the
offsets those of a round that begins with E1, and the header's time is that of publishing.
"""

from __future__ import annotations

import secrets
import struct
import time
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from palpate.bus import ForeignPublisher, Session
from palpate_gateway.emulators import FAULTS
from palpate_gateway.emulators.biotac_slots import CHANNELS, CountSource, counts_at, idle_counts
from palpate_gateway.emulators.emulator import (
    SampleTicker,
    WrenchSource,
    set_lead,
    slow_press,
)
from palpate_gateway.emulators.routed import RoutedEmulator

_SLOT_HZ = 4400.0
_COUNTS_MAX = 4095
_BACK_NS = 5_000_000_000

_PLACES = np.array([*range(CHANNELS - 1), *[CHANNELS - 1] * 22])
"""Channels of a frame: E1 to E19, PDC, TAC, TDC, and PAC 22 times."""

_BEFORE_END_S = (44 - np.array([*range(0, 44, 2), *range(1, 44, 2)])) / _SLOT_HZ
"""When they are sampled, before the end of their frame [s]: PAC in every other slot."""

BIOTAC_ALL_KEY = (
    "sr_robot_msgs::msg::dds_::BiotacAll_/"
    "RIHS01_d948cd8b08fb197cb6fb9df355197583847d419bedbb08b80b2079200ed6325c"
)
BIOTAC_HAND_KEY = (
    "biotac_sensors::msg::dds_::BioTacHand_/"
    "RIHS01_7cd74f8bed9328e0acbc319a66e2f772a31fbc5f7d7ddabf5b2ba4acff274192"
)
WRENCH_KEY = (
    "geometry_msgs::msg::dds_::WrenchStamped_/"
    "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77"
)


class CdrWriter:
    """Little-endian CDR."""

    def __init__(self) -> None:
        self._body = bytearray()

    def numbers(self, code: str, *values: float) -> None:
        """Numbers of one ``struct`` code, each aligned to its size."""
        size = struct.calcsize(f"<{code}")
        self._body += bytes(-len(self._body) % size)
        self._body += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, text: str) -> None:
        """A string."""
        data = text.encode() + b"\0"
        self.numbers("I", len(data))
        self._body += data

    def time(self, time_ns: int) -> None:
        """A time since the epoch."""
        sec, nanosec = divmod(time_ns, 1_000_000_000)
        self.numbers("i", sec)
        self.numbers("I", nanosec)

    def message(self) -> bytes:
        """The message with its encapsulation."""
        return b"\x00\x01\x00\x00" + bytes(self._body)


class RosEmulator(RoutedEmulator):
    """A node of ROS with one publisher; without the address of a router it runs its own.

    Faults:

    * ``lost``: messages are numbered, but missing; ``repeated``: each comes twice;
    * ``late``: every other message comes after the next one;
    * ``cut``: messages lack their last bytes;
    * ``stuck``: the values from its begin are repeated, at new times;
    * ``wrong_time``: the times of the headers are five seconds in the past;
    * ``silence``: the node hangs; ``unplug``: it has left the bus;
    * ``restart``: the node ends; when the fault ends, it starts again under another id;
    * ``clock_drift``: its loop and the times of its headers run at another speed.
    """

    _publisher: ForeignPublisher | None
    type_key: ClassVar[str]
    """Type and type hash in its key."""

    def __init__(
        self,
        topic: str,
        rate_hz: float,
        *,
        connect: str = "",
        tls: Path | None = None,
        port: int = 0,
        domain: int = 0,
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(rate_hz, connect, port, tls)
        self.topic, self.domain = topic, domain
        self._drift = drift_ppm * 1e-6
        self._held: tuple[bytes, bytes] | None = None
        self._begin()

    def _begin(self) -> None:
        """Start the node."""
        self._gid, self._sequence = secrets.token_bytes(16), 0

    @abstractmethod
    def _message(self, t: float, time_ns: int) -> bytes:
        """The message of what is measured at a time of the emulator's own [s]."""

    def _join(self) -> None:
        link = self._link()
        if link.tls is not None:
            link = link.model_copy(update={"tls": link.tls.model_copy(update={"roles": False})})
        link = link.model_copy(update={"direct": False})
        self._session = session = Session.open(link)
        name = self.topic.strip("/")
        head = f"@ros2_lv/{self.domain}/{session.zid}/0"
        node = "%/%/emulated_driver"
        session.foreign_token(f"{head}/0/NN/{node}")
        mangled = self.topic.replace("/", "%")
        session.foreign_token(f"{head}/1/MP/{node}/{mangled}/{self.type_key}/::,10:,:,:,,")
        self._publisher = session.foreign_publisher(f"{self.domain}/{name}/{self.type_key}")

    def _serve(self) -> None:
        ticker = SampleTicker(self.rate_hz, self._stop)
        began_s, began_ns = time.monotonic(), time.time_ns()
        self._set_lead(began_s)
        while not self._stop.is_set():
            ticker.fast = self._drift if self.faulty("clock_drift") else 0.0
            due_s = ticker.wait()
            if not self._gone():
                self._step(due_s - began_s, began_ns + round(1e9 * ticker.clock_s))

    def _set_lead(self, began_s: float) -> None:
        """What is measured follows the host's clock."""

    def _gone(self) -> bool:
        """Whether the node does not run, hangs, or is not on the bus."""
        if super()._gone():
            return True
        if self._away:
            self._away = False
            self._begin()
        return self.faulty("silence")

    def _step(self, t: float, time_ns: int) -> None:
        self._sequence += 1
        if self.faulty("lost"):
            return
        if self.faulty("wrong_time"):
            time_ns -= _BACK_NS
        payload = self._message(self.held(t), time_ns)
        if self.faulty("cut"):
            payload = payload[:-8]
        else:
            self.sent += 1
        attachment = struct.pack("<qqB", self._sequence, time.time_ns(), 16) + self._gid
        if self._held is None and self.faulty("late"):
            self._held = (payload, attachment)
            return
        self._tell(payload, attachment)
        if self._held is not None:
            self._tell(*self._held)
            self._held = None
        if self.faulty("repeated"):
            self._tell(payload, attachment)

    def _tell(self, payload: bytes, attachment: bytes) -> None:
        if self._publisher is not None:
            self._publisher.put(payload, attachment)


class RosHandEmulator(RosEmulator):
    """A hand of BioTacs, as a ``BiotacAll`` of Shadow or as a ``BioTacHand``.

    Beside the faults of every node: ``absent``: all fingers are zero, or gone from the message;
    ``saturated``: all channels are 4095.

    Args:
        counts: What the fingers measure.
        whole_frames: A ``BioTacHand``; else a ``BiotacAll``.
        fingers: How many are connected, the first ones.
    """

    faults: ClassVar = FAULTS["ros-hand"]

    def __init__(
        self,
        counts: CountSource = idle_counts,
        *,
        whole_frames: bool = False,
        fingers: int = 1,
        topic: str = "/hand/tactile",
        rate_hz: float = 100.0,
        connect: str = "",
        tls: Path | None = None,
        port: int = 0,
        domain: int = 0,
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(
            topic, rate_hz, connect=connect, tls=tls, port=port, domain=domain, drift_ppm=drift_ppm
        )
        self._counts, self._fingers, self.whole_frames = counts, fingers, whole_frames

    @property
    def type_key(self) -> str:  # type: ignore[override]
        """Type and type hash in its key."""
        return BIOTAC_HAND_KEY if self.whole_frames else BIOTAC_ALL_KEY

    def _set_lead(self, began_s: float) -> None:
        set_lead(self._counts, began_s)

    def _of(self, t: float, finger: int) -> tuple[list[int], list[int]]:
        """E1 to E19, PDC, TAC, TDC; and PAC samples of the frame that ends at ``t`` [s]."""
        times_s = np.full(44, t)
        if self._held_s is None:
            # Only a BioTacHand says when each of the others was sampled.
            first = 0 if self.whole_frames else 22
            times_s[first:] -= _BEFORE_END_S[first:]
        counts = counts_at(self._counts, times_s, _PLACES, finger).tolist()
        return counts[:22], counts[22:]

    def _message(self, t: float, time_ns: int) -> bytes:
        fingers = 0 if self.faulty("absent") else self._fingers
        cdr = CdrWriter()
        cdr.time(time_ns)
        cdr.text("hand")
        measured = [self._of(t, finger) for finger in range(fingers)]
        if self.faulty("saturated"):
            measured = [([_COUNTS_MAX] * 22, [_COUNTS_MAX] * 22)] * fingers
        if self.whole_frames:
            self._write_hand(cdr, time_ns, measured)
        else:
            self._write_all(cdr, measured)
        return cdr.message()

    @staticmethod
    def _write_all(cdr: CdrWriter, measured: Sequence[tuple[list[int], list[int]]]) -> None:
        for finger in range(5):
            slow, pac = measured[finger] if finger < len(measured) else ([0] * 22, [0] * 22)
            *electrodes, pdc, tac, tdc = slow
            cdr.numbers("h", pac[-2], pac[-1], pdc, tac, tdc)
            cdr.numbers("I", len(electrodes))
            cdr.numbers("h", *electrodes)

    @staticmethod
    def _write_hand(
        cdr: CdrWriter, time_ns: int, measured: Sequence[tuple[list[int], list[int]]]
    ) -> None:
        cdr.text("left")
        cdr.numbers("I", len(measured))
        for finger, (slow, pac) in enumerate(measured, 1):
            *electrodes, pdc, tac, tdc = slow
            cdr.text(f"BTEMU{finger}")
            cdr.numbers("H", finger, tdc, tac, pdc, *pac, *electrodes)
        slot_ns = 1e9 / _SLOT_HZ
        cdr.time(time_ns - round(44 * slot_ns))
        cdr.time(time_ns)
        slow_at = [round(2 * k * slot_ns) for k in range(22)]
        cdr.numbers("I", slow_at[21], slow_at[20], slow_at[19])
        cdr.numbers("I", *(round((2 * k + 1) * slot_ns) for k in range(22)))
        cdr.numbers("I", *slow_at[:19])


class RosWrenchEmulator(RosEmulator):
    """A force/torque sensor as a ``WrenchStamped``; ``nan``: a number is not a number."""

    faults: ClassVar = FAULTS["ros-wrench"]
    type_key = WRENCH_KEY

    def __init__(
        self,
        source: WrenchSource = slow_press,
        *,
        topic: str = "/ft/wrench",
        rate_hz: float = 500.0,
        connect: str = "",
        tls: Path | None = None,
        port: int = 0,
        domain: int = 0,
        drift_ppm: float = 200.0,
    ) -> None:
        super().__init__(
            topic, rate_hz, connect=connect, tls=tls, port=port, domain=domain, drift_ppm=drift_ppm
        )
        self._source = source

    def _set_lead(self, began_s: float) -> None:
        set_lead(self._source, began_s)

    def _message(self, t: float, time_ns: int) -> bytes:
        cdr = CdrWriter()
        cdr.time(time_ns)
        cdr.text("ft_sensor")
        wrench = list(self._source(t))
        if self.faulty("nan"):
            wrench[2] = float("nan")
        cdr.numbers("d", *wrench)
        return cdr.message()
