"""Recovery of a record whose writer was killed."""

from __future__ import annotations

import fcntl
import itertools
from pathlib import Path

from palpate.errors import RecordingError
from palpate.files.record.reading import metadata_of, read_record
from palpate.files.record.writing import RecordWriter


def is_being_written(part: Path) -> bool:
    """Whether the writer of a part is alive: it holds a lock, which ends with its process.

    Raises:
        RecordingError: The part cannot be opened.
    """
    try:
        with open(part, "rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
    except OSError as error:
        raise RecordingError(
            f"{part} cannot be opened: {error.strerror or error}", remedy="check the path"
        ) from error
    return False


def recover(part: Path) -> Path:
    """Rewrite the whole messages of a cut-off record as ``NAME.recovered.mcap``; remove the part.

    Raises:
        RecordingError: It is still being written, or nothing in it can be read.
    """
    if is_being_written(part):
        raise RecordingError(
            f"{part} is being written", remedy="stop its recorder first; it closes the record"
        )
    name = part.name.removesuffix(".part").removesuffix(".mcap")
    target = part.with_name(f"{name}.recovered.mcap")
    facts = {**metadata_of(part), "recovered_from": part.name}
    items = read_record(part, allow_partial=True)
    first = next(items, None)
    if first is None:
        raise RecordingError(
            f"{part} holds no whole message", remedy="there is nothing to recover; delete it"
        )
    with RecordWriter(target, facts) as writer:
        for item in itertools.chain((first,), items):
            writer.write(
                item.key,
                item.schema,
                item.payload,
                log_time_ns=item.log_time_ns,
                publish_time_ns=item.publish_time_ns,
                sequence=item.sequence,
            )
    part.unlink()
    return target
