"""Replay of a vendor text log (SynTouch GUI or Cheetah library), plain or gzip, as a device.

The file is streamed. An error names the line of the damage, and comes after all whole frames before
it. Slots with a bad parity flag make their channel invalid and are counted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydantic import Field

from palpate.config import StrictConfig
from palpate.errors import ConfigError, RecordingError
from palpate.messages import SensorType
from palpate_gateway.biotac.frames import BELIEVABLE_LOSS, FrameAssembler
from palpate_gateway.biotac.slots import UNKNOWN, SlotBlock
from palpate_gateway.device import DeviceIdentity, FileDevice, SerialOption
from palpate_gateway.protocols import channels as ch
from palpate_gateway.readings import ElectrodeReading
from palpate_gateway.recordings.text_log_format import (
    LineBlocks,
    count_columns,
    parse_rows,
    split_header,
)


class TextLogOptions(StrictConfig):
    """Options of the ``text_log`` driver.

    Attributes:
        path: The log, plain or gzip.
        port: Port of the finger, from 1; 0 = the only one with data.
        serial: Serial number to publish; empty = that of the header.
    """

    path: Path
    port: int = Field(default=0, ge=0, le=5)
    serial: SerialOption = ""


_FIRST = -1
"""Instead of a port: the first with data."""


def ports_of(path: Path) -> tuple[int, ...]:
    """Ports of the fingers in a log, from 1: those with data at its beginning.

    Raises:
        RecordingError: The file is no log, or nothing of it can be read.
    """
    return TextLogReader(path, port=_FIRST).ports


class TextLogReader:
    """Slots of one finger of a log.

    Args:
        path: The log.
        port: Port of the finger, from 1; 0 = the only one with data.
        block_bytes: Smallest size of the blocks in which it is read [bytes].

    Raises:
        RecordingError: The file cannot be read, is empty, or is not a log of a BioTac with 19 or 24
            electrodes; or the port has no data.
        ConfigError: Several ports have data and none was chosen.
    """

    def __init__(self, path: Path, *, port: int = 0, block_bytes: int = 1 << 18) -> None:
        self.path = path
        self.damage: RecordingError | None = None
        """Error that ended the rows early; known once ``blocks`` is exhausted."""
        self._lines = LineBlocks(path, block_bytes=block_bytes)
        self._blocks = iter(self._lines)
        first = next(self._blocks, b"") or self._lines.unfinished
        if not first:
            raise self._lines.damage or RecordingError(
                f"{path}: the file is empty", remedy="record or copy the log again"
            )
        self.header, offset = split_header(str(path), first)
        self.slot_period_s = 1.0 / self.header.sample_rate_hz
        """Time between two slots [s]."""
        self._line = 1 + self.header.lines
        rows = first[offset:]
        # The header may fill the first block, and the only row may lack its line end.
        rows = rows or next(self._blocks, b"") or self._lines.unfinished
        if not rows.strip():
            raise self._lines.damage or RecordingError(
                f"{path}: the log has a header and no rows", remedy="record or copy it again"
            )
        self._columns = count_columns(str(path), rows.split(b"\n", 1)[0], self._line)
        self._port_count = (self._columns - 4) // 2
        self._slots_before = 0
        self._frame_before: int | None = None
        self._pending = self._parse(rows) if rows.endswith(b"\n") else self._end()
        if not len(self._pending):
            raise self.damage or RecordingError(
                f"{path}: the log has no rows", remedy="record or copy it again"
            )
        self.timed = len(self._pending) == 1 or bool(self._pending[:, 0].any())
        """Whether the log has times; else they are made from the number of slots."""
        self.ports = self._ports_with_data()
        """Ports of the fingers, those with data at the beginning."""
        self.port = self._choose_port(port)
        self.sensor_type = self._find_type()
        """Kind of sensor, from the sampled channels."""

    def blocks(self) -> Iterator[SlotBlock]:
        """Slots in order; afterwards ``damage`` says whether the log was complete."""
        if len(self._pending):
            yield self._slots(self._pending)
        while self.damage is None:
            data = next(self._blocks, None)
            if data is None:
                break
            table = self._parse(data)
            if len(table):
                yield self._slots(table)
        if self.damage is None:
            table = self._end()
            if len(table):
                yield self._slots(table)

    def _parse(self, data: bytes) -> npt.NDArray[np.float64]:
        rows = parse_rows(str(self.path), data, self._columns, self._line)
        self._line += data.count(b"\n")
        self.damage = rows.damage
        return rows.table

    def _end(self) -> npt.NDArray[np.float64]:
        """The last line if it lacks its line end, and the state of the file's end."""
        nothing = np.empty((0, self._columns))
        rest, self._lines.unfinished = self._lines.unfinished, b""
        self.damage = self._lines.damage
        if self.damage is not None or not rest.strip():
            return nothing
        # The last column has one digit, so a line with all columns is complete.
        if len(rest.split()) == self._columns:
            return self._parse(rest + b"\n")
        shown = rest[:40].decode("latin-1")
        self.damage = RecordingError(
            f"{self.path}, line {self._line}: the last line is cut: {shown!r}",
            remedy="the log is truncated; copy it again from its source (all whole frames before "
            "the cut were delivered)",
        )
        return nothing

    def _slots(self, table: npt.NDArray[np.float64]) -> SlotBlock:
        frame = table[:, 2].astype(np.int64)
        time_s = table[:, 0]
        if not self.timed:
            time_s = self._rebuilt_time(frame)
        column = 4 + 2 * (self.port - 1)
        return SlotBlock(
            channel=table[:, 3].astype(np.int64),
            value=table[:, column].astype(np.uint16),
            good=table[:, column + 1] == 0,
            time_s=time_s,
            batch=table[:, 1].astype(np.int64),
            frame=frame,
            position=np.full(len(table), UNKNOWN, np.int64),
        )

    def _rebuilt_time(self, frame: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Times on the grid of slots, with gaps for frames that are missing by their counter."""
        # A log without times still counts its frames: each missing one leaves a gap of a round.
        before = frame[0] if self._frame_before is None else self._frame_before
        missing = np.diff(frame, prepend=before) - 1
        # As the assembler counts: one damaged number must not move the rest by days.
        missing = np.where((missing > 0) & (missing <= BELIEVABLE_LOSS), missing, 0)
        index = self._slots_before + np.arange(len(frame))
        index = index + self.sensor_type.layout.slots * np.cumsum(missing)
        self._slots_before = int(index[-1]) + 1
        self._frame_before = int(frame[-1])
        return np.asarray(index * self.slot_period_s, np.float64)

    def _ports_with_data(self) -> tuple[int, ...]:
        pending, ports = self._pending, range(1, self._port_count + 1)
        return tuple(port for port in ports if (pending[:, 3 + 2 * port] == 0).any())

    def _choose_port(self, port: int) -> int:
        carrying = ", ".join(map(str, self.ports)) or "none"
        if port > self._port_count:
            raise RecordingError(
                f"{self.path}: the log has no port {port}, it has {self._port_count}",
                remedy=f"ports with data: {carrying}",
            )
        if not self.ports:
            raise RecordingError(
                f"{self.path}: every slot of all {self._port_count} ports has wrong parity",
                remedy="no sensor was connected when this log was recorded; record it again",
            )
        if port > 0 and port not in self.ports:
            raise RecordingError(
                f"{self.path}: every slot of port {port} has wrong parity, so no sensor was there",
                remedy=f"ports with data: {carrying}",
            )
        if not port and len(self.ports) > 1:
            raise ConfigError(
                f"{self.path}: {len(self.ports)} fingers are in this log, at ports {carrying}",
                remedy="make each a sensor of the profile, with its port in the option port; "
                "`palpate replay` plays all of them",
            )
        return port if port > 0 else self.ports[0]

    def _find_type(self) -> SensorType:
        """Kind of sensor by the electrodes in the rows; header and serial number do not tell it.

        The public capture has a serial that starts with BTSP (24 electrodes) and the 19-electrode
        layout, so the layout decides what kind of sensor it is.
        """
        counters = self._pending[:, 1:3]
        frames = 1 + int(np.count_nonzero((np.diff(counters, axis=0) != 0).any(axis=1)))
        seen = {int(c) for c in np.unique(self._pending[:, 3]) if c >= ch.FIRST_ELECTRODE}
        last = max(seen, default=0)
        kind = SensorType.BIOTAC
        if last >= ch.FIRST_ELECTRODE + ch.ELECTRODES:
            kind = SensorType.BIOTAC_SP
        if frames == 1 and len(self._pending) < kind.layout.slots:
            return kind  # the log ends inside its first frame; that error comes later
        wanted = {c for c in ch.channels_of(kind.layout) if c >= ch.FIRST_ELECTRODE}
        if seen == wanted:
            return kind
        absent = ", ".join(ch.channel_name(c) for c in sorted(wanted - seen))
        raise RecordingError(
            f"{self.path}: the log has {len(seen)} electrodes, not {len(wanted)} ({absent} never "
            f"occur in its first {frames} frames)",
            remedy="palpate reads logs of BioTacs sampled with all 19 electrodes, and of BioTacs "
            "SP with all 24; record with the full sequence of 44 or 54 slots",
        )


class TextLog(FileDevice):
    """A vendor text log as a finite device, which delivers as fast as it is read."""

    options_class = TextLogOptions

    def __init__(self, options: TextLogOptions) -> None:
        model = f"vendor text log {options.path.name}"
        rate_hz = ch.frame_rate_hz(SensorType.BIOTAC.layout)
        super().__init__("text_log", SensorType.BIOTAC, model, rate_hz)
        self._options = options
        self._assembler = FrameAssembler(1.0 / ch.SLOT_RATE_HZ)

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the assembler, and parity errors by channel where there are any."""
        by_channel = {
            f"parity_errors_{name.lower().replace(' ', '_')}": count
            for name, count in self._assembler.parity_errors_by_channel.items()
        }
        return self._assembler.counters | by_channel

    def _open(self) -> DeviceIdentity:
        reader = TextLogReader(self._options.path, port=self._options.port)
        self._assembler = FrameAssembler(
            reader.slot_period_s, reader.sensor_type.layout, timed=reader.timed
        )
        self._deliver(self._frames(reader, self._assembler))
        return DeviceIdentity(
            serial=self._options.serial
            or reader.header.serial(reader.port)
            or f"unknown-port{reader.port}",
            slot_period_s=reader.slot_period_s,
            start_wall_ns=reader.header.started_wall_ns,
            sensor_type=reader.sensor_type,
        )

    def _frames(
        self, reader: TextLogReader, assembler: FrameAssembler
    ) -> Iterator[ElectrodeReading]:
        for block in reader.blocks():
            yield from assembler.push(block)
        damage = reader.damage
        if damage is None and assembler.ends_inside_frame:
            damage = RecordingError(
                f"{self._options.path}: the log ends inside a frame, after "
                f"{assembler.pending_slots} slots",
                remedy="the log is truncated; copy it again from its source (all whole frames "
                "before the cut were delivered)",
            )
        if damage is not None:
            assembler.discard_pending()
            raise damage
        yield from assembler.finish()
