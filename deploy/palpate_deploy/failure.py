"""How a failed command ends: two lines on stderr and an exit code, never a traceback."""

from __future__ import annotations

import sys

from palpate.errors import ConfigError, DeviceError, MissingExtraError, PalpateError

FAILED = 1
USAGE = 2
DEVICE = 3


def exit_code(error: PalpateError) -> int:
    """Exit code of a command that ended with ``error``: 1 failed, 2 usage or config, 3 device."""
    if isinstance(error, (ConfigError, MissingExtraError)):
        return USAGE
    if isinstance(error, DeviceError):
        return DEVICE
    return FAILED


def print_error(error: PalpateError) -> None:
    """Say on stderr what was wrong and what to do about it."""
    print(f"error: {error.problem}", file=sys.stderr)
    print(f"  fix: {error.remedy}", file=sys.stderr, flush=True)
