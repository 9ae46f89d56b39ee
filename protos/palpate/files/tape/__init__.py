"""The tape: simulated presses of one fingertip, small enough to ship, that any player can play.

``build_tape`` makes one from arrays, ``write_tape`` and ``read_tape`` keep it in one file; the
gateway's virtual finger plays it (docs/adr/0012-virtual-finger-stand-in.md).
"""

from palpate.files.tape.build import TapePress, build_tape, tape_unit
from palpate.files.tape.content import Tape, TapeTrajectory, TapeUnit, check_tape
from palpate.files.tape.file import read_tape, write_tape

__all__ = [
    "Tape",
    "TapePress",
    "TapeTrajectory",
    "TapeUnit",
    "build_tape",
    "check_tape",
    "read_tape",
    "tape_unit",
    "write_tape",
]
