"""Print where a finger is touched and how hard, as the estimates come.

With a station without hardware:

    palpate up --profile virtual                # in one terminal
    python docs/examples/features_stream.py     # in another: 300 estimates, or so many as are given
"""

from __future__ import annotations

import sys

from palpate import Client
from palpate.errors import PalpateError


def main(count: int) -> None:
    """The newest wins: a slow loop skips estimates and never sees an old one."""
    try:
        with Client() as robot, robot.stream_features("finger") as estimates:
            for number, estimate in enumerate(estimates, 1):
                x, y, z = estimate.force
                place = estimate.contact_location
                if estimate.centre_of_pressure is not None:  # of newer bundles: on the skin
                    place = estimate.centre_of_pressure
                where = "no contact" if place is None else f"at {place * 1e3} mm"
                print(f"{estimate.source.sequence:6}  {x:6.2f} {y:6.2f} {z:6.2f} N  {where}")
                if number == count:
                    break
            print(f"{estimates.counters['dropped']} were skipped")
    except PalpateError as error:  # says what was wrong and what to do about it
        sys.exit(str(error))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
