"""The tare or zero in force of a sensor, for a gateway that is started again after it was killed.

A sensor that is pressed at that moment could not be tared, and a force/torque sensor would take the
load as its zero. The files lie beside the gateway's heartbeat, in memory: they are gone with the
station's supervisor, so that a station that starts tares anew.
"""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path
from typing import ClassVar, Self

from palpate.codec import TARE
from palpate.errors import DatasetError, WireError
from palpate.files.atomic import written_whole
from palpate.heartbeat import FILE_VARIABLE
from palpate.messages import Tare

_log = logging.getLogger(__name__)


class _KeptFile:
    """One sensor's file. A file that cannot be written or read is a warning, no error."""

    _what: ClassVar[str]

    def __init__(self, file: Path) -> None:
        self._file = file

    @classmethod
    def of(cls, sensor: str) -> Self | None:
        """That of a sensor of this process; None = no supervisor would start the process again."""
        heartbeat = os.environ.get(FILE_VARIABLE)
        return cls(Path(f"{heartbeat}.{sensor}.{cls._what}")) if heartbeat else None

    def _write(self, content: bytes) -> None:
        try:
            with written_whole(self._file) as part:
                part.write_bytes(content)
        except DatasetError as error:
            _log.warning("the %s is not kept for a restart: %s", self._what, error.problem)

    def _read(self) -> bytes | None:
        """What was kept; None = nothing, or it is not readable."""
        try:
            return self._file.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._unreadable(error)
            return None

    def _unreadable(self, error: Exception) -> None:
        _log.warning("the %s that was kept for a restart is not readable: %s", self._what, error)


class KeptTare(_KeptFile):
    """The tare of a finger."""

    _what = "tare"

    def keep(self, tare: Tare) -> None:
        """Write a tare in place of the one before."""
        self._write(TARE.encode(tare))

    def find(self, serial: str, electrodes: int) -> Tare | None:
        """The tare of the finger with this serial and number of electrodes, if it was kept."""
        content = self._read()
        if content is None:
            return None
        try:
            tare = TARE.decode(content)
        except WireError as error:
            self._unreadable(error)
            return None
        same = tare.sensor_serial == serial and len(tare.electrodes) == electrodes
        return tare if same and tare.stamp.monotonic_ns <= time.monotonic_ns() else None


class KeptZero(_KeptFile):
    """That a force/torque sensor has taken a zero, and what its driver needs to go on with it."""

    _what = "zero"

    def keep(self, note: bytes) -> None:
        """Write the driver's note of a zero in place of the one before; it may be empty."""
        self._write(note)

    def find(self) -> bytes | None:
        """The note of the last zero; None = none was taken."""
        return self._read()
