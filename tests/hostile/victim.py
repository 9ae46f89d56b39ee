"""An honest process that is sent to a router of an attacker: what it hears, and what it logs."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

from palpate.bus import Session
from palpate.bus.refusals import RefusalLog
from palpate.config import LinkConfig, TlsConfig
from palpate.process import Closing

_LIVE_S = 60.0
_READY = "listens"


class Victim(Closing):
    """Listens under ``key``, linked to ``endpoint``, with the certificate in a folder."""

    def __init__(self, certificate: Path, endpoint: str, key: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(certificate), endpoint, key],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        if self._process.stdout.readline().strip() != _READY:
            raise AssertionError(self._process.communicate(timeout=_LIVE_S)[1])

    def end(self) -> tuple[int, list[str]]:
        """End it: how many messages it has heard, and its log."""
        heard, log = self._process.communicate("\n", timeout=_LIVE_S)
        return int(heard.split()[-1]), log.splitlines()

    def close(self) -> None:
        """End it, if it still runs."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()


def _main(certificate: str, endpoint: str, key: str) -> None:
    logging.basicConfig(level=logging.INFO)
    link = LinkConfig(
        connect=(endpoint,), tls=TlsConfig.of_folder(Path(certificate)), wait_for_router_s=_LIVE_S
    )
    heard: list[object] = []
    with RefusalLog(), Session.open(link) as session:
        session._raw.declare_subscriber(key, heard.append)
        sys.stdout.write(f"{_READY}\n")
        sys.stdout.flush()
        sys.stdin.readline()
        router = session.has_router()
    assert router, "it was never linked to the attacker"
    sys.stdout.write(f"{len(heard)}\n")


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).parents[2])
    _main(*sys.argv[1:])
