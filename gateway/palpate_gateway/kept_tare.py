"""The tare in force of a sensor, for a gateway that is started again after it was killed or hung.

A finger that is touched at that moment could not be tared, and would have no estimates until it is
let go. The file lies beside the gateway's heartbeat, in memory: it is gone with the station's
supervisor, so that a station that starts tares anew.
"""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

from palpate.codec import TARE
from palpate.errors import DatasetError, WireError
from palpate.files.atomic import written_whole
from palpate.heartbeat import FILE_VARIABLE
from palpate.messages import Tare

_log = logging.getLogger(__name__)


class KeptTare:
    """One sensor's file. A file that cannot be written or read is a warning, no error."""

    def __init__(self, file: Path) -> None:
        self._file = file

    @classmethod
    def of(cls, sensor: str) -> KeptTare | None:
        """That of a sensor of this process; None = no supervisor would start the process again."""
        heartbeat = os.environ.get(FILE_VARIABLE)
        return cls(Path(f"{heartbeat}.{sensor}.tare")) if heartbeat else None

    def keep(self, tare: Tare) -> None:
        """Write a tare in place of the one before."""
        try:
            with written_whole(self._file) as part:
                part.write_bytes(TARE.encode(tare))
        except DatasetError as error:
            _log.warning("the tare is not kept for a restart: %s", error.problem)

    def find(self, serial: str, electrodes: int) -> Tare | None:
        """The tare of the finger with this serial and number of electrodes, if it was kept."""
        try:
            tare = TARE.decode(self._file.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, WireError) as error:
            _log.warning("the tare that was kept for a restart is not readable: %s", error)
            return None
        same = tare.sensor_serial == serial and len(tare.electrodes) == electrodes
        return tare if same and tare.stamp.monotonic_ns <= time.monotonic_ns() else None
