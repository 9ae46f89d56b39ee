"""Every vector of the hardware reference, section by section: bytes, and what they mean.

The tables of single bytes (commands 1.3, words 1.4, error words 1.6) are in ``test_spi``; logs
(1.8, 4.2) in ``recordings``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.gateway.spi_words import decode_word

from palpate_gateway.protocols import bota, kms40, pic32, robotous
from palpate_gateway.protocols.framing import crc16_x25
from palpate_gateway.protocols.rdt import (
    HEX,
    NET_FT,
    START_REQUEST,
    STOP_REQUEST,
    RdtDecoder,
    RdtScale,
    hex_filter_request,
)
from palpate_gateway.protocols.robotous import RobotousSerialDecoder, serial_frame
from palpate_gateway.protocols.spi import WordKind, channel_of_command

SENT: dict[str, tuple[bytes, str]] = {
    "3.1 identity": (kms40.query_request(kms40.KmsQuery.IDENTITY), b"ID()\n".hex()),
    "3.1 start": (kms40.START_REQUEST, b"L1()\n".hex()),
    "3.1 stop": (kms40.STOP_REQUEST, b"L0()\n".hex()),
    "3.1 all axes": (kms40.ALL_AXES_REQUEST, b"LMASK({1,1,1,1,1,1})\n".hex()),
    "3.1 every sample": (kms40.divider_request(1), b"LDIV(1)\n".hex()),
    "3.1 tare": (kms40.TARE_REQUEST, b"TARE(1)\n".hex()),
    "3.1 quiet": (kms40.QUIET_REQUEST, b"VL(0)\n".hex()),
    "3.2 start": (START_REQUEST, "12 34 00 02 00 00 00 00"),
    "3.2 bias": (NET_FT.bias_request, "12 34 00 42 00 00 00 00"),
    "3.2 stop": (STOP_REQUEST, "12 34 00 00 00 00 00 00"),
    "3.3 zero": (HEX.bias_request, "12 34 00 42 00 00 00 FF"),
    "3.3 filter": (hex_filter_request(4), "12 34 00 81 00 00 00 04"),
    "3.5 start": (serial_frame(robotous.START_REQUEST), "55 0B 00 00 00 00 00 00 00 0B AA"),
    "3.5 stop": (serial_frame(robotous.STOP_REQUEST), "55 0C 00 00 00 00 00 00 00 0C AA"),
    "3.5 bias": (serial_frame(robotous.BIAS_REQUEST), "55 11 01 00 00 00 00 00 00 12 AA"),
    "3.5 rate": (serial_frame(robotous.rate_request(200)), "55 0F 05 00 00 00 00 00 00 14 AA"),
    "3.6 configuration": (bota.CONFIG_REQUEST, b"C".hex()),
    "3.6 communication": (bota.communication_request(baud=460800), b"c,0,1,0,4".hex()),
    "3.6 filter": (bota.filter_request(512), b"f,512,0,0,1".hex()),
    "3.6 run": (bota.RUN_REQUEST, b"R".hex()),
    "2.2 stream": (pic32.START_REQUEST, b"r\n".hex()),
    "2.2 stop": (pic32.STOP_REQUEST, b"q\n".hex()),
}
"""Section and name: the request, and its bytes."""


@pytest.mark.parametrize("name", SENT)
def test_what_is_sent(name: str) -> None:
    request, told = SENT[name]
    assert request == bytes.fromhex(told)


def slot(told: str) -> Any:
    command, *rest = bytes.fromhex(told)
    words = [decode_word(bytes(rest[at : at + 2])) for at in range(0, len(rest), 2)]
    return channel_of_command(command), [w.value for w in words], [w.kind for w in words]


def rdt(told: str) -> Any:
    (record,) = RdtDecoder().feed(bytes.fromhex(told))
    wrench = RdtScale(1e6, 1e6).wrench(record.counts)
    return record.rdt_sequence, record.ft_sequence, record.status, *np.round(wrench, 9).tolist()


def rft(told: str) -> Any:
    (payload,) = RobotousSerialDecoder().feed(bytes.fromhex(told))
    record = robotous.decode(payload)
    assert isinstance(record, robotous.RobotousData)
    scale = robotous.scale_of("RFT40-SA01")
    return *np.round(scale.wrench(record.counts), 9).tolist(), record.overload


def rokubi(told: str) -> Any:
    (frame,) = bota.BotaDecoder().feed(bytes.fromhex(told))
    wrench = np.round(frame.wrench, 6).tolist()
    return frame.status, *wrench, frame.device_time_us, frame.temperature_c


def kms(told: str) -> Any:
    return kms40.parse_line(told.encode("ascii"))


GOOD, ABSENT = WordKind.GOOD, WordKind.ABSENT

RECEIVED: dict[str, tuple[Callable[[str], Any], str, Any]] = {
    "2.1 PAC of three fingers": (slot, "80 7F C1 7F C1 7F C1", (0, [2040] * 3, [GOOD] * 3)),
    "2.1 the second absent": (
        slot, "80 7F C1 00 00 7F C1", (0, [2040, 0, 2040], [GOOD, ABSENT, GOOD]),
    ),
    "3.1 data": (
        kms,
        "F={1.5,-0.25,1.0,0.02,-0.01,0.005},4711",
        kms40.KmsForceLine((1.5, -0.25, 1.0), (0.02, -0.01, 0.005), 4711),
    ),
    "3.1 refusal": (kms, "ERROR(14)", kms40.KmsRefusal(14, "unknown command")),
    "3.2 record": (
        rdt,
        "00000001 00001B58 00000000 0016E360 FFFC2F70 000F4240 00004E20 FFFFD8F0 00001388",
        (1, 7000, 0, 1.5, -0.25, 1.0, 0.02, -0.01, 0.005),
    ),
    "3.5 data": (
        rft,
        "55 0B 01F4 FF06 03E8 00C8 FF9C 0032 00 00 00 85 AA",
        (10.0, -5.0, 20.0, 0.1, -0.05, 0.025, 0),
    ),
    "3.6 frame": (
        rokubi,
        "AA 0000 0000803F 00000040 00004040 CDCCCC3D CDCC4C3E 9A99993E 40E20100 0000CC41 7235",
        (0, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 123456, 25.5),
    ),
}  # fmt: skip
"""Section and name: what reads it, the bytes, and what they mean."""


@pytest.mark.parametrize("name", RECEIVED)
def test_what_is_received(name: str) -> None:
    read, told, meaning = RECEIVED[name]
    assert read(told) == meaning


def test_checksum_of_the_bridge() -> None:
    assert crc16_x25(b"123456789") == 0x906E  # section 2.6


def _hex_of_page(page: str) -> Iterable[str]:
    """Byte strings in the chapters on what is implemented, at least six bytes long."""
    chapters = page[page.index("### 2.1") : page.index("### 3.4")]
    chapters += page[page.index("### 3.5") : page.index("### 3.7")]
    for code in re.findall(r"`([^`]+)`", chapters):
        digits = re.sub(r"\s", "", code)
        if re.fullmatch(r"(?:[0-9A-F]{2}){6,}", digits):
            yield digits


def test_no_vector_of_the_page_is_missing(root: Path) -> None:
    page = root.parent / "shared" / "reference" / "hardware-protocols.md"
    if not page.is_file():
        pytest.skip("the hardware reference is not beside the project")
    known = {re.sub(r"\s", "", told).upper() for _, told in SENT.values()}
    known |= {re.sub(r"\s", "", told).upper() for _, told, _ in RECEIVED.values()}
    of_page = set(_hex_of_page(page.read_text(encoding="utf-8")))
    assert len(of_page) >= 10
    assert of_page <= known
