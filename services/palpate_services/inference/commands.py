"""The endpoint by which an operator changes what a service serves, if the token permits it."""

from __future__ import annotations

import logging

from palpate.admin import CommandGuard
from palpate.bus import Session, endpoints
from palpate.errors import ErrorCode, PalpateError
from palpate.health import Health
from palpate.messages import ModelAction, ModelInventory, ModelRequest, ServiceState
from palpate_services.inference.served import ServedModels

_log = logging.getLogger(__name__)

_WAITING_MOST = 4


def take_commands(
    session: Session, models: ServedModels, health: Health, token: bytes | None
) -> None:
    """Obey the commands of operators; without a ``token`` none.

    Counted are ``commands_obeyed``, ``commands_denied`` for want of a proof, and
    ``commands_refused`` for any other reason.
    """
    guard = CommandGuard(
        token, station=session.station, service=health.service, instance=health.instance
    )

    def obey(request: ModelRequest) -> ModelInventory:
        try:
            command = guard.admit(request)
            inventory = models.obey(command, health.instance)
        except PalpateError as error:
            if error.code is ErrorCode.PERMISSION_DENIED:
                health.count("commands_denied")  # only: who is denied must not fill the log either
            else:
                health.count("commands_refused")
                _log.warning("command refused: %s", error)
                show(models, health)  # it may have taken effect, and not be remembered
            raise
        health.count("commands_obeyed")
        if command.action is not ModelAction.LIST:
            show(models, health)
        return inventory

    # Two at once: a roll back does not wait for a bundle that loads.
    session.queryable(
        endpoints.MODELS,
        obey,
        service=health.service,
        instance=health.instance,
        capacity=_WAITING_MOST,
        workers=2,
    )


def show(models: ServedModels, health: Health) -> None:
    """Say in the status what serves, and what should and does not."""
    if health.state is ServiceState.STOPPING:
        return
    health.set_state(ServiceState.READY, models.describe())
    if models.problem is not None:
        health.fail(models.problem)
