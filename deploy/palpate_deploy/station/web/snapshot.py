"""What the page shows of a station, as JSON: the figures of ``palpate top``, and recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from palpate.census import ROUTER
from palpate_deploy.station.activity import process_activities, sensor_activities
from palpate_deploy.station.observation import ObservedProcess
from palpate_deploy.station.troubles import troubles

RECORDER = "recorder"

_WELL = ("ready", "routes", "finished")

PROCESSES_MOST = 64
"""Processes and sensors that a page shows; names come from other processes, and may be invented."""


def snapshot(
    station: str, observed: Sequence[ObservedProcess], *, router: bool, own: tuple[str, str]
) -> dict[str, Any]:
    """A station as plain values that JSON can carry; what is not known is None.

    Args:
        station: Its name.
        observed: Every process of it.
        router: Whether this process is connected to the station's router.
        own: Service and instance of this process, which is no sign of a station that answers.
    """
    shown = observed[:PROCESSES_MOST]
    ages_s = {one.report.instance: one.age_s for one in shown if one.report.status is not None}
    answering = [
        one
        for one in observed
        if one.report.status is not None and (one.report.service, one.report.instance) != own
    ]
    # The router's own report says only that this process is connected.
    wrong = [
        one
        for one in troubles(one.report for one in observed)
        if (one.service, one.instance) != ROUTER
    ]
    processes = process_activities(observed)
    plain: dict[str, Any] = {
        "station": station,
        "router": router,
        "answers": bool(answering),
        "well": sum(one.state in _WELL for one in processes),
        "left_out": len(observed) - len(shown),
        "sensors": [
            {**asdict(one), "age_s": ages_s.get(one.gateway)}
            for one in sensor_activities(shown)[:PROCESSES_MOST]
        ],
        "processes": [asdict(one) for one in processes[:PROCESSES_MOST]],
        "recordings": [_recording(one) for one in shown if one.report.service == RECORDER],
        "troubles": [asdict(one) for one in wrong[:PROCESSES_MOST]],
    }
    return {key: _finite(value) for key, value in plain.items()}


def as_json(plain: dict[str, Any]) -> bytes:
    """A snapshot as JSON text."""
    return json.dumps(plain, allow_nan=False, separators=(",", ":")).encode()


def _recording(observed: ObservedProcess) -> dict[str, Any]:
    report, status = observed.report, observed.report.status
    gauges = {} if status is None else status.gauges
    return {
        "instance": report.instance,
        "state": "silent" if status is None else status.state.name.lower(),
        "message": "" if status is None else status.message,
        "size_bytes": gauges.get("record_bytes"),
        "kept_bytes": gauges.get("kept_records_bytes"),
        "disk_free_bytes": gauges.get("disk_free_bytes"),
        "bytes_per_s": observed.rates_hz.get("recorded_bytes"),
    }


def _finite(value: Any) -> Any:
    """The same without NaN and infinity, which JSON cannot carry."""
    if isinstance(value, dict):
        return {str(key): _finite(of) for key, of in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(of) for of in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
