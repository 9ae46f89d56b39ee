"""Changing what the estimating services of a station serve, with the station's admin token."""

from __future__ import annotations

import time

from palpate.admin import new_nonce, signed
from palpate.bus import Session, endpoints
from palpate.errors import LinkError, PalpateError
from palpate.messages import ModelAction, ModelCommand, ModelInventory

LOAD_S = 60.0
"""How long a bundle may take until it serves [s]; the trial of a foreign one needs seconds."""

LIST_S = 2.0


class ModelAdmin:
    """Commands about the models of a station; ``token`` is its admin token.

    Every method names the ``service`` it is for: ``features``, ``field`` or ``synthesis``. It
    returns what each of the service's processes serves afterwards, and raises:

    Raises:
        LinkError: No such service runs.
        StreamTimeout: It does not answer in time; whether it obeyed is not known.
        RemoteError: It refuses; ``PERMISSION_DENIED`` if the token is not the station's.
    """

    def __init__(self, session: Session, token: bytes) -> None:
        self._session = session
        self._token = token

    def served(self, service: str) -> tuple[ModelInventory, ...]:
        """What serves, and what could."""
        return self._order(service, ModelAction.LIST, timeout_s=LIST_S)

    def load(self, service: str, bundle: str, *, sensor: str = "") -> tuple[ModelInventory, ...]:
        """Serve a bundle of the station's repository, by ``name`` (newest) or ``name:version``.

        With a ``sensor`` it serves only that one. The bundle from before serves until the new one
        has been checked and has warmed up; no frame is lost.
        """
        return self._order(service, ModelAction.LOAD, bundle=bundle, sensor=sensor)

    def unload(self, service: str, *, sensor: str = "") -> tuple[ModelInventory, ...]:
        """Serve no bundle; a ``sensor`` then has the one of all others again."""
        return self._order(service, ModelAction.UNLOAD, sensor=sensor)

    def roll_back(self, service: str, *, sensor: str = "") -> tuple[ModelInventory, ...]:
        """Serve again what served before the last change; a second time undoes the first."""
        return self._order(service, ModelAction.ROLL_BACK, sensor=sensor)

    def _order(
        self,
        service: str,
        action: ModelAction,
        *,
        bundle: str = "",
        sensor: str = "",
        timeout_s: float = LOAD_S,
    ) -> tuple[ModelInventory, ...]:
        command = ModelCommand(
            action,
            self._session.station,
            service,
            new_nonce(),
            time.time_ns(),
            bundle=bundle,
            sensor=sensor,
        )
        answers = self._session.query_all(
            endpoints.MODELS, signed(command, self._token), service=service, timeout_s=timeout_s
        )
        if not answers:
            raise LinkError(
                f"no service {service!r} answers at station {self._session.station!r}",
                remedy="start it: palpate up; see what runs: palpate status; with certificates, "
                "only those of an operator may ask",
            )
        obeyed = []
        for answer in answers:
            if isinstance(answer, PalpateError):
                raise answer
            obeyed.append(answer)
        return tuple(obeyed)
