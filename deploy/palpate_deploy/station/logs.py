"""Where log lines go: stderr, as text for people or one JSON object a line for machines."""

from __future__ import annotations

import json
import logging
import sys
import time
from typing import Literal

from palpate.errors import ConfigError, DeviceError, MissingExtraError, PalpateError

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]


class JsonFormatter(logging.Formatter):
    """One JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """Format one record."""
        line = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
            + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


class TextFormatter(logging.Formatter):
    """``12:34:56.789 warning palpate_gateway.service.node: message``, local time."""

    default_time_format = "%H:%M:%S"
    default_msec_format = "%s.%03d"

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(level)s %(name)s: %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        """Format one record."""
        record.level = record.levelname.lower()
        return super().format(record)


def configure(level: LogLevel = "warning", style: LogFormat = "text") -> None:
    """Send log lines of this process to stderr.

    Args:
        level: The least that is shown.
        style: For people or for machines.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if style == "json" else TextFormatter())
    root = logging.getLogger()
    for old in list(root.handlers):
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level.upper())


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
