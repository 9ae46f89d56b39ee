"""Settings that an ATI or Schunk device serves as ``netftapi2.xml`` (hardware reference 3.2).

They give the counts per unit, in the unit that is set on the device. Often a count is a millionth
of 1 N and 1 N m, but not always: where a tag is missing nothing is assumed.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass

from palpate.errors import DeviceError
from palpate_gateway.protocols.rdt import RdtScale

DOCUMENT_BYTES_MAX = 1 << 20
"""Larger documents are refused unread; real ones have some kilobytes."""

_LBF_N = 4.4482216152605
_KGF_N = 9.80665
_INCH_M = 0.0254
_FOOT_M = 0.3048

FORCE_UNITS_N: dict[str, float] = {
    "n": 1.0, "kn": 1000.0, "lbf": _LBF_N, "klbf": 1000 * _LBF_N, "kgf": _KGF_N,
    "gf": _KGF_N / 1000,
    # Mass units that stand for a force on calibration sheets.
    "lb": _LBF_N, "klb": 1000 * _LBF_N, "kg": _KGF_N, "g": _KGF_N / 1000,
}  # fmt: skip
"""Units of force [N], small letters."""

TORQUE_UNITS_N_M: dict[str, float] = {
    "nm": 1.0, "nmm": 0.001, "knm": 1000.0, "lbfin": _LBF_N * _INCH_M, "lbfft": _LBF_N * _FOOT_M,
    "kgfcm": _KGF_N * 0.01,
    "lbin": _LBF_N * _INCH_M, "lbft": _LBF_N * _FOOT_M, "kgcm": _KGF_N * 0.01,
}  # fmt: skip
"""Units of torque [N m], lower case, without the sign between force and length."""

_JOINTS = re.compile(r"[\s\-.*·_]+")
_NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_NEEDED = ("cfgcpf", "cfgcpt", "scfgfu", "scfgtu")

_BROWSER_REMEDY = (
    "open http://<address>/netftapi2.xml in a browser: it must show the sensor's settings, "
    "or give the counts per N and per N m in the configuration"
)
_UNIT_REMEDY = "choose N and Nm on the device's configuration page"


@dataclass(frozen=True, slots=True)
class NetftSettings:
    """What palpate needs of the device's settings.

    Attributes:
        serial: Serial number of the calibration in use; empty where the device gives none.
        scale: What a count is worth in N and N m.
        sample_rate_hz: Rate at which the device samples [Hz]; None where it does not say.
        rdt_rate_hz: Rate at which it sends records [Hz]; None where it does not say.
    """

    serial: str
    scale: RdtScale
    sample_rate_hz: float | None
    rdt_rate_hz: float | None


def parse_netft_xml(document: bytes) -> NetftSettings:
    """Read ``netftapi2.xml`` as the device's web server sends it.

    Raises:
        DeviceError: It is no such document, or it lacks the counts per unit.
    """
    tags = _tags(document)
    missing = [name for name in _NEEDED if not tags.get(name)]
    if missing:
        raise DeviceError(
            f"netftapi2.xml: nothing in the tags {', '.join(missing)}", remedy=_BROWSER_REMEDY
        )
    return NetftSettings(
        serial=tags.get("cfgcalsn", ""),
        scale=RdtScale(
            counts_per_n=_per_si_unit(tags, "cfgcpf", "scfgfu", FORCE_UNITS_N),
            counts_per_n_m=_per_si_unit(tags, "cfgcpt", "scfgtu", TORQUE_UNITS_N_M),
        ),
        sample_rate_hz=_positive(tags.get("runrate", "")),
        rdt_rate_hz=_positive(tags.get("comrdtrate", "")),
    )


def _tags(document: bytes) -> dict[str, str]:
    """Text of each element by its name; of repeated ones the first."""
    if len(document) > DOCUMENT_BYTES_MAX:
        raise DeviceError(
            f"netftapi2.xml: {len(document)} bytes, more than {DOCUMENT_BYTES_MAX}",
            remedy=_BROWSER_REMEDY,
        )
    # Decoded here and not by the parser, which would follow the encoding that the document names
    # or seems to have (UTF-16 shows by its zero bytes): a document type could hide from the search.
    try:
        text = document.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = document.decode("latin-1")
    if "\0" in text:
        raise DeviceError("netftapi2.xml: not XML: zero bytes", remedy=_BROWSER_REMEDY)
    # Entities are declared in a document type; without one they cannot swell the document.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DeviceError(
            "netftapi2.xml: the document declares a document type, which no sensor does",
            remedy="check that the address is the sensor's",
        )
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise DeviceError(f"netftapi2.xml: not XML: {error}", remedy=_BROWSER_REMEDY) from error
    tags: dict[str, str] = {}
    for element in root.iter():
        tags.setdefault(element.tag.rpartition("}")[2].lower(), (element.text or "").strip())
    return tags


def _per_si_unit(tags: dict[str, str], counts: str, unit: str, units: dict[str, float]) -> float:
    """Counts per newton or newton metre from counts per the device's unit."""
    per_unit = _positive(tags[counts])
    if per_unit is None:
        raise DeviceError(
            f"netftapi2.xml: {counts} is {tags[counts][:40]!r}, not a positive number",
            remedy="load the calibration again on the device's configuration page",
        )
    worth = units.get(_JOINTS.sub("", tags[unit]).lower())
    if worth is None:
        raise DeviceError(
            f"netftapi2.xml: {unit} is the unknown unit {tags[unit][:40]!r}", remedy=_UNIT_REMEDY
        )
    per_si = per_unit / worth
    if not (math.isfinite(per_si) and per_si > 0):
        raise DeviceError(
            f"netftapi2.xml: {tags[counts][:40]} counts per {tags[unit]} is out of range",
            remedy=_UNIT_REMEDY,
        )
    return per_si


def _positive(text: str) -> float | None:
    """A positive finite number, else None."""
    if not _NUMBER.fullmatch(text):
        return None
    value = float(text)
    return value if math.isfinite(value) and value > 0 else None
