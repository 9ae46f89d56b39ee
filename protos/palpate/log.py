"""What a log line tells of the frame that it concerns.

Fields, not words: with ``--log-format json`` they are keys of the line, so that a frame is found in
the logs of all processes by its sensor and sequence. Never a line for each frame: what happens on
every frame is a counter of ``Health``.
"""

from __future__ import annotations

from palpate.messages import NO_TARE, Stamp


def about(
    sensor: str, stamp: Stamp | None = None, *, tare_id: int = NO_TARE, model: str = ""
) -> dict[str, object]:
    """Fields for ``extra`` of a log call; what is not known is left out.

    ``sequence``, ``device_tick`` and ``origin`` are those of the frame's ``stamp``; ``tare_id`` is
    in hexadecimal, because JSON has no integers of 64 bits; ``model`` is ``name:version``.
    """
    fields: dict[str, object] = {"sensor": sensor}
    if stamp is not None:
        fields |= {
            "sequence": stamp.sequence,
            "device_tick": stamp.device_tick,
            "origin": stamp.origin.name.lower(),
        }
    if tare_id != NO_TARE:
        fields["tare_id"] = f"{tare_id:016x}"
    if model:
        fields["model"] = model
    return fields
