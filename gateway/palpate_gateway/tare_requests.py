"""Answers to those who ask a sensor to be tared; from any thread."""

from __future__ import annotations

from concurrent.futures import Future
from typing import TypeVar

from palpate.errors import DeviceError, ErrorCode, PalpateError, RemoteError
from palpate.messages import NO_TARE, Tare, TareRequest, WrenchZero, WrenchZeroRequest
from palpate_gateway.worker import SensorWorker

A = TypeVar("A")

_REMEDY = "look at palpate status; tare when it is back"


def answer_tare(worker: SensorWorker, request: TareRequest) -> Tare:
    """Look a tare up, or tare with the next frames.

    Raises:
        RemoteError: The id is not known (NOT_FOUND), or the sensor did not deliver in time.
        DeviceError: The sensor does not deliver, is touched, or a channel is invalid.
    """
    if request.tare_id != NO_TARE:
        return worker.pipeline.ledger.find(request.tare_id)
    _check_serving(worker)
    frames = request.frames or worker.pipeline.tare_frames
    wait_s = 2.0 + 2.0 * frames / worker.device.info.rate_hz
    future = worker.pipeline.ask_tare(request.frames)
    return _answer(worker, future, f"{frames} good frames", wait_s)


def answer_zero(worker: SensorWorker, request: WrenchZeroRequest) -> WrenchZero:
    """Take the load of a force/torque sensor as zero.

    Raises:
        DeviceError: The sensor does not deliver, is moved or overloaded, or refuses.
        RemoteError: It did not deliver in time.
    """
    zeroing = worker.zeroing
    assert zeroing is not None, "only a force/torque sensor is asked"
    _check_serving(worker)
    count = zeroing.count(request.readings)
    wait_s = 10.0 + 4.0 * count / worker.device.info.rate_hz
    what = f"{count} readings before and after its zero"
    return _answer(worker, zeroing.ask(count), what, wait_s)


def _check_serving(worker: SensorWorker) -> None:
    if not worker.serving:
        raise DeviceError(f"sensor {worker.name!r} does not deliver at present", remedy=_REMEDY)


def _answer(worker: SensorWorker, future: Future[A], what: str, wait_s: float) -> A:
    try:
        return future.result(timeout=wait_s)
    except TimeoutError as error:
        if isinstance(error, PalpateError):
            raise
        future.cancel()
        raise RemoteError(
            f"sensor {worker.name!r} did not deliver {what} within {wait_s:.1f} s",
            remedy=_REMEDY,
            code=ErrorCode.DEADLINE_EXCEEDED,
            retry_after_s=1.0,
        ) from error
