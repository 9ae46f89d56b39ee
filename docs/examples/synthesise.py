"""Ask what the electrodes would read of a field, and compare with what they did read.

With a station without hardware:

    palpate up --profile virtual            # in one terminal
    python docs/examples/synthesise.py      # in another
"""

from __future__ import annotations

import sys

from palpate import Client
from palpate.errors import PalpateError


def main() -> None:
    """Electrodes to field to electrodes, of one frame."""
    try:
        with Client() as robot:
            frame = robot.electrodes("finger", max_age_s=0.2)
            field = robot.estimate_field("finger", frame, timeout_s=5.0)
            synthesis = robot.synthesise(field, timeout_s=5.0)
    except PalpateError as error:
        sys.exit(str(error))
    print("electrode   synthesised [tared counts]   raw counts of the frame")
    for number, (counts, raw) in enumerate(
        zip(synthesis.tared_counts, frame.electrodes, strict=True), 1
    ):
        print(f"E{number:<10} {counts:8.1f} {raw:26}")


if __name__ == "__main__":
    main()
