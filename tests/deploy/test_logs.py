"""Log lines as JSON: one object a line, with the frame that it concerns as fields."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator

import pytest

from palpate.log import about
from palpate.messages import Origin, Stamp
from palpate_deploy.station.logs import LogFormat, configure

STAMP = Stamp(41, 1042, 9_876_543_210, 1_763_719_200_123_456_789, 7, Origin.SIMULATED)
_log = logging.getLogger("palpate.test")


@pytest.fixture(autouse=True)
def own_root() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


def line(capsys: pytest.CaptureFixture[str], style: LogFormat = "json") -> str:
    configure("info", style, station="lab", service="features")
    fields = about("finger", STAMP, tare_id=(1 << 63) + 1, model="features-twin:2")
    _log.warning("refused: %s", "tare_unknown", extra=fields)
    (only,) = capsys.readouterr().err.splitlines()
    return only


def test_a_frame_is_found_by_its_fields(capsys: pytest.CaptureFixture[str]) -> None:
    told = json.loads(line(capsys))
    assert told.pop("time").endswith("Z")
    assert told == {
        "level": "warning",
        "logger": "palpate.test",
        "message": "refused: tare_unknown",
        "pid": os.getpid(),
        "station": "lab",
        "service": "features",
        "sensor": "finger",
        "sequence": 41,
        "device_tick": 1042,
        "origin": "simulated",
        "tare_id": "8000000000000001",
        "model": "features-twin:2",
    }


def test_text_for_people_has_no_fields(capsys: pytest.CaptureFixture[str]) -> None:
    assert line(capsys, "text").endswith(" warning palpate.test: refused: tare_unknown")


def test_json_is_harmless_in_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Control characters beyond ASCII, and those that turn the direction of writing."""
    configure("info", "json")
    strange = "\x9b31m \u202e \u00b5"
    _log.warning("%s", strange)
    (only,) = capsys.readouterr().err.splitlines()
    assert only.isascii()
    assert only.isprintable()
    assert json.loads(only)["message"] == strange


def test_a_command_has_no_station(capsys: pytest.CaptureFixture[str]) -> None:
    configure("info", "json")
    _log.info("hello", extra=about("finger"))
    told = json.loads(capsys.readouterr().err)
    assert told["sensor"] == "finger"
    assert not told.keys() & {"station", "service", "sequence", "tare_id", "model"}
