"""Be called with each estimate, in a thread of palpate's, while the program does something else.

With a station without hardware:

    palpate up --profile virtual            # in one terminal
    python docs/examples/callbacks.py       # in another: ten seconds, or so many as are given
"""

from __future__ import annotations

import sys
import time

from palpate import Client
from palpate.errors import PalpateError
from palpate.messages import FeatureEstimate


class Strongest:
    """Remembers the strongest force of each second; an exception in here would only be counted."""

    def __init__(self) -> None:
        self.force_n = 0.0

    def __call__(self, estimate: FeatureEstimate) -> None:
        """Called up to 100 times a second: be quick, or estimates are skipped."""
        self.force_n = max(self.force_n, float((estimate.force**2).sum() ** 0.5))


def silent(error: PalpateError) -> None:
    """Called when nothing usable came for the stream's ``timeout_s``; it goes on by itself."""
    print(error)


def main(seconds: float) -> None:
    """The main thread is free."""
    strongest = Strongest()
    try:
        with (
            Client() as robot,
            robot.stream_features("finger", timeout_s=1.0).call(
                strongest, on_error=silent
            ) as watch,
        ):
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                time.sleep(min(seconds, 1.0))
                print(f"{watch.counters['called']:6} estimates, at most {strongest.force_n:.2f} N")
                strongest.force_n = 0.0
    except PalpateError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
