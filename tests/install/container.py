"""Inside namespaces: run the station of deploy/containers in the image that the Dockerfile made.

Started by ``tests.install.debian``. Command, variables, user, volumes and health check are those
of compose.yaml; the rest of the image is read-only.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import yaml
from tests.install import image
from tests.install.debian import ROOT

FILES = ROOT / "deploy" / "containers"
PATIENCE_S = 300.0


def main(root: Path, report: Path) -> None:
    """Run it until its health check is content; writes the report."""
    image.enter(root)
    (service,) = yaml.safe_load((FILES / "compose.yaml").read_text("utf-8"))["services"].values()
    user = int(service["user"].partition(":")[0])
    writable = []
    for volume in service["volumes"]:
        source, target, *_ = volume.split(":")
        inside = root / target.strip("/")
        if source.startswith("."):
            inside.parent.mkdir(exist_ok=True)
            shutil.copy(FILES / source, inside)
        else:
            assert inside.stat().st_uid == user, f"{target} is not the image's user's"
            writable.append(inside)
    image.read_only(root, writable)
    variables = {**service["environment"], "PATH": "/opt/palpate/bin:/usr/bin:/bin"}
    log = root / "tmp" / "station.log"
    with open(log, "wb") as output:
        process = subprocess.Popen(
            image.inside(
                root,
                ["palpate", *service["command"]],
                variables,
                user=user,
                folder="/var/lib/palpate",
            ),
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    kind, *check = service["healthcheck"]["test"]
    assert kind == "CMD"
    began_s = time.monotonic()
    try:
        while True:
            health = subprocess.run(
                image.inside(root, check, variables, user=user), capture_output=True, check=False
            )
            if health.returncode == 0:
                break
            if process.poll() is not None or time.monotonic() - began_s > PATIENCE_S:
                sys.stdout.write(log.read_text("utf-8") + health.stdout.decode())
                raise SystemExit("the station in the image does not get healthy")
        healthy_s = time.monotonic() - began_s
        process.send_signal(signal.SIGTERM)
        ended = process.wait(float(service["stop_grace_period"].rstrip("s")))
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert ended == 0, f"it ended with {ended}"
    report.write_text(json.dumps({"healthy_s": round(healthy_s, 1)}), encoding="utf-8")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
