"""Errors of palpate: what was wrong, by name, and what to do about it.

All are ``PalpateError`` and a built-in error as well; docs/conventions.md shows the tree.
Each carries ``remedy``: one sentence that says what to do. ``str(error)`` holds both.
"""

from __future__ import annotations

import unicodedata
from enum import IntEnum

_ACTING = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
# Categories of characters that act on a terminal or have no picture: controls (also C1), changes of
# the direction, lone surrogates, private and unassigned ones, separators of lines and paragraphs.


def printable(text: str, *, keep: str = "") -> str:
    r"""The text with every character that could act on a terminal written as ``\x1b``.

    Texts of files, of the bus and of other processes pass through here before they are printed.
    Characters of ``keep``, e.g. a line feed, stay.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        char if char in keep or unicodedata.category(char) not in _ACTING else _shown(char)
        for char in text
    )


def _shown(char: str) -> str:
    return char.encode("unicode_escape", "surrogatepass").decode("ascii")


class ErrorCode(IntEnum):
    """Codes of ``palpate.v1.Error``; the numbers are the wire's."""

    UNSPECIFIED = 0
    INVALID_REQUEST = 1
    NOT_FOUND = 2
    UNAVAILABLE = 3
    RESOURCE_EXHAUSTED = 4
    DEADLINE_EXCEEDED = 5
    WRONG_CONTRACT = 6
    DEVICE = 7
    DISK = 8
    SIMULATION = 9
    INTERNAL = 10
    PERMISSION_DENIED = 11


class PalpateError(Exception):
    """Base of all errors that palpate raises on purpose.

    Attributes:
        code: Its code on the wire.
        problem: What was wrong, naming the file, key, channel or message.
        remedy: What to do about it.
        retry_after_s: Ask again after this time [s]; 0 = do not.
    """

    code = ErrorCode.INTERNAL
    retry_after_s = 0.0

    def __init__(self, problem: str, *, remedy: str) -> None:
        super().__init__(f"{problem} -> {remedy}")
        self.problem = problem
        self.remedy = remedy

    def __reduce__(self) -> tuple[object, ...]:
        """Pickled whole: an error of another process says what it said there."""
        return _restored, (type(self), self.args, self.__dict__)


def _restored(
    kind: type[PalpateError], arguments: tuple[object, ...], values: dict[str, object]
) -> PalpateError:
    error = kind.__new__(kind, *arguments)
    error.args = arguments
    error.__dict__.update(values)
    return error


class ConfigError(PalpateError, ValueError):
    """A configuration file, key or flag is wrong; names key and file."""

    code = ErrorCode.INVALID_REQUEST


class MissingExtraError(PalpateError, ImportError):
    """An optional dependency is not installed."""

    code = ErrorCode.UNAVAILABLE

    def __init__(self, module: str, *, extra: str) -> None:
        super().__init__(
            f"the Python package {module!r} is not installed",
            remedy=f'install it: pip install "palpate[{extra}]"',
        )
        self.extra = extra


class DeviceError(PalpateError, OSError):
    """A sensor, or a recording that stands for one, misbehaves."""

    code = ErrorCode.DEVICE


class DeviceLost(DeviceError):
    """The device was there and is gone."""


class DeviceTimeout(DeviceError, TimeoutError):
    """The device did not answer in time."""


class RecordingError(DeviceError):
    """A log or record is truncated, damaged, or not what it claims to be."""


class WireError(PalpateError, ValueError):
    """Bytes do not decode, break the contract, or speak another version of it.

    Rejects are counted by ``reason``, a short name, e.g. ``"electrode_count"``.
    """

    code = ErrorCode.WRONG_CONTRACT

    def __init__(self, problem: str, *, remedy: str, reason: str) -> None:
        super().__init__(problem, remedy=remedy)
        self.reason = reason


class LinkError(PalpateError, OSError):
    """No router, port in use, or the session is gone."""

    code = ErrorCode.UNAVAILABLE


class ClaimedElsewhere(PalpateError, OSError):
    """Another process holds what this one claims."""

    code = ErrorCode.UNAVAILABLE


class SensorTaken(ClaimedElsewhere):
    """Another gateway publishes under the key of this sensor."""


class StationTaken(ClaimedElsewhere):
    """Another station of the site has this name."""


class ReplicaDiffers(ClaimedElsewhere):
    """A replica under the same key would give other answers."""


class StreamTimeout(PalpateError, TimeoutError):
    """No message arrived in time."""

    code = ErrorCode.DEADLINE_EXCEEDED


class SensorChanged(PalpateError):
    """Messages under the name of a sensor come from another one than before."""

    code = ErrorCode.DEVICE


class StaleError(PalpateError, TimeoutError):
    """The newest message is older than the caller accepts."""

    code = ErrorCode.DEADLINE_EXCEEDED


class ClockSkewError(StaleError):
    """The newest message was stamped in the future, so that its age is not known.

    Attributes:
        skew_s: How far in the future [s].
    """

    def __init__(self, problem: str, *, remedy: str, skew_s: float) -> None:
        super().__init__(problem, remedy=remedy)
        self.skew_s = skew_s


class BundleError(PalpateError, ValueError):
    """A model bundle breaks its contract."""

    code = ErrorCode.WRONG_CONTRACT


class DatasetError(PalpateError, ValueError):
    """A data set breaks its schema."""

    code = ErrorCode.INVALID_REQUEST


class SimulationError(PalpateError, RuntimeError):
    """A simulation cannot be run or did not converge."""

    code = ErrorCode.SIMULATION


class RemoteError(PalpateError):
    """A service answered a query with a typed error; problem, remedy and code are the service's."""

    def __init__(
        self, problem: str, *, remedy: str, code: ErrorCode, retry_after_s: float = 0.0
    ) -> None:
        super().__init__(problem, remedy=remedy)
        self.code = code
        self.retry_after_s = retry_after_s
