"""What a service remembers beyond its end: the bundles that it serves.

A service that starts again serves what it served before, whatever has been imported meanwhile. Only
a profile that names other bundles than then begins anew.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from palpate.errors import ConfigError
from palpate.files.bounded import parse_json, read_regular

_log = logging.getLogger(__name__)

_FORMAT = 1
_BYTES_MOST = 1 << 20


@dataclass(frozen=True, slots=True)
class Remembered:
    """What served a sensor: how its bundles are found, and their digests; empty = none."""

    bundle: str
    sha256: bytes
    previous: str = ""
    previous_sha256: bytes = b""
    changed: bool = False


class RememberedFile:
    """A file that says what one service of a station serves; written whole or not at all."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._profile: dict[str, str] = {}

    def recall(self, profile: Mapping[str, str]) -> dict[str, Remembered] | None:
        """What was served of each sensor; None = nothing that still counts.

        ``profile`` are the bundles that the profile names now, by sensor.

        Raises:
            ConfigError: The file is there and damaged: what it served must be said anew.
        """
        self._profile = dict(profile)
        try:
            values = parse_json(read_regular(self._file, _BYTES_MOST))
            if values["format"] != _FORMAT:
                raise ValueError(f"its format is {values['format']!r}")
            then = values["profile"]
            entries = {sensor: _entry(entry) for sensor, entry in values["served"].items()}
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"{self._file}, which says what was served, cannot be read: {error}",
                remedy="remove it to serve what the profile names",
            ) from error
        if then != self._profile:
            _log.info("the profile names other bundles than before: it counts")
            return None
        return entries

    def keep(self, served: Mapping[str, Remembered]) -> None:
        """Remember what is served.

        Raises:
            ConfigError: It cannot be written; what is served is not changed by that.
        """
        values = {
            "format": _FORMAT,
            "profile": self._profile,
            "served": {sensor: _plain(entry) for sensor, entry in served.items()},
        }
        aside = None
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            handle, aside = tempfile.mkstemp(prefix=".served.", dir=self._file.parent)
            with open(handle, "w", encoding="utf-8") as file:
                json.dump(values, file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            os.replace(aside, self._file)
        except OSError as error:
            if aside is not None:
                Path(aside).unlink(missing_ok=True)
            raise ConfigError(
                f"what is served now cannot be written to {self._file} "
                f"({error.strerror or error}): a restart would serve what was served before",
                remedy="check the folder's rights and free space, then give the command again",
            ) from error


def _plain(entry: Remembered) -> dict[str, Any]:
    return asdict(entry) | {
        "sha256": entry.sha256.hex(),
        "previous_sha256": entry.previous_sha256.hex(),
    }


def _entry(values: dict[str, Any]) -> Remembered:
    bundle, previous, changed = values["bundle"], values["previous"], values["changed"]
    if not (isinstance(bundle, str) and isinstance(previous, str) and isinstance(changed, bool)):
        raise TypeError("an entry is of another type")
    return Remembered(
        bundle,
        bytes.fromhex(values["sha256"]),
        previous,
        bytes.fromhex(values["previous_sha256"]),
        changed,
    )
