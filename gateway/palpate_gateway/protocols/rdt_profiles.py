"""What each product makes of RDT (hardware reference 3.2, 3.3).

All of them start with command 2: command 1 is undefined on the Net F/T (hardware reference 6).
Status words are judged with caution: a bit that is not known to be harmless makes the data invalid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum

from palpate_gateway.protocols.rdt import RdtScale, encode_request


class RdtCommand(IntEnum):
    """Commands that palpate sends; those from 0x81 only OnRobot's converter knows."""

    STOP = 0x0000
    START_REALTIME = 0x0002
    RESET_THRESHOLD_LATCH = 0x0041
    BIAS = 0x0042
    HEX_FILTER = 0x0081
    HEX_PERIOD = 0x0082


HEX_FILTERS_HZ: dict[int, float | None] = {
    0: None, 1: 500.0, 2: 150.0, 3: 50.0, 4: 15.0, 5: 5.0, 6: 1.5,
}  # fmt: skip
"""Cut-off of each filter code [Hz]; None = no filter, 4 is the factory setting."""

HEX_PERIOD_MAX_MS = 255
HEX_CLEAR_BIAS = 0
_HEX_SET_BIAS = 0xFF

_SUMMARY = 1 << 31
_LATCHED = 1 << 16

_SUMMARY_NAME = "error summary"
_LATCHED_NAME = "monitor condition latched"


@dataclass(frozen=True, slots=True)
class RdtProfile:
    """How to talk to one family of devices and read its status word.

    Attributes:
        name: Name in configurations.
        ft_rate_hz: Rate of ``ft_sequence`` [Hz]; None = unknown, to be read or measured.
        scale: What a count is worth; None = must be read from the device.
        status_mask: Bits of the status word that are conditions of the device.
        bit_names: Name of each known bit.
        harmless: Bits that leave the data good.
        overload: Bits that say a range is exceeded: to be published with that flag.
        latch_sets_summary: A latched threshold sets the summary bit as an error does.
        bias_count: Count field of the request that takes the present load as zero.
        clear_bias_count: The same for undoing it; None = the product cannot.
        has_threshold_latch: Whether a latched threshold can be reset.
    """

    name: str
    ft_rate_hz: float | None
    scale: RdtScale | None
    bit_names: Mapping[int, str] = field(repr=False)
    status_mask: int = 0xFFFFFFFF
    harmless: int = _LATCHED
    overload: int = 0
    latch_sets_summary: bool = False
    bias_count: int = 0
    clear_bias_count: int | None = None
    has_threshold_latch: bool = True

    def start_request(self, count: int = 0) -> bytes:
        """Start sending; a repeated start begins to count from 1 again.

        Args:
            count: Records to send, 0 = without end.

        Raises:
            ValueError: The count does not fit 32 bits.
        """
        return encode_request(RdtCommand.START_REALTIME, count)

    def stop_request(self) -> bytes:
        """Stop sending."""
        return encode_request(RdtCommand.STOP)

    def bias_request(self) -> bytes:
        """Take the present load as zero, in the device."""
        return encode_request(RdtCommand.BIAS, self.bias_count)

    def clear_bias_request(self) -> bytes:
        """Undo the bias.

        Raises:
            ValueError: The product has no such command.
        """
        if self.clear_bias_count is None:
            raise ValueError(f"{self.name} cannot clear its bias by RDT")
        return encode_request(RdtCommand.BIAS, self.clear_bias_count)

    def reset_latch_request(self) -> bytes:
        """Release a latched threshold.

        Raises:
            ValueError: The product has no such command.
        """
        if not self.has_threshold_latch:
            raise ValueError(f"{self.name} has no thresholds that latch")
        return encode_request(RdtCommand.RESET_THRESHOLD_LATCH)

    def status_names(self, status: int) -> tuple[str, ...]:
        """What the set bits mean, highest first; ``bit 9`` where the reference has no name."""
        word = status & self.status_mask
        bits = [bit for bit in reversed(range(32)) if word >> bit & 1]
        return tuple(dict.fromkeys(self.bit_names.get(bit, f"bit {bit}") for bit in bits))

    def valid(self, status: int) -> bool:
        """Whether a record with this status word holds data that can be trusted."""
        word = status & self.status_mask
        if self.latch_sets_summary and word & _LATCHED:
            word &= ~_SUMMARY
        return not word & ~self.harmless

    def overloaded(self, status: int) -> bool:
        """Whether the device says that the range of some axis is exceeded."""
        return bool(status & self.overload)


NET_FT = RdtProfile(
    name="ati_net_ft",
    ft_rate_hz=7000.0,
    scale=None,
    bit_names={
        31: _SUMMARY_NAME,
        30: "CPU or RAM fault",
        29: "digital board fault",
        28: "analogue board fault",
        27: "serial link to transducer fault",
        26: "program memory fault",
        25: "halted by configuration",
        24: "settings fault",
        23: "calibration incompatible",
        22: "network fault",
        21: "CAN fault",
        20: "RDT fault",
        19: "EtherNet/IP fault",
        18: "DeviceNet fault",
        17: "transducer saturated or converter fault",
        16: _LATCHED_NAME,
        14: "watchdog fault",
        1: "HTTP fault",
    },
    overload=1 << 17,
    # 0x80010000: a threshold latched and the data is good.
    latch_sets_summary=True,
)
"""ATI Net F/T; its counter runs at the rate of its converter, whatever the RDT rate."""

AXIA = RdtProfile(
    name="ati_axia",
    # It counts samples of the converter, whose rate is a setting of the device.
    ft_rate_hz=None,
    scale=None,
    bit_names={
        31: _SUMMARY_NAME,
        30: "force or torque out of range",
        29: "calibration checksum wrong",
        28: "simulated error",
        27: "gage out of range",
        16: _LATCHED_NAME,
        7: "calibration not accessible",
        5: "other error",
        3: "busy",
        2: "broken gage",
        1: "supply voltage out of range",
        0: "temperature out of range",
    },
    overload=1 << 30 | 1 << 27,
)
"""ATI Ethernet Axia."""

SCHUNK_FTN = replace(AXIA, name="schunk_ftn")
"""Schunk FTN-AXIA: an Axia by another name."""

HEX = RdtProfile(
    name="onrobot_hex",
    ft_rate_hz=1000.0,
    scale=RdtScale(counts_per_n=10_000.0, counts_per_n_m=100_000.0),
    # Bits 0..2 are a number, the upper half says nothing.
    status_mask=0xFFF8,
    bit_names={
        # The sources disagree which bit is which axis (hardware reference 6).
        **dict.fromkeys(range(4, 10), "overload on some axis"),
        3: "several sensors",
        10: "sensor not detected",
        11: "sensor failed",
        12: "sensor temperature",
        13: "converter: DAQ error",
        14: "converter: communication error",
        15: "converter: unknown error",
    },
    harmless=1 << 3,
    overload=0x3F << 4,
    bias_count=_HEX_SET_BIAS,
    clear_bias_count=HEX_CLEAR_BIAS,
    has_threshold_latch=False,
)
"""OnRobot HEX or OptoForce with the Ethernet converter; its counter counts milliseconds."""

PROFILES: dict[str, RdtProfile] = {
    profile.name: profile for profile in (NET_FT, AXIA, SCHUNK_FTN, HEX)
}


def hex_sensor_number(status: int) -> int:
    """Which sensor at the converter a HEX record is from, 0..7."""
    return status & 0b111


def hex_filter_request(code: int) -> bytes:
    """Choose the low-pass filter of a HEX.

    Args:
        code: Key of ``HEX_FILTERS_HZ``.

    Raises:
        ValueError: There is no such filter.
    """
    if code not in HEX_FILTERS_HZ:
        raise ValueError(f"filter code {code} is not in 0..{max(HEX_FILTERS_HZ)}")
    return encode_request(RdtCommand.HEX_FILTER, code)


def hex_period_request(period_ms: int) -> bytes:
    """Choose how often a HEX sends; the factory setting is 10 ms.

    Args:
        period_ms: Time from record to record, 1..255 [ms]. The device would take 0 as a stop.

    Raises:
        ValueError: The period is out of range.
    """
    if not 1 <= period_ms <= HEX_PERIOD_MAX_MS:
        raise ValueError(f"period {period_ms} ms is not in 1..{HEX_PERIOD_MAX_MS} ms")
    return encode_request(RdtCommand.HEX_PERIOD, period_ms)
