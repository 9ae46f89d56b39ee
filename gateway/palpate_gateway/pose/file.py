"""Poses of the indenter from recorded poses of a robot: a CSV file, or a palpate record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain, islice
from pathlib import Path

from pydantic import Field

from palpate.bus.topics import POSE
from palpate.errors import RecordingError
from palpate.messages import Origin
from palpate.names import Name
from palpate_gateway.device import Device, DeviceIdentity, DeviceInfo
from palpate_gateway.pose.placement import Placement, PlacementOptions
from palpate_gateway.pose.recorded import RecordedPoses
from palpate_gateway.pose.rows import PoseSource, Row
from palpate_gateway.pose.table import PoseTable
from palpate_gateway.readings import Reading

_BATCH = 64
"""Readings in one answer of ``read``."""


class PoseFileOptions(PlacementOptions):
    """Options of the ``pose_file`` driver.

    Attributes:
        path: A CSV file, or a palpate record ``NAME.mcap``.
        robot: Of a record: which robot; None = the only one.
        start_wall_ns: Wall clock at the first pose [ns since the Unix epoch]; None = as the file
            tells, else not known.
    """

    path: Path
    robot: Name | None = None
    start_wall_ns: int | None = Field(default=None, ge=0, lt=1 << 63)


class PoseFile(Device):
    """A file of robot poses as a finite device; it delivers as fast as it is read."""

    options_class = PoseFileOptions

    def __init__(self, options: PoseFileOptions) -> None:
        super().__init__(
            DeviceInfo(
                driver="pose_file",
                sensor_type=None,
                model=f"robot poses {options.path.name}, {options.indenter}",
                rate_hz=POSE.rate_hz,
                live=False,
                finite=True,
                origin=Origin.REPLAYED,
            )
        )
        self._options = options
        self._placement = Placement(options)
        self._source: PoseSource | None = None
        self._rows: Iterator[Row] = iter(())
        self._damage: RecordingError | None = None
        self._counts: Mapping[str, int] = {}
        self._samples = 0

    @property
    def counters(self) -> Mapping[str, int]:
        """Poses that became readings, and those left out, by reason."""
        more = self._counts if self._source is None else self._source.counters
        return {"samples": self._samples, **more}

    def _open(self) -> DeviceIdentity:
        options = self._options
        self._samples, self._damage = 0, None
        self._source = (
            RecordedPoses(options.path, options.robot or "")
            if options.path.suffix == ".mcap"
            else PoseTable(options.path)
        )
        try:
            rows = self._source.rows()
            # The first row has the wall clock; and a file without any good row is not opened.
            self._rows = chain([next(rows)], rows)
        except BaseException:
            self._close()
            raise
        told_ns = self._source.start_wall_ns
        return DeviceIdentity(
            serial=options.robot or options.path.name,
            slot_period_s=1.0 / self.info.rate_hz,
            start_wall_ns=told_ns if options.start_wall_ns is None else options.start_wall_ns,
        )

    def _close(self) -> None:
        source, self._source = self._source, None
        self._rows = iter(())
        if source is not None:
            self._counts = source.counters
            source.close()

    def _read(self, timeout_s: float) -> list[Reading]:
        batch: list[Reading] = []
        try:
            for row in islice(self._rows, _BATCH):
                batch.append(
                    self._placement.reading(
                        row.pose,
                        tick=row.tick,
                        time_s=row.time_s,
                        missed_before=row.missed_before,
                    )
                )
        except RecordingError as error:
            self._damage = error
        if not batch and self._damage is not None:
            damage, self._damage = self._damage, None
            raise damage
        self._samples += len(batch)
        return batch
