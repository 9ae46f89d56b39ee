"""The key under which a sensor publishes: one gateway in the station, and in it one source."""

from __future__ import annotations

import threading
from collections.abc import Callable

from palpate.bus import SensorClaims
from palpate.errors import ClaimedElsewhere, ConfigError
from palpate.process import Closing
from palpate_gateway.config import SensorConfig

_POLL_S = 0.1


class SensorKey:
    """A key that nobody else publishes under."""

    patience_s = 0.0
    """How long ``check`` may wait for others [s]."""

    def wait(self, stop: threading.Event, refused: Callable[[ClaimedElsewhere], None]) -> bool:
        """Wait until this gateway may publish; ``refused`` is called as long as another one does.

        Returns:
            Whether it may; False = ``stop`` was set.
        """
        return not stop.is_set()

    def opened(self, serial: str) -> None:
        """The sensor was opened, and this is its serial number."""

    def check(self, stream: str) -> None:
        """Before each message of a stream: whether it may still be published."""


class ClaimedKey(SensorKey):
    """A key that this gateway claims, and that its sensors share where one is ``of`` another.

    Args:
        claims: The gateway's claims.
        sensor: The sensor that publishes.
        sources: Which sensor publishes a stream of a key, by both; shared by all sensors.
    """

    def __init__(
        self, claims: SensorClaims, sensor: SensorConfig, sources: dict[tuple[str, str], str]
    ) -> None:
        self._claims, self._sensor, self._sources = claims, sensor, sources
        self._name = sensor.key_name
        self.patience_s = claims.lease_s
        self._declare: Callable[[], Closing] | None = None
        self._queryable: Closing | None = None
        claims.want(self._name)

    def answer_by(self, declare: Callable[[], Closing]) -> None:
        """Answer questions to the sensor by what ``declare`` makes, while the key is held.

        A question goes to one of those that answer: it must not be the one that waits.
        """
        self._declare = declare

    def _stop_answering(self) -> None:
        if self._queryable is not None:
            self._queryable.close()
            self._queryable = None

    def wait(self, stop: threading.Event, refused: Callable[[ClaimedElsewhere], None]) -> bool:
        """See ``SensorKey``."""
        while not stop.is_set():
            if self._claims.wait(self._name, _POLL_S):
                if self._queryable is None and self._declare is not None:
                    self._queryable = self._declare()
                return True
            self._stop_answering()
            if (error := self._claims.refusal(self._name)) is not None:
                refused(error)
        return False

    def opened(self, serial: str) -> None:
        """See ``SensorKey``."""
        if self._sensor.of is None:
            self._claims.name_serial(self._name, serial)

    def check(self, stream: str) -> None:
        """Each stream has one source, the finger itself first: two would mix their sequences.

        Raises:
            ClaimedElsewhere: Another gateway has taken the key over.
            ConfigError: Another sensor of this gateway publishes the stream.
        """
        try:
            self._claims.check(self._name)
        except ClaimedElsewhere:
            self._stop_answering()
            raise
        source = self._sources.get((self._name, stream))
        if source == self._sensor.name:
            return
        if source is None or self._sensor.of is None:
            self._sources[self._name, stream] = self._sensor.name
        else:
            raise ConfigError(
                f"{source!r} and {self._sensor.name!r} both publish the {stream} of {self._name!r}",
                remedy="take one of them out of the profile, or leave out `of` of "
                f"{self._sensor.name!r}",
            )
