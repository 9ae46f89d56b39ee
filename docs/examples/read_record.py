"""Read the forces of a record: of a live station, or of a log that was replayed.

With a station without hardware:

    palpate up --profile virtual                                # in one terminal
    palpate record --duration-s 10 --out runs/mine              # in another
    python docs/examples/read_record.py runs/mine/*.mcap
    palpate replay runs/mine/*.mcap                             # the same frames once more
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from palpate.bus.topics import FEATURES
from palpate.errors import PalpateError
from palpate.files.record import read_record


def main(path: Path) -> None:
    """Payloads in a record are those of the bus: the same codec decodes them."""
    forces = []
    try:
        for item in read_record(path):
            if item.address.topic == FEATURES.name:
                forces.append(FEATURES.codec.decode(item.payload).force)
    except PalpateError as error:
        sys.exit(str(error))
    if not forces:
        sys.exit(f"{path} has no features -> record a station whose features service runs")
    strongest = np.linalg.norm(np.array(forces), axis=1).max()
    print(f"{len(forces)} estimates, the strongest force {strongest:.2f} N")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: read_record.py FILE.mcap")
    main(Path(sys.argv[1]))
