"""Ask how every node of the skin is displaced in one frame, and where most.

With a station without hardware:

    palpate up --profile virtual            # in one terminal
    python docs/examples/field_query.py     # in another
"""

from __future__ import annotations

import sys

import numpy as np

from palpate import Client
from palpate.errors import PalpateError


def main() -> None:
    """A question, not a stream: the answer belongs to this frame, however long it takes."""
    try:
        with Client() as robot:
            frame = robot.electrodes("finger", max_age_s=0.2)
            field = robot.estimate_field("finger", frame, timeout_s=5.0)
    except PalpateError as error:
        sys.exit(str(error))
    moved_um = np.linalg.norm(field.displacement, axis=1) * 1e6
    most = int(moved_um.argmax())
    print(f"frame {field.source.sequence}: {len(moved_um)} nodes")
    print(f"node {most} has moved most, by {moved_um[most]:.0f} µm")
    if field.displacement_sd is not None:
        print(f"uncertain by {field.displacement_sd[most] * 1e6:.0f} µm")


if __name__ == "__main__":
    main()
