"""The present load of a sensor as its zero: ``palpate tare``, and guided work with a finger."""

from __future__ import annotations

import threading
import time

import numpy as np
from rich.console import Console

from palpate.bus import Session, endpoints
from palpate.client.estimates import ask_tare, ask_zero
from palpate.config import LinkConfig
from palpate.errors import LinkError, RemoteError, StreamTimeout, printable
from palpate.messages import FloatArray, Tare, WrenchZero

LET_GO_S = 60.0
"""How long is waited until nobody touches a finger [s]."""

_ASK_S = 10.0

_ANSWER_S = 5.0
_FRAMES_MOST_S = 10.0
"""Gateways refuse a request about the frames of more time [s]."""
_SLOWEST_HZ = 10.0


def take_tare(
    link: LinkConfig,
    station: str,
    sensor: str,
    *,
    frames: int,
    anyway: bool = False,
    timeout_s: float | None,
) -> None:
    """Tare a BioTac or zero a force/torque sensor, and print the result.

    ``anyway`` is that of ``Client.tare``; a force/torque sensor does not look at it. Without a
    ``timeout_s`` there is time enough for so many frames of a slow sensor.

    Raises:
        LinkError: There is no router, or no gateway serves that sensor.
        RemoteError: The gateway refuses.
        StreamTimeout: It does not answer in time.
    """
    if timeout_s is None:
        # Twice, for a zero: it is looked at afterwards, over as many readings.
        timeout_s = _ANSWER_S + 2.0 * min(frames / _SLOWEST_HZ, _FRAMES_MOST_S)
    wait_s = timeout_s
    with Session.open(link, station=station) as session:

        def zero() -> None:
            _print_zero(sensor, ask_zero(session, sensor, readings=frames, timeout_s=wait_s))

        # A force/torque sensor has a zero instead of a tare.
        if session.serves(endpoints.ZERO, sensor=sensor):
            zero()
            return
        try:
            tare = ask_tare(session, sensor, frames=frames, timeout_s=wait_s, anyway=anyway)
        except LinkError as not_found:
            try:
                zero()
            except LinkError:
                raise not_found from None
        else:
            _print_tare(sensor, tare)


def tare_at_rest(
    session: Session,
    sensor: str,
    interrupted: threading.Event,
    *,
    again_s: float,
    console: Console,
) -> Tare | None:
    """Tare a finger as soon as nobody touches it; None = interrupted.

    Where no answer came it is asked for again: that it may be tared twice does no harm.

    Args:
        session: An open session.
        sensor: Name of the finger.
        interrupted: Ends the waiting.
        again_s: Time from a refusal, or a question without an answer, to the next one [s].
        console: Gets a line, once, that says why it is not tared yet.

    Raises:
        RemoteError: It is touched for a minute.
        LinkError: Nobody answers for a minute.
        StreamTimeout: As long as that, a gateway is there and does not answer.
    """
    give_up_s = time.monotonic() + LET_GO_S
    told = False
    while not interrupted.is_set():
        try:
            return ask_tare(session, sensor, frames=0, timeout_s=_ASK_S)
        except (LinkError, RemoteError, StreamTimeout) as error:
            if time.monotonic() >= give_up_s:
                raise
            if not told:
                told = True
                line = f"not yet: {printable(error.problem)}; trying for {LET_GO_S:.0f} s"
                console.print(line, markup=False, soft_wrap=True)
            interrupted.wait(again_s)
    return None


def _print_tare(sensor: str, tare: Tare) -> None:
    numbers = " ".join(f"{value:.0f}" for value in tare.electrodes)
    print(f"tared {sensor} ({printable(tare.sensor_serial)}) over {tare.frames_averaged} frames")
    print(f"tare id   {tare.tare_id}")
    print(f"baseline  {numbers} counts")
    print(f"noise     {float(np.median(tare.electrodes_sd)):.2f} counts (median of electrodes)")


def _print_zero(sensor: str, zero: WrenchZero) -> None:
    print(f"zeroed {sensor} ({printable(zero.sensor_serial)}, {printable(zero.device)})")
    print(f"before  {_wrench(zero.force_before, zero.torque_before)}")
    print(f"after   {_wrench(zero.force_after, zero.torque_after)}")
    print(f"means of {zero.readings_averaged} readings each")


def _wrench(force: FloatArray, torque: FloatArray) -> str:
    newtons = " ".join(f"{value:+.3f}" for value in force)
    return f"{newtons} N  " + " ".join(f"{value:+.4f}" for value in torque) + " N m"
