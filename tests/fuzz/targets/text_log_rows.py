"""Rows and header of a vendor text log, read at once and line by line."""

from __future__ import annotations

import numpy as np
from tests.fuzz.streams import has_remedy

from palpate.errors import RecordingError
from palpate.messages import COUNTS_MAX
from palpate_gateway.protocols.channels import CHANNEL_NAMES
from palpate_gateway.recordings.text_log_format import (
    LogRows,
    count_columns,
    parse_rows,
    split_header,
)

NAME = "a.log"


def check(data: bytes) -> None:
    """All bytes are the start of a log: header and rows."""
    try:
        header, offset = split_header(NAME, data)
        assert 0 < header.sample_rate_hz < 1e6
        assert header.lines >= 0
        assert all(header.serial(port).isprintable() for port in range(1, 7))
        rows = data[offset:]
    except RecordingError as error:
        has_remedy(error)
        rows = data
    rows = rows[: rows.rfind(b"\n") + 1]
    if not rows:
        return
    try:
        columns = count_columns(NAME, rows.split(b"\n", 1)[0], 1)
    except RecordingError as error:
        has_remedy(error)
        return
    at_once = parse_rows(NAME, rows, columns, 1)
    singly = _line_by_line(rows, columns)
    np.testing.assert_array_equal(at_once.table, singly.table)
    assert str(at_once.damage) == str(singly.damage)
    _check_values(at_once.table, columns)
    lines = [line for line in rows.split(b"\n")[:-1] if line.strip()]
    assert at_once.damage is not None or len(at_once.table) == len(lines)


def _line_by_line(rows: bytes, columns: int) -> LogRows:
    tables = [np.empty((0, columns))]
    for number, line in enumerate(rows.split(b"\n")[:-1], 1):
        one = parse_rows(NAME, line + b"\n", columns, number)
        tables.append(one.table)
        if one.damage is not None:
            return LogRows(np.concatenate(tables), one.damage)
    return LogRows(np.concatenate(tables), None)


def _check_values(table: np.ndarray[tuple[int, ...], np.dtype[np.float64]], columns: int) -> None:
    assert table.shape == (len(table), columns)
    assert np.isfinite(table).all()
    assert np.isin(table[:, 3], list(CHANNEL_NAMES)).all()
    counts = table[:, 4::2]
    assert ((counts >= 0) & (counts <= COUNTS_MAX) & (counts % 1 == 0)).all()
    assert np.isin(table[:, 5::2], (0, 1)).all()
    assert ((table[:, 1:3] >= 0) & (table[:, 1:3] % 1 == 0)).all()


def seeds() -> list[bytes]:
    """Both styles of logs, and damage of every kind."""
    rows = b"".join(
        b"%.6f 3 7 %d 0 1 0 1 %d 0\r\n" % (k / 4400, channel, 2000 + k)
        for k, channel in enumerate((17, 0, 18, 0, 1, 0, 2, 0, 3))
    )
    header = (
        b"DataStructure: 2.0\r\nOperator: N/A\r\nDate: 2020/7/14\r\nTime: 15:38\r\n"
        b"Flex Version: ,, 1.0\r\nSerial Number: ,,BT0123456789ABCD\x00\x10\r\n"
        b"SampStructure: Pac,E1\r\nSampRate: 4400\r\nFramesInBatch: 7\r\n\r\nBegin File\r\n"
    )
    plain = b"0.000000 0 1 17 2000 0\n0.000000 0 1 0 2001 1\n"
    lines = [b"0 0 1 17 5000 0", b"0 0 1 99 5 0", b"nan 0 1 17 5 0", b"0 0 1 17 5", b"x", b"",
             b"-0 0 1e3 17 5 0", b"0  0 1 17 5 1 ", b"0 0 -1 17 5 0", b"0 0 1 17 5 2",
             b"1-2 0 1 0 0 0", b"0 0 1_0 17 5 0", b"0 .5 1 17 5. 0"]  # fmt: skip
    made_up = b"0.0 0 1 17 5 0\n0.1 0 1 0 5 0\r1\n 0 1 18 5 0\n"
    lies = header.replace(b"4400", b"nan"), header.replace(b": 7", b": inf")
    return [
        header + rows,
        rows,
        plain,
        *(plain + line + b"\n" + plain for line in lines),
        *lies,
        made_up,
    ]
