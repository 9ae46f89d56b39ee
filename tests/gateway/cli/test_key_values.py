"""Options of a driver as words of a command."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.errors import ConfigError
from palpate_gateway.cli.emulate_run import ScheduledFault, parse_faults
from palpate_gateway.cli.key_values import (
    command_words,
    parse_key_values,
    parse_value,
    sensor_toml,
    text_keys,
)
from palpate_gateway.wrench.kms40 import Kms40Options

plain = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=20)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("200", 200),
        ("0x64", 100),
        ("2.5", 2.5),
        ("true", True),
        ('"200"', "200"),
        ("[1, 2]", [1, 2]),
        ("{ port = 5 }", {"port": 5}),
        ("192.168.1.30", "192.168.1.30"),
        ("/dev/ttyUSB0", "/dev/ttyUSB0"),
        ("", ""),
        ("1 = 2", "1 = 2"),
        ("1\nmore = 2", "1\nmore = 2"),
        ("2026-01-02", "2026-01-02"),
    ],
)
def test_values_are_toml_or_text(text: str, value: Any) -> None:
    assert parse_value(text) == value


@given(st.text(max_size=40))
def test_any_text_has_a_value(text: str) -> None:
    parse_value(text)


def test_dotted_keys_make_tables() -> None:
    words = ["mount.carries=indenter", "mount.origin_m=[0, 0, 0.01]", "rate_hz=250", "host=a=b"]
    assert parse_key_values(words) == {
        "mount": {"carries": "indenter", "origin_m": [0, 0, 0.01]},
        "rate_hz": 250,
        "host": "a=b",
    }


def test_options_that_are_text_stay_text() -> None:
    keys = text_keys(Kms40Options)
    assert {"host", "serial"} <= keys
    assert "rate_hz" not in keys
    assert parse_key_values(["serial=0042", 'host="h"'], keys) == {"serial": "0042", "host": "h"}


@pytest.mark.parametrize("words", [["rate_hz"], ["=3"], ["a..b=3"], ["a=1", "a=2"]])
@pytest.mark.parametrize("before", [[], ["z=1"]])
def test_wrong_words_are_named(words: list[str], before: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"KEY=VALUE|given twice"):
        parse_key_values([*before, *words])


@pytest.mark.parametrize("words", [["a=1", "a.b=2"], ["a.b=2", "a=1"]])
def test_a_key_is_either_value_or_table(words: list[str]) -> None:
    with pytest.raises(ConfigError, match="given twice"):
        parse_key_values(words)


@given(plain, st.integers(-(2**60), 2**60), st.booleans(), st.floats(allow_nan=False, width=32))
def test_what_is_printed_is_what_was_meant(text: str, number: int, on: bool, real: float) -> None:
    if real in (float("inf"), float("-inf")):
        real = 0.0
    options = {"text": text, "number": number, "on": on, "real": real, "bus": {"port": number}}
    (sensor,) = tomllib.loads(sensor_toml("wrench", "d", options))["gateway"]["sensors"]
    assert sensor == {"name": "wrench", "driver": "d", "options": options}


def test_command_words_are_read_back() -> None:
    options = {"port": "/dev/tty 1", "bus_options": {"port": 5, "hop_limit": 1}, "rate_hz": 100.0}
    words = command_words(options)
    assert words == "'port=/dev/tty 1' bus_options.port=5 bus_options.hop_limit=1 rate_hz=100.0"


def test_faults_on_a_time_table() -> None:
    texts = ["lost@5", "silence@1.5+3"]
    assert parse_faults(texts, {"lost", "silence"}) == [
        ScheduledFault(1.5, "silence", 3.0),
        ScheduledFault(5.0, "lost", 0.0),
    ]


@pytest.mark.parametrize("text", ["lost", "lost@", "lost@x", "lost@-1", "lost@1+", "lost@inf"])
def test_a_fault_without_a_time_is_none(text: str) -> None:
    with pytest.raises(ConfigError, match=r"NAME@START\[\+SECONDS\]"):
        parse_faults([text], {"lost"})


def test_an_unknown_fault_names_all_that_there_are() -> None:
    with pytest.raises(ConfigError, match="'fire' -> its faults: lost, silence"):
        parse_faults(["fire@1"], {"silence", "lost"})
