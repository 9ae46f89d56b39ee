"""By which name each fault must show: a counter or an error of the gateway."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from fnmatch import fnmatch

from palpate.errors import PalpateError

_SILENCE = ("silences", "DeviceLost")
_GONE = ("DeviceLost", "silences", "lost_frames")

NAMES: dict[str, tuple[str, ...]] = {
    "absent": ("absent",),
    "bus_error": ("error_frames",),
    "busoff": ("error_frames",),
    "crc": ("crc_errors", "failed_checks"),
    "cut": (
        "cobs_errors", "lost_packets", "misaligned", "malformed_lines", "bad_lengths",
        "failed_checks", "lonely_first",
    ),
    "end": ("end_records",),
    "error": ("invalid_samples",),
    "error_word": ("device_error_too_little_sampling_delay",),
    "foreign": ("bad_commands",),
    "high_bits": ("misaligned",),
    "junk": ("junk_bytes", "wrong_lengths"),
    "late": ("late_records", "status_app_took_too_long", "late_poses", *_SILENCE),
    "long": ("rejected_quaternion",),
    "latched": ("status_monitor_condition_latched",),
    "lost": ("lost_slots", "lost_frames", "lost_packets", "lost_samples", *_SILENCE),
    "nan": ("bad_numbers", "not_finite", "rejected_non_finite"),
    "overload": ("overloads",),
    "overrun": ("bridge_overruns",),
    "parity": ("parity_errors",),
    "raw": ("status_raw",),
    "repeated": (
        "duplicate_slots", "late", "repeated_packets", "repeated_samples", "repeated_records",
        "repeated_poses",
    ),
    "restart": _GONE,
    "saturated": ("saturated_samples", "channels_saturated"),
    "short": ("short_slots",),
    "silence": _SILENCE,
    "stopped": ("streams_restarted",),
    "stuck": ("channels_stuck",),
    "unplug": _GONE,
    "wrong_time": ("wrong_times",),
}  # fmt: skip
"""Fault to the counters, or classes of errors, one of which must tell of it."""

UNTOLD: dict[tuple[str, str], str] = {
    ("*", "clock_drift"): "not a fault: the time stamps follow the clock",
    ("wrench_*", "stuck"): "a steady load looks the same",
    ("pose_zenoh", "stuck"): "a robot that stands looks the same",
    ("wrench_kms40", "repeated"): "its samples have no number",
    ("wrench_robotous-*", "repeated"): "its samples have no number",
    ("wrench_rdt-*", "deaf"): "it streams and need not hear",
    ("wrench_rdt-onrobot_hex", "latched"): "the product has no thresholds",
}
"""Case and fault to the reason why nothing tells of it; the values stay right all the same."""

LASTING: dict[tuple[str, str], str] = {
    ("wrench_rdt-ati_axia", "latched"): "until it is reset in the device its samples are invalid",
    ("wrench_rdt-schunk_ftn", "latched"): "until it is reset in the device its samples are invalid",
}
"""Case and fault to the reason why it does not end by itself."""

SLOW_S = {"stuck": 2.5}
"""Faults that show only after some time [s]."""


def why_untold(case: str, fault: str) -> str:
    """Why nothing can tell of a fault; empty if something must."""
    for (pattern, name), why in UNTOLD.items():
        if name == fault and fnmatch(case, pattern):
            return why
    return ""


def is_lasting(case: str, fault: str) -> bool:
    """Whether a fault ends only when somebody ends it in the device."""
    return (case, fault) in LASTING


def told_by(fault: str, counted: Mapping[str, int], errors: Collection[PalpateError]) -> list[str]:
    """Names that told of a fault; of one that is not listed, all that did."""
    told = [*counted, *{type(error).__name__ for error in errors}]
    return [name for name in NAMES.get(fault, told) if name in told]
