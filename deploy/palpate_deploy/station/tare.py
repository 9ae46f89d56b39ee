"""``palpate tare``: the present load of a sensor as its zero."""

from __future__ import annotations

import numpy as np

from palpate.bus import Session, endpoints
from palpate.client.estimates import ask_tare, ask_zero
from palpate.config import LinkConfig
from palpate.errors import LinkError, printable
from palpate.messages import FloatArray, Tare, WrenchZero


def take_tare(
    link: LinkConfig, station: str, sensor: str, *, frames: int, timeout_s: float
) -> None:
    """Tare a BioTac or zero a force/torque sensor, and print the result.

    Raises:
        LinkError: There is no router, or no gateway serves that sensor.
        RemoteError: The gateway refuses.
        StreamTimeout: It does not answer in time.
    """
    with Session.open(link, station=station) as session:
        # A force/torque sensor has a zero instead of a tare.
        if session.serves(endpoints.ZERO, sensor=sensor):
            _print_zero(sensor, ask_zero(session, sensor, readings=frames, timeout_s=timeout_s))
            return
        try:
            tare = ask_tare(session, sensor, frames=frames, timeout_s=timeout_s)
        except LinkError as not_found:
            try:
                zero = ask_zero(session, sensor, readings=frames, timeout_s=timeout_s)
            except LinkError:
                raise not_found from None
            _print_zero(sensor, zero)
        else:
            _print_tare(sensor, tare)


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
