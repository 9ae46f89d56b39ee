"""The record: an MCAP file of raw payloads with their schemas embedded (docs/adr/0006-record.md).

A record that is being written, or whose writer was killed, is named ``NAME.mcap.part``; it becomes
``NAME.mcap`` when it is closed whole. Keys, payload bytes and stamps are kept as they came, so a
replay can be bit-identical.
"""

from palpate.files.record.reading import (
    RecordItem,
    RecordSummary,
    check_readable,
    read_record,
    summarise,
)
from palpate.files.record.recovery import is_being_written, recover
from palpate.files.record.writing import FLUSH_S, RecordWriter, descriptor_set

__all__ = [
    "FLUSH_S",
    "RecordItem",
    "RecordSummary",
    "RecordWriter",
    "check_readable",
    "descriptor_set",
    "is_being_written",
    "read_record",
    "recover",
    "summarise",
]
