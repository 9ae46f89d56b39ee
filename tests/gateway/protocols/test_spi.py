from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.gateway import spi_words

from palpate.messages import BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT, FrameLayout
from palpate_gateway.protocols import channels, spi

# Every vector of the hardware reference, sections 1.3 and 1.4.
COMMANDS = {
    0: 0x80, 1: 0x83, 2: 0x85, 3: 0x86, 15: 0x9E, 16: 0xA1, 17: 0xA2, 18: 0xA4, 19: 0xA7, 20: 0xA8,
    21: 0xAB, 22: 0xAD, 23: 0xAE, 24: 0xB0, 25: 0xB3, 26: 0xB5, 27: 0xB6, 28: 0xB9, 29: 0xBA,
    30: 0xBC, 31: 0xBF, 32: 0xC1, 33: 0xC2, 34: 0xC4, 35: 0xC7, 36: 0xC8, 37: 0xCB, 38: 0xCD,
    39: 0xCE, 40: 0xD0,
}  # fmt: skip
WORDS = {
    0: "0101", 1: "0108", 31: "01F8", 32: "0201", 1024: "4001", 2040: "7FC1", 2648: "A4C1",
    4095: "FEF8",
}  # fmt: skip

byte = st.integers(0, 255)


@pytest.mark.parametrize(("channel", "command"), COMMANDS.items())
def test_command_vectors(channel: int, command: int) -> None:
    assert spi_words.command_byte(channel) == command
    assert spi.channel_of_command(command) == channel


@pytest.mark.parametrize(("value", "word"), WORDS.items())
def test_word_vectors(value: int, word: str) -> None:
    assert spi_words.encode_word(value) == bytes.fromhex(word)
    decoded = spi_words.decode_word(bytes.fromhex(word))
    assert decoded == spi_words.SpiWord(spi.WordKind.GOOD, value, False, "")


@pytest.mark.parametrize("word", ["0000", "FFFF"])
def test_absent_finger(word: str) -> None:
    assert spi_words.decode_word(bytes.fromhex(word)).kind is spi.WordKind.ABSENT


@pytest.mark.parametrize(
    ("letter", "meaning"),
    [
        ("E", "command parity wrong"),
        ("?", "unknown command"),
        (".", "too little delay"),
        ("-", "too little sampling delay"),
        ("X", "channel not recognised"),
        ("_", "nothing to resend"),
        ("R", "property is read-only"),
        ("W", "write failed"),
    ],
)
def test_error_words_are_named(letter: str, meaning: str) -> None:
    word = spi_words.decode_word(b"\xa5" + letter.encode())
    assert (word.kind, word.value, word.error) == (spi.WordKind.DEVICE_ERROR, 0, meaning)


def test_unnamed_error_word_is_a_bit_error() -> None:
    assert spi_words.decode_word(b"\xa5Z").kind is spi.WordKind.BIT_ERROR


def test_set_low_bits_are_suspicious_not_fatal() -> None:
    word = spi_words.decode_word(bytes((0x01, spi_words.with_odd_parity(0x0E))))
    assert (word.kind, word.value, word.suspicious) == (spi.WordKind.GOOD, 1, True)


def test_channel_names() -> None:
    assert channels.channel_name(17) == "E1"
    assert channels.channel_name(40) == "E24"
    assert channels.channel_name(50) == "channel 50"
    assert [BIOTAC_LAYOUT.bit_name(b) for b in (0, 18, 19, 20, 21, 22, 43)] == [
        "E1", "E19", "PDC", "TAC", "TDC", "PAC[0]", "PAC[21]",
    ]  # fmt: skip


@pytest.mark.parametrize("layout", [BIOTAC_LAYOUT, BIOTAC_SP_LAYOUT])
def test_rounds(layout: FrameLayout) -> None:
    """Hardware reference 1.7: PAC beside each of the electrodes, PDC, TAC and TDC."""
    last = 16 + layout.electrodes
    assert channels.channels_of(layout) == (*range(17, last + 1), 1, 2, 3)
    e1_first = channels.interleaved(layout, pac_first=False)
    assert e1_first[:4] == (17, 0, 18, 0)
    assert e1_first[-8:] == (last, 0, 1, 0, 2, 0, 3, 0)
    assert channels.interleaved(layout, pac_first=True) == (0, *e1_first[:-1])
    assert len(e1_first) == layout.slots
    assert e1_first.count(channels.PAC) == layout.pac_samples


def test_frame_rates() -> None:
    assert channels.frame_rate_hz(BIOTAC_LAYOUT) == 100.0
    assert channels.frame_rate_hz(BIOTAC_SP_LAYOUT) == pytest.approx(81.48, abs=0.01)
    assert channels.frame_rate_hz(BIOTAC_LAYOUT, 3000.0) == pytest.approx(68.2, abs=0.05)


@pytest.mark.parametrize("channel", [-1, 64])
def test_command_out_of_range(channel: int) -> None:
    with pytest.raises(ValueError, match=r"not in 0\.\.63"):
        spi_words.command_byte(channel)


@pytest.mark.parametrize("value", [-1, 4096])
def test_value_out_of_range(value: int) -> None:
    with pytest.raises(ValueError, match="4095"):
        spi_words.encode_word(value)


@given(st.integers(0, 63), st.integers(0, 7))
def test_commands_survive_and_flips_show(channel: int, bit: int) -> None:
    command = spi_words.command_byte(channel)
    assert spi.channel_of_command(command) == channel
    assert spi.channel_of_command(command ^ 1 << bit) is None


@given(st.integers(0, 4095), st.integers(0, 15))
def test_any_flipped_bit_is_detected(value: int, bit: int) -> None:
    word = int.from_bytes(spi_words.encode_word(value), "big")
    assert spi_words.decode_word(word.to_bytes(2, "big")).value == value
    flipped = spi_words.decode_word((word ^ 1 << bit).to_bytes(2, "big"))
    assert flipped.kind is not spi.WordKind.GOOD


@given(st.lists(st.tuples(byte, byte), max_size=64))
def test_vectorised_agrees_and_never_raises(words: list[tuple[int, int]]) -> None:
    many = spi.decode_words(np.array(words, np.uint8).reshape(-1, 2))
    single = [spi_words.decode_word(bytes(word)) for word in words]
    assert many.kind.tolist() == [int(word.kind) for word in single]
    assert many.value.tolist() == [word.value for word in single]
    assert many.suspicious.tolist() == [word.suspicious for word in single]


def test_vectorised_agrees_on_every_word() -> None:
    every = np.arange(1 << 16, dtype=">u2").view(np.uint8).reshape(-1, 2)
    many = spi.decode_words(every)
    good = np.bitwise_count(every) % 2 == 1
    assert ((many.kind == spi.WordKind.GOOD) == good.all(axis=1)).all()
    assert (many.kind == spi.WordKind.ABSENT).sum() == 2
    assert (many.kind == spi.WordKind.DEVICE_ERROR).sum() == len(spi.ERROR_WORDS)
    assert np.unique(many.value[many.kind == spi.WordKind.GOOD]).tolist() == list(range(4096))


@given(st.binary(max_size=24))
def test_serial_is_cut_at_the_first_stray_byte(raw: bytes) -> None:
    text = spi.printable_prefix(raw)
    assert text.isprintable()
    assert spi.printable_prefix(b"BT12" + b"\x00" + raw) == "BT12"
