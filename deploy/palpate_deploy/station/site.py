"""The router of a station that belongs to a site: it runs, and says whether the site has it."""

from __future__ import annotations

import threading

from palpate.bus import Session, SiteLink, run_router
from palpate.config import LinkConfig
from palpate.errors import ConfigError, LinkError
from palpate.health import Health, HealthReporter
from palpate.messages import ServiceState
from palpate_deploy.station.profile import Profile

_PERIOD_S = 0.5


def run_station_router(profile: Profile, link: LinkConfig, stop: threading.Event) -> None:
    """Run the router of a profile until ``stop`` is set; with a site it has a status of its own.

    Raises:
        LinkError: A port is in use.
    """
    if not profile.router.connect:
        run_router(profile.router.listen, stop, link=link)
        return
    site = SiteLink(profile.router.connect, profile.station)
    told = threading.Thread(target=_tell, args=(site, "router", link, stop), daemon=True)
    told.start()
    try:
        run_router(profile.router.listen, stop, link=link, site=site)
    finally:
        stop.set()
        told.join(5.0)


def _tell(site: SiteLink, instance: str, link: LinkConfig, stop: threading.Event) -> None:
    """Publish the status of the router, as a client of it."""
    own = link.model_copy(update={"direct": False, "wait_for_router_s": 1.0})
    health = Health("router", instance)
    while not stop.is_set():
        try:
            session = Session.open(own, station=site.station)
        except LinkError:
            continue
        except ConfigError:  # certificates that are being renewed
            stop.wait(_PERIOD_S)
            continue
        with session:
            presence = session.presence("router", instance=instance)
            with HealthReporter(session, health):
                presence.ready()
                while not stop.wait(_PERIOD_S):
                    _say(site, health)
                presence.not_ready()
                health.set_state(ServiceState.STOPPING)


def _say(site: SiteLink, health: Health) -> None:
    health.gauge("site_connected", float(site.connected))
    where = ", ".join(site.connect)
    if site.refusal is not None:
        health.fail(site.refusal)
    elif site.connected:
        health.set_state(ServiceState.READY, f"connected to the site at {where}")
    else:  # the station itself works
        health.set_state(ServiceState.READY, f"the site at {where} is not reached")
