"""``palpate tare``: the untouched finger is zero."""

from __future__ import annotations

import numpy as np

from palpate.protos.codec import TARE, TARE_REQUEST
from palpate.protos.config import LinkConfig
from palpate.protos.messages import TareRequest
from palpate.protos.session import Session


def take_tare(
    link: LinkConfig, station: str, sensor: str, *, frames: int, timeout_s: float
) -> None:
    """Tare a sensor and print its baseline.

    Raises:
        LinkError: There is no router, or nobody serves that sensor.
        RemoteError: The gateway refuses.
        StreamTimeout: It does not answer in time.
    """
    with Session.open(link, station=station) as session:
        tare = session.query(
            "tare",
            sensor=sensor,
            request=TareRequest(frames=frames),
            request_codec=TARE_REQUEST,
            reply_codec=TARE,
            timeout_s=timeout_s,
        )
    numbers = " ".join(f"{value:.0f}" for value in tare.electrodes)
    print(f"tared {sensor} ({tare.sensor_serial}) over {tare.frames_averaged} frames")
    print(f"tare id   {tare.tare_id}")
    print(f"baseline  {numbers} counts")
    print(f"noise     {float(np.median(tare.electrodes_sd)):.2f} counts (median of electrodes)")
