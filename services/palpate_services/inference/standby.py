"""One service publishes the estimates of a sensor; others of its kind stand by, warm.

A standby has its model loaded and takes the same frames, but publishes nothing. It takes over when
the claim of the active one is gone: at once after a crash, after the lease of the link when that
process or its host stands still or is cut off. Of two that published while neither could see the
other, the one that began later becomes the standby again.
"""

from __future__ import annotations

from palpate.bus import SensorClaims, Session
from palpate.bus.topics import SensorClaim, duty_root
from palpate.errors import ReplicaDiffers
from palpate.health import Health
from palpate_services.inference.model import Runtime
from palpate_services.inference.served import ServedModels, show


class Duty:
    """Which sensors this service publishes for. Use from one thread.

    Args:
        session: The bus.
        topic: Name of the topic of its estimates.
        health: Says for which sensors it stands by, and where the active one has another bundle.
        models: The bundles of this service; told for which sensors it stands by.
        lease_s: After such a silence others see this process as gone [s].
    """

    def __init__(
        self,
        session: Session,
        topic: str,
        health: Health,
        models: ServedModels,
        *,
        lease_s: float,
    ) -> None:
        self._health, self._models = health, models
        self._claims: SensorClaims = session.claims(
            instance=health.instance,
            lease_s=lease_s,
            root=duty_root(topic),
        )
        self._bundles: dict[str, Runtime] = {}
        self._differed = False

    def take(self, sensor: str, runtime: Runtime) -> None:
        """Claim a sensor, whose bundle is ``runtime``, if it is not claimed yet."""
        if self._bundles.get(sensor) is runtime:
            return
        self._claims.want(sensor, runtime.sha256.hex())
        self._claims.name_serial(sensor, runtime.sha256.hex())
        self._bundles[sensor] = runtime

    def holds(self, sensor: str) -> bool:
        """Whether the estimates of a sensor that was taken may be published now."""
        return self._claims.may_begin(sensor)

    def release(self, sensor: str) -> None:
        """A sensor is gone."""
        if self._bundles.pop(sensor, None) is not None:
            self._claims.release(sensor)

    def report(self) -> None:
        """Say in the status for which sensors it stands by; call it once a second.

        A standby with another bundle than the active service is DEGRADED: what it publishes after
        a failure would not be what came before.
        """
        rivals = [
            (sensor, rival)
            for sensor in sorted(self._bundles)
            if (rival := self._claims.rival(sensor)) is not None
        ]
        self._health.gauge("standby_sensors", float(len(rivals)))
        differing = [
            _differs(sensor, rival, self._bundles[sensor])
            for sensor, rival in rivals
            if rival.held and rival.serial not in ("", self._bundles[sensor].sha256.hex())
        ]
        message = ""
        if rivals:
            sensor, rival = rivals[0]
            more = f" and {len(rivals) - 1} more" if len(rivals) > 1 else ""
            message = f"standby for {sensor}{more}: {rival.instance} on {rival.host} publishes"
        different = message != self._models.standby
        self._models.standby = message
        if differing:
            self._health.fail(differing[0])
        elif different or self._differed:
            show(self._models, self._health)
        self._differed = bool(differing)

    def close(self) -> None:
        """Withdraw all claims, so that a standby takes over at once."""
        self._claims.close()


def _differs(sensor: str, rival: SensorClaim, runtime: Runtime) -> ReplicaDiffers:
    return ReplicaDiffers(
        f"standby for {sensor!r} has the bundle {runtime.label} ({runtime.sha256.hex()[:12]}), and "
        f"{rival.instance!r} on {rival.host}, which publishes, has {rival.serial[:12]}",
        remedy=f"load the same bundle into both: palpate model load NAME --sensor {sensor}; every "
        "estimate names its bundle",
    )
