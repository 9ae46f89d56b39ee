"""Let another network serve one finger, compare it, and roll back: no frame is lost meanwhile.

With a station without hardware:

    palpate up --profile virtual            # in one terminal
    python docs/examples/swap_model.py features-virtual      # in another

Needs the station's admin token, which only its user can read; another file as second argument.
"""

from __future__ import annotations

import sys
from pathlib import Path

from palpate import Client
from palpate.admin import read_token, token_file
from palpate.client.models import ModelAdmin
from palpate.errors import PalpateError
from palpate.process import state_folder


def main(bundle: str, token: Path | None) -> None:
    """A refusal leaves what served before; the text says why."""
    try:
        with Client() as robot:
            secret = read_token(token or token_file(state_folder(), robot.session.station))
            admin = ModelAdmin(robot.session, secret)
            before = robot.features("finger")
            (served,) = admin.load("features", bundle, sensor="finger")
            print(f"finger: {bundle} after {served.change_s:.2f} s")
            serving = next(one for one in served.served if one.sensor == "finger")
            after = robot.features("finger")
            while after.bundle_sha256 != serving.bundle_sha256:  # made before the change
                after = robot.features("finger")
            for name, estimate in (("before", before), ("now", after)):
                print(f"{name:6} {estimate.bundle_sha256.hex()[:12]} {estimate.force} N")
            (served,) = admin.roll_back("features", sensor="finger")
            print(f"rolled back in {served.change_s * 1e3:.2f} ms")
    except PalpateError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]) if sys.argv[2:] else None)
