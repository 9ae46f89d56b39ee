"""Questions to an estimating service: the stream's function, with an error instead of a counter."""

from __future__ import annotations

from typing import TypeVar

from palpate.errors import ErrorCode, RemoteError
from palpate.health import Health
from palpate_services.estimator import Refusal
from palpate_services.tared import TARE_UNKNOWN

E = TypeVar("E")

_WORDS: dict[str, tuple[ErrorCode, str, str]] = {
    Refusal.UNTARED: (
        ErrorCode.INVALID_REQUEST,
        "the frame was taken before any tare, or with another than its gateway knows",
        "tare the untouched sensor and ask with a later frame: palpate tare",
    ),
    Refusal.INVALID_CHANNELS: (
        ErrorCode.INVALID_REQUEST,
        "at least one electrode of the frame is marked bad",
        "ask with another frame; look at the sensor: palpate status",
    ),
    Refusal.WRONG_SENSOR: (
        ErrorCode.INVALID_REQUEST,
        "the served bundle was made for another type of sensor",
        "serve a bundle for this sensor type",
    ),
    Refusal.WRONG_MESH: (
        ErrorCode.WRONG_CONTRACT,
        "the field is one of another mesh than the served bundle's",
        "serve the bundle of this mesh, or compute the field on the bundle's",
    ),
    Refusal.NON_FINITE: (
        ErrorCode.INTERNAL,
        "the model has no finite answer to this input",
        "serve another bundle; report this one to whoever made it",
    ),
    TARE_UNKNOWN: (
        ErrorCode.NOT_FOUND,
        "nobody knows the tare that the frame names",
        "check the sensor's name and that its gateway runs, or tare and ask with a later frame",
    ),
}


def answered(answer: E | str, health: Health) -> E:
    """The estimate, counted as ``asked``.

    Args:
        answer: The estimate, or the reason why there is none.
        health: Counts questions, and refusals as ``asked_<reason>``.

    Raises:
        RemoteError: There is none; it says why and what to do.
    """
    health.count("asked")
    if not isinstance(answer, str):
        return answer
    health.count(f"asked_{answer}")
    code, problem, remedy = _WORDS[answer]
    raise RemoteError(problem, remedy=remedy, code=code)
