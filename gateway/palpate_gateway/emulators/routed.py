"""An emulated device that is a program on the bus; without a router's address it runs its own."""

from __future__ import annotations

import socket
import threading
from abc import abstractmethod
from contextlib import suppress
from pathlib import Path
from typing import Any

from palpate.bus import ForeignPublisher, Publisher, Session, run_router
from palpate.config import LinkConfig, joining_link
from palpate.errors import LinkError
from palpate_gateway.emulators.emulator import Emulator

JOIN_S = 5.0
"""Longest time to join the bus [s]."""


class RoutedEmulator(Emulator):
    """Joins the bus at a router: one that runs already, or its own at a loopback port.

    Args:
        rate_hz: Its messages each second [Hz].
        connect: Endpoint of the router; empty = its own.
        port: Of its own; 0 = any free one.
        tls: Folder of certificates for the router; its own has none.
    """

    def __init__(self, rate_hz: float, connect: str, port: int, tls: Path | None) -> None:
        super().__init__(rate_hz)
        self._connect, self._port, self._tls = connect, port, tls if connect else None
        self._router: threading.Thread | None = None
        self._session: Session | None = None
        self._publisher: Publisher[Any] | ForeignPublisher | None = None
        self._away = False

    @property
    def address(self) -> str:
        """Endpoint of the router."""
        return self._connect or f"tcp/127.0.0.1:{self._port}"

    def _link(self) -> LinkConfig:
        """How it joins the bus."""
        return joining_link(self.address, wait_s=JOIN_S, tls=self._tls)

    @abstractmethod
    def _join(self) -> None:
        """Open the session, and what it publishes."""

    def _leave(self) -> None:
        """Close the session."""
        session, self._session, self._publisher = self._session, None, None
        if session is not None:
            session.close()

    def _gone(self) -> bool:
        """Whether its program does not run, or is not on the bus.

        After the fault ``restart``, ``_away`` says that the program has to begin again.
        """
        if self.faulty("restart"):
            self._away = True
            return True
        if self.faulty("unplug"):
            self._leave()
            return True
        if self._publisher is None:
            with suppress(LinkError):  # the router is away, too; it tries again
                self._join()
        return self._publisher is None

    def _listen(self) -> None:
        if not self._connect:
            with socket.create_server(("127.0.0.1", self._port)) as free:
                self._port = free.getsockname()[1]
            arguments = ((self.address,), self._stop)
            self._router = threading.Thread(target=run_router, args=arguments)
            self._router.start()
        try:
            self._join()
        except BaseException:  # a router that still runs would keep the program alive
            self._stop.set()
            self._hang_up()
            raise

    def _hang_up(self) -> None:
        self._leave()
        if self._router is not None:
            self._router.join(JOIN_S)
            self._router = None
