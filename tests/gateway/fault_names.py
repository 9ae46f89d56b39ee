"""The counters and errors of the gateway by which each fault must show."""

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
        "failed_checks", "lonely_first", "rejected_parse",
    ),
    "end": ("end_records",),
    "error": ("invalid_samples",),
    "error_word": ("device_error_too_little_sampling_delay",),
    "foreign": ("bad_commands",),
    "high_bits": ("misaligned",),
    "junk": ("junk_bytes", "wrong_lengths"),
    "late": ("late_records", "status_app_took_too_long", "late_poses", "old_numbers", *_SILENCE),
    "long": ("rejected_quaternion",),
    "latched": ("status_monitor_condition_latched",),
    "lost": (
        "lost_slots", "lost_frames", "lost_packets", "lost_samples", "lost_messages", *_SILENCE,
    ),
    "nan": ("bad_numbers", "not_finite", "rejected_non_finite"),
    "overload": ("overloads",),
    "overrun": ("bridge_overruns",),
    "parity": ("parity_errors",),
    "raw": ("status_raw",),
    "repeated": (
        "duplicate_slots", "late", "repeated_packets", "repeated_samples", "repeated_records",
        "repeated_poses", "old_numbers",
    ),
    "restart": _GONE,
    "saturated": ("saturated_samples", "channels_saturated"),
    "short": ("short_slots",),
    "silence": _SILENCE,
    "stopped": ("streams_restarted",),
    "stuck": ("channels_stuck",),
    "unplug": _GONE,
    "wrong_time": ("wrong_times", "late_messages"),
}  # fmt: skip
"""Counters, or classes of errors, of which at least one must show a fault."""

_RDT_OVERLOAD = "status_transducer_saturated_or_converter_fault"

COUNTERS: dict[tuple[str, str], str] = {
    ("biotac_bridge", "crc"): "crc_errors",
    ("biotac_bridge", "cut"): "lost_packets",
    ("biotac_bridge", "error_word"): "device_error_too_little_sampling_delay bridge_error_words",
    ("biotac_bridge", "junk"): "junk_bytes",
    ("biotac_bridge", "lost"): "lost_packets missing_frames",
    ("biotac_bridge", "parity"): "parity_errors bridge_parity_errors",
    ("biotac_bridge", "repeated"): "repeated_packets",
    ("biotac_bridge", "saturated"): "saturated_samples",
    ("biotac_can", "lost"): "lost_slots",
    ("biotac_pic32", "absent"): "absent",
    ("biotac_pic32", "cut"): "realigned",
    ("biotac_pic32", "junk"): "realigned",
    ("biotac_pic32", "lost"): "lost_samples",
    ("biotac_pic32", "repeated"): "repeated_samples",
    ("biotac_pic32", "saturated"): "saturated_samples",
    ("pose_zenoh", "late"): "late_poses",
    ("pose_zenoh", "lost"): "lost_poses",
    ("pose_zenoh", "repeated"): "repeated_poses",
    ("ros_*", "cut"): "rejected_parse",
    ("ros_*", "late"): "old_numbers",
    ("ros_*", "lost"): "lost_messages",
    ("ros_*", "repeated"): "old_numbers",
    ("ros_wrench", "nan"): "not_finite",
    ("wrench_bota", "crc"): "failed_checks lost_samples",
    ("wrench_bota", "cut"): "junk_bytes lost_samples",
    ("wrench_bota", "error"): "status_invalid invalid_samples",
    ("wrench_bota", "junk"): "junk_bytes",
    ("wrench_bota", "late"): "status_app_took_too_long",
    ("wrench_bota", "lost"): "lost_samples",
    ("wrench_bota", "raw"): "status_raw invalid_samples",
    ("wrench_bota", "repeated"): "repeated_samples",
    ("wrench_kms40", "error"):
        "invalid_samples status_calibration_fault status_calibration_not_valid",
    ("wrench_kms40", "nan"): "bad_numbers",
    ("wrench_kms40", "overload"): "overloads status_over_range_fz",
    ("wrench_rdt-*", "cut"): "bad_lengths",
    ("wrench_rdt-*", "junk"): "bad_lengths",
    ("wrench_rdt-*", "late"): "late_records",
    ("wrench_rdt-*", "lost"): "lost_samples",
    ("wrench_rdt-*", "repeated"): "repeated_records",
    ("wrench_rdt-ati_axia", "error"): "invalid_samples status_broken_gage",
    ("wrench_rdt-ati_axia", "overload"): "overloads status_force_or_torque_out_of_range",
    ("wrench_rdt-ati_net_ft", "error"): "invalid_samples status_analogue_board_fault",
    ("wrench_rdt-ati_net_ft", "overload"): f"overloads {_RDT_OVERLOAD}",
    ("wrench_rdt-onrobot_hex", "error"): "invalid_samples status_sensor_not_detected",
    ("wrench_rdt-onrobot_hex", "overload"): "overloads status_overload_on_some_axis",
    ("wrench_robotous-*", "overload"): "overloads status_overload_fx",
    ("wrench_robotous-can", "cut"): "lonely_first",
    ("wrench_robotous-can", "junk"): "wrong_lengths",
    ("wrench_robotous-serial", "crc"): "failed_checks",
    ("wrench_robotous-serial", "cut"): "junk_bytes",
    ("wrench_robotous-serial", "junk"): "junk_bytes",
}  # fmt: skip
"""Counters of a case that must all have counted a fault, besides one of ``NAMES``."""

FORBIDDEN: dict[tuple[str, str], str] = {
    ("wrench_rdt-*", "overload"): "invalid_samples",
    ("wrench_rdt-ati_net_ft", "latched"): "invalid_samples",
}
"""Counters of a case that a fault must not change."""

UNTOLD: dict[tuple[str, str], str] = {
    ("*", "clock_drift"): "not a fault: the time stamps follow the clock",
    ("*wrench*", "stuck"): "a steady load looks the same",
    ("pose_zenoh", "stuck"): "a robot that stands looks the same",
    ("wrench_kms40", "repeated"): "its samples have no number",
    ("wrench_robotous-*", "repeated"): "its samples have no number",
    ("wrench_rdt-*", "deaf"): "it streams and need not hear",
    ("wrench_rdt-onrobot_hex", "latched"): "the product has no thresholds",
}
"""Case and fault to the reason why nothing shows it; the values are correct all the same."""

LASTING: dict[tuple[str, str], str] = {
    ("wrench_rdt-ati_axia", "latched"): "until it is reset in the device its samples are invalid",
    ("wrench_rdt-schunk_ftn", "latched"): "until it is reset in the device its samples are invalid",
}
"""Case and fault to the reason why it does not end by itself."""

SLOW_S = {"stuck": 2.5}
"""Faults that show only after some time [s]."""


def entry_of(table: Mapping[tuple[str, str], str], case: str, fault: str) -> str:
    """The entry of a case and a fault in a table of this module; empty if there is none."""
    for (pattern, name), entry in table.items():
        if name == fault and fnmatch(case, pattern):
            return entry
    return ""


def why_untold(case: str, fault: str) -> str:
    """Reason why nothing can show a fault; empty if something must."""
    return entry_of(UNTOLD, case, fault)


def is_lasting(case: str, fault: str) -> bool:
    """Whether a fault lasts until a user ends it in the device."""
    return (case, fault) in LASTING


def told_by(fault: str, counted: Mapping[str, int], errors: Collection[PalpateError]) -> list[str]:
    """Names that showed a fault; all names for a fault without an entry."""
    told = [*counted, *{type(error).__name__ for error in errors}]
    return [name for name in NAMES.get(fault, told) if name in told]
