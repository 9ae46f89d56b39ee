"""Options of a driver on the command line, and the same options as TOML.

``rate_hz=200``, ``mount.carries=indenter``, ``trajectories='["a", "b"]'``: the text after the
equals sign is a TOML value, or a plain string if it is not valid TOML.
"""

from __future__ import annotations

import json
import shlex
import tomllib
from collections.abc import Container, Iterable, Mapping
from datetime import date, datetime, time
from typing import Any

from palpate.config import StrictConfig
from palpate.errors import ConfigError


def parse_key_values(pairs: Iterable[str], texts: Container[str] = ()) -> dict[str, Any]:
    """Nested tables from ``key=value`` words.

    Args:
        pairs: As typed.
        texts: Keys whose values are always strings, e.g. a serial number.

    Raises:
        ConfigError: A word has no equals sign or an empty key, or a key is given twice.
    """
    options: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        parts = [part.strip() for part in key.split(".")]
        if not equals or not all(parts):
            raise ConfigError(
                f"option {pair!r} is not KEY=VALUE",
                remedy="write e.g. rate_hz=200 or mount.carries=indenter",
            )
        table = options
        for part in parts[:-1]:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise _twice(key)
        if parts[-1] in table:
            raise _twice(key)
        value = parse_value(text)
        table[parts[-1]] = text if key in texts and not isinstance(value, str) else value
    return options


def parse_value(text: str) -> Any:
    """A TOML value; the text itself if it is not valid TOML."""
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    value = table.pop("value")
    # A line break in the text may make more keys; no driver has an option that is a date.
    return text if table or isinstance(value, (date, datetime, time)) else value


def text_keys(options_class: type[StrictConfig]) -> frozenset[str]:
    """Names of options that are strings."""
    fields = options_class.model_fields.items()
    return frozenset(name for name, field in fields if field.annotation is str)


def sensor_toml(name: str, driver: str, options: Mapping[str, Any], *, of: str = "") -> str:
    """The table of one sensor in a profile; ``of`` names the finger that it belongs to."""
    lines = ["[[gateway.sensors]]", f"name = {toml_value(name)}", f"driver = {toml_value(driver)}"]
    lines += [f"of = {toml_value(of)}", ""] if of else [""]
    lines += ["[gateway.sensors.options]"]
    lines += [f"{key} = {toml_value(value)}" for key, value in options.items()]
    return "\n".join(lines) + "\n"


def command_words(options: Mapping[str, Any], prefix: str = "") -> str:
    """Options as words of a command line."""
    words = []
    for key, value in options.items():
        if isinstance(value, Mapping):
            words.append(command_words(value, f"{prefix}{key}."))
        else:
            text = value if isinstance(value, str) else toml_value(value)
            words.append(shlex.quote(f"{prefix}{key}={text}"))
    return " ".join(words)


def toml_value(value: Any) -> str:
    """A value as TOML in one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {toml_value(one)}" for key, one in value.items()) + " }"
    # JSON writes strings, numbers and booleans as TOML does.
    return json.dumps(value, ensure_ascii=False)


def _twice(key: str) -> ConfigError:
    return ConfigError(f"option {key!r} is given twice", remedy="give each option once")
