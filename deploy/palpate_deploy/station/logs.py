"""What a process writes to stderr: its log lines, and the error that ends a command."""

from __future__ import annotations

import logging
import sys
import time
from typing import Literal

from rich.markup import escape

from palpate.errors import ConfigError, DeviceError, MissingExtraError, PalpateError, printable

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]

FAILED = 1
USAGE = 2
DEVICE = 3


def configure(
    level: LogLevel = "warning",
    style: LogFormat = "text",
    *,
    station: str = "",
    service: str = "",
) -> None:
    """Send the log lines of this process to stderr.

    Args:
        level: The lowest level that is written.
        style: ``text`` for people, ``12:34:56.789 warning palpate.bus.link: message`` in local
            time; ``json`` for machines, an object a line with ``time`` (UTC), ``level``,
            ``logger``, ``message``, ``pid``, ``station`` and ``service``, where there is one
            ``exception``, and where the line concerns a frame the fields of ``palpate.log``.
        station: Name of the station; ``""`` = this process belongs to none.
        service: What this process serves; ``""`` = it is a command.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.addFilter(_add_level)
    where = {"station": station, "service": service}
    formatter = _json_formatter(where) if style == "json" else _text_formatter()
    handler.setFormatter(formatter)
    root = logging.getLogger()
    for old in list(root.handlers):
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level.upper())


def _add_level(record: logging.LogRecord) -> bool:
    record.level = record.levelname.lower()
    return True


class _TextFormatter(logging.Formatter):
    """Log lines for people: what strangers sent is shown, and does not act on the terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record), keep="\n\t")


def _text_formatter() -> logging.Formatter:
    formatter = _TextFormatter("%(asctime)s %(level)s %(name)s: %(message)s")
    formatter.default_time_format, formatter.default_msec_format = "%H:%M:%S", "%s.%03d"
    return formatter


def _json_formatter(where: dict[str, str]) -> logging.Formatter:
    from pythonjsonlogger.json import JsonFormatter

    formatter = JsonFormatter(
        ["asctime", "level", "name", "message", "process"],
        rename_fields={
            "asctime": "time",
            "name": "logger",
            "exc_info": "exception",
            "process": "pid",
        },
        static_fields={name: value for name, value in where.items() if value},
    )
    formatter.converter = time.gmtime
    formatter.default_time_format, formatter.default_msec_format = "%Y-%m-%dT%H:%M:%S", "%s.%03dZ"
    return formatter


def exit_code(error: PalpateError) -> int:
    """Exit code of a command that ended with ``error``: 1 failed, 2 usage or config, 3 device."""
    if isinstance(error, (ConfigError, MissingExtraError)):
        return USAGE
    if isinstance(error, DeviceError):
        return DEVICE
    return FAILED


def print_error(error: PalpateError) -> None:
    """Print to stderr what was wrong and what to do about it."""
    print(f"error: {printable(error.problem)}", file=sys.stderr)
    print(f"  fix: {printable(error.remedy)}", file=sys.stderr, flush=True)


def cell(text: str) -> str:
    """The text without control characters, and without a meaning as Rich's markup."""
    return escape(printable(text))
