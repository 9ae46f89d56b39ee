"""Rerun keeps every name for ever, and the parts of a layout have random ones."""

from __future__ import annotations

from palpate.messages import SensorType
from palpate_services.viewer.layout import record_layout


def test_the_records_of_a_station_share_one_layout() -> None:
    """Each record of its own kept 45 kB; a station that records for months has thousands."""
    first = record_layout({"thumb": SensorType.BIOTAC}, with_fields={"thumb"})
    assert record_layout({"thumb": SensorType.BIOTAC}, with_fields=["thumb"]) is first
    assert record_layout({"thumb": SensorType.BIOTAC}) is not first
    assert record_layout({"index": SensorType.BIOTAC}, with_fields={"index"}) is not first
