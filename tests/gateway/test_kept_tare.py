"""A gateway that was killed goes on with its tare, so that a pressed finger has estimates."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.gateway.test_taring import pipeline, push, tares

from palpate.codec import TARE
from palpate.heartbeat import FILE_VARIABLE
from palpate.messages import NO_TARE, ElectrodeFrame, Tare
from palpate_gateway.clock.stamps import DueMessage, LiveClock
from palpate_gateway.device import DeviceIdentity
from palpate_gateway.kept_tare import KeptTare

fakes: Any = importlib.import_module("condition_fakes")


@pytest.fixture
def kept(tmp_path: Path) -> KeptTare:
    return KeptTare(tmp_path / "gateway.finger.tare")


@pytest.fixture
def tare(kept: KeptTare) -> Tare:
    """Of a finger that was at rest, by a gateway that is gone."""
    (found,) = tares(push(pipeline(kept=kept), fakes.Finger().frames(1.0)))
    return found


def ids(out: list[DueMessage]) -> set[int]:
    return {item.message.tare_id for item in out if isinstance(item.message, ElectrodeFrame)}


def test_frames_of_a_pressed_finger_name_it_from_the_first_on(kept: KeptTare, tare: Tare) -> None:
    made, finger = pipeline(kept=kept), fakes.Finger()
    finger.pac_noise = 22.0  # a hand holds it
    out = push(made, finger.frames(1.0))
    assert ids(out) == {tare.tare_id}
    np.testing.assert_array_equal(made.ledger.find(tare.tare_id).electrodes, tare.electrodes)
    assert made.tare_error is None
    assert tares(out) == []
    finger.pac_noise = 4.0
    made.ask_tare(0)
    assert len(tares(push(made, finger.frames(1.0)))) == 1


def test_the_last_one_is_kept(kept: KeptTare, tare: Tare) -> None:
    made, finger = pipeline(kept=kept), fakes.Finger()
    list(finger.frames(2.0))  # time goes on: a tare of the same frames may have the same id
    made.ask_tare(0)
    (later,) = tares(push(made, finger.frames(1.0)))
    assert later.tare_id != tare.tare_id
    assert pipeline(kept=kept).ledger.current_id == later.tare_id


def test_another_finger_is_tared_itself(kept: KeptTare, tare: Tare) -> None:
    made = pipeline(kept=kept)
    assert made.ledger.current_id == tare.tare_id
    for serial in ("BT2", "BT1"):  # exchanged, and exchanged again: it may have been opened
        made.begin(DeviceIdentity(serial, 1 / 4400), LiveClock())
        assert made.ledger.current_id == NO_TARE
    assert kept.find("BT2", 19) is None
    assert kept.find("BT1", 24) is None


@pytest.mark.parametrize("content", [b"", b"no tare", b"\xff" * 200])
def test_a_broken_file_is_no_tare(
    kept: KeptTare, tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "gateway.finger.tare").write_bytes(content)
    made = pipeline(kept=kept)
    assert made.ledger.current_id == NO_TARE
    assert "not readable" in caplog.text
    assert len(tares(push(made, fakes.Finger().frames(1.0)))) == 1


def test_one_of_another_boot_is_none(kept: KeptTare, tare: Tare, tmp_path: Path) -> None:
    later = replace(tare, stamp=replace(tare.stamp, monotonic_ns=2**62))
    (tmp_path / "gateway.finger.tare").write_bytes(TARE.encode(later))
    assert pipeline(kept=kept).ledger.current_id == NO_TARE


def test_a_folder_that_cannot_be_written_costs_nothing_but_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    made = pipeline(kept=KeptTare(tmp_path / "file" / "gateway.finger.tare"))
    assert len(tares(push(made, fakes.Finger().frames(1.0)))) == 1
    assert "is not kept for a restart" in caplog.text


def test_a_recording_brings_its_own(kept: KeptTare, tare: Tare) -> None:
    assert pipeline(live=False, kept=kept).ledger.current_id == NO_TARE


def test_it_is_kept_only_where_somebody_starts_the_gateway_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv(FILE_VARIABLE, raising=False)
    assert KeptTare.of("finger") is None
    monkeypatch.setenv(FILE_VARIABLE, str(tmp_path / "gateway"))
    assert KeptTare.of("finger") is not None
