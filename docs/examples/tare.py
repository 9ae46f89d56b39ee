"""Tare a finger that nobody touches, and say what its electrodes read then.

With a station without hardware:

    palpate up --profile virtual            # in one terminal
    python docs/examples/tare.py            # in another
"""

from __future__ import annotations

import sys

from palpate import Client
from palpate.errors import PalpateError


def main() -> None:
    """Refused while the finger is touched, moved or warming up: the text says which."""
    try:
        with Client() as robot:
            tare = robot.tare("finger", frames=50)
    except PalpateError as error:
        sys.exit(str(error))
    print(
        f"tare {tare.tare_id:016x} of {tare.sensor_serial}: mean of {tare.frames_averaged} frames"
    )
    for number, (counts, noise) in enumerate(
        zip(tare.electrodes, tare.electrodes_sd, strict=True), 1
    ):
        print(f"E{number:<3} {counts:7.1f} counts, noise {noise:.2f}")


if __name__ == "__main__":
    main()
