"""The BioTac SP on the wire: 24 electrodes, 27 PAC samples, 54 validity bits."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import json_format

from palpate.codec import ELECTRODE_FRAME, SYNTHESIS_ESTIMATE, TARE, Codec
from palpate.errors import WireError
from palpate.messages import (
    BIOTAC_LAYOUT,
    BIOTAC_SP_LAYOUT,
    ElectrodeFrame,
    FrameLayout,
    SensorType,
    Tare,
)
from palpate.v1 import frames_pb2

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "v1" / "biotac_sp"
CODECS: dict[str, Codec[Any]] = {"ElectrodeFrame": ELECTRODE_FRAME, "Tare": TARE}


@pytest.fixture(scope="module")
def sp(examples: dict[str, Any]) -> dict[str, Any]:
    """Message name -> what an SP says."""
    frame: ElectrodeFrame = examples["ElectrodeFrame"]
    tare: Tare = examples["Tare"]
    return {
        "ElectrodeFrame": dataclasses.replace(
            frame,
            sensor_serial="BTSP0504",
            sensor_type=SensorType.BIOTAC_SP,
            electrodes=np.arange(24, dtype=np.uint16) * 80 + 2000,
            pac=np.arange(27, dtype=np.uint16) + 2030,
            validity=(1 << 54) - 2 - (1 << 53),
        ),
        "Tare": dataclasses.replace(
            tare,
            sensor_serial="BTSP0504",
            electrodes=np.linspace(2900, 3400, 24, dtype=np.float32),
            electrodes_sd=np.full(24, 0.5, np.float32),
        ),
    }


@pytest.mark.parametrize(
    ("kind", "layout", "electrodes", "pac", "slots"),
    [
        (SensorType.BIOTAC, BIOTAC_LAYOUT, 19, 22, 44),
        (SensorType.BIOTAC_SP, BIOTAC_SP_LAYOUT, 24, 27, 54),
    ],
)
def test_layouts(
    kind: SensorType, layout: FrameLayout, electrodes: int, pac: int, slots: int
) -> None:
    assert kind.layout is layout
    assert (layout.electrodes, layout.pac_samples, layout.slots) == (electrodes, pac, slots)
    names = [layout.bit_name(bit) for bit in range(slots)]
    assert names[:electrodes] == [f"E{k + 1}" for k in range(electrodes)]
    assert names[electrodes : electrodes + 3] == ["PDC", "TAC", "TDC"]
    assert names[layout.first_pac_bit :] == [f"PAC[{k}]" for k in range(pac)]
    assert (names[layout.pdc_bit], names[layout.tac_bit]) == ("PDC", "TAC")
    assert names[layout.tdc_bit] == "TDC"
    assert layout.all_valid == 2**slots - 1
    assert layout.electrodes_valid == 2**electrodes - 1


@pytest.mark.parametrize("name", sorted(CODECS))
def test_golden_payloads(name: str, sp: dict[str, Any], request: pytest.FixtureRequest) -> None:
    codec = CODECS[name]
    binary, readable = GOLDEN / f"{name}.bin", GOLDEN / f"{name}.json"
    if request.config.getoption("--update-golden"):
        GOLDEN.mkdir(parents=True, exist_ok=True)
        message = codec.message_type.FromString(codec.encode(sp[name]))
        binary.write_bytes(message.SerializeToString(deterministic=True))
        readable.write_text(json_format.MessageToJson(message, sort_keys=True) + "\n")
    payload = binary.read_bytes()
    assert codec.encode(sp[name]) == payload
    parsed = codec.message_type.FromString(payload)
    assert json_format.Parse(readable.read_text(), codec.message_type()) == parsed
    decoded = codec.decode(payload)
    for field in dataclasses.fields(decoded):
        mine, theirs = getattr(decoded, field.name), getattr(sp[name], field.name)
        assert np.array_equal(mine, theirs), field.name


def test_electrodes_valid_asks_for_all_24(sp: dict[str, Any]) -> None:
    frame: ElectrodeFrame = sp["ElectrodeFrame"]
    assert not frame.electrodes_valid
    for validity, good in ((2**24 - 1, True), (2**19 - 1, False), (2**24 - 1 - 2**23, False)):
        assert dataclasses.replace(frame, validity=validity).electrodes_valid is good


@pytest.mark.parametrize(
    ("changes", "reason", "named"),
    [
        ({"electrodes": np.zeros(19, np.uint16)}, "electrode_count", "19 values, not 24"),
        ({"pac": np.zeros(22, np.uint16)}, "pac_count", "22 values, not 27"),
        ({"pac": np.full(27, 4096, np.uint16)}, "counts_range", "pac[0]"),
        ({"validity": 1 << 54}, "validity", "54 channels"),
        ({"sensor_type": SensorType.BIOTAC}, "electrode_count", "24 values, not 19"),
    ],
)
def test_what_is_not_an_sp_is_refused_on_both_sides(
    sp: dict[str, Any], changes: dict[str, Any], reason: str, named: str
) -> None:
    frame: ElectrodeFrame = sp["ElectrodeFrame"]
    message = frames_pb2.ElectrodeFrame.FromString(ELECTRODE_FRAME.encode(frame))
    for field, value in changes.items():
        setattr(message, field, value.tobytes() if isinstance(value, np.ndarray) else int(value))
    with pytest.raises(WireError, match=named.replace("[", r"\[")) as decoded:
        ELECTRODE_FRAME.decode(message.SerializeToString())
    with pytest.raises(WireError, match=named.replace("[", r"\[")) as encoded:
        ELECTRODE_FRAME.encode(dataclasses.replace(frame, **changes))
    assert decoded.value.reason == encoded.value.reason == reason


@pytest.mark.parametrize("count", [18, 22, 25])
def test_tare_and_synthesis_have_a_value_for_each_electrode(
    examples: dict[str, Any], sp: dict[str, Any], count: int
) -> None:
    estimate = dataclasses.replace(
        examples["SynthesisEstimate"],
        tared_counts=np.zeros(24, np.float32),
        tared_counts_sd=np.ones(24, np.float32),
    )
    assert SYNTHESIS_ESTIMATE.decode(SYNTHESIS_ESTIMATE.encode(estimate)).tared_counts.size == 24
    values = np.zeros(count, np.float32)
    tare = dataclasses.replace(sp["Tare"], electrodes=values, electrodes_sd=values)
    with pytest.raises(WireError, match=rf"{count} values, not 19 \(BIOTAC\) or 24 \(BIOTAC_SP\)"):
        TARE.encode(tare)
    bad = dataclasses.replace(estimate, tared_counts=values, tared_counts_sd=values)
    with pytest.raises(WireError, match="not 19"):
        SYNTHESIS_ESTIMATE.encode(bad)
