"""Which bundle makes the estimates of which sensor, and changing that while frames come.

A service has one bundle for all sensors, and may have others for single ones. A change is prepared
beside the serving bundles (read, digests, trial, golden vectors, warm-up) and takes effect by
replacing one reference between two frames; the bundle from before stays loaded for a roll back,
until another one needs its room (docs/adr/0020-models.md).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import NoReturn

from palpate.admin import CommandGuard
from palpate.bus import Session, endpoints
from palpate.errors import BundleError, ConfigError, ErrorCode, PalpateError, RemoteError
from palpate.health import Health
from palpate.messages import (
    ModelAction,
    ModelCommand,
    ModelInventory,
    ModelMetadata,
    ModelRequest,
    ServedModel,
    ServiceState,
)
from palpate_services.config import LOADED_MOST, EstimatingConfig
from palpate_services.inference.model import Runtime, load
from palpate_services.inference.remembered import Remembered, RememberedFile
from palpate_services.inference.repository import Repository
from palpate_services.inference.trial import proven

_log = logging.getLogger(__name__)

SENSORS_MOST = 256
"""Sensors with a bundle of their own."""

DEFAULT = ""
"""Stands for all sensors without a bundle of their own."""


@dataclass(frozen=True, slots=True)
class Choice:
    """A bundle that was chosen.

    Attributes:
        source: Finds it in the repository: ``name:version``, or a path.
        sha256: Its digest, 32 bytes.
        runtime: Itself; None = not loaded since this process began, no longer to be had, or its
            room was needed.
    """

    source: str
    sha256: bytes
    runtime: Runtime | None = field(compare=False)


@dataclass(frozen=True, slots=True)
class Assignment:
    """What serves a sensor, and what served it before the last change; None = nothing.

    ``since_wall_ns`` is when it began to serve [ns since the Unix epoch]; ``changed`` whether there
    was a change that can be rolled back.
    """

    current: Choice | None
    since_wall_ns: int
    previous: Choice | None = None
    changed: bool = False


_NOTHING = Assignment(None, 0)


class Serving:
    """What serves at one moment; never changed, only replaced as a whole."""

    __slots__ = ("_default", "_own", "assigned")

    def __init__(self, assigned: Mapping[str, Assignment]) -> None:
        self.assigned = assigned
        own = {
            sensor: one.current.runtime
            for sensor, one in assigned.items()
            if one.current is not None
        }
        self._default = own.pop(DEFAULT, None)
        self._own = own

    def of(self, sensor: str) -> Runtime | None:
        """The bundle of a sensor; None = there is none."""
        # A sensor whose own bundle is not to be had gets no other: nobody has chosen that one.
        return self._own.get(sensor, self._default)


class ServedModels:
    """The bundles of one service. Safe to use from several threads.

    Args:
        task: Task of the service.
        config: Names the bundles to begin with.
        repository: Where bundles are.
        file: Remembers what is served beyond the end of this process; None = nothing does.

    Attributes:
        standby: For which sensors the service stands by, in words; empty = for none.

    Raises:
        ConfigError: A bundle that the profile names does not exist, or is for another task.
        BundleError: It breaks its contract.
        MissingExtraError: ONNX Runtime is not installed.
    """

    def __init__(
        self,
        task: str,
        config: EstimatingConfig,
        repository: Repository,
        file: RememberedFile | None = None,
    ) -> None:
        self.standby = ""
        self._task = task
        self._repository = repository
        self._file = file
        self._loading = threading.Lock()
        self._changing = threading.Lock()
        self._problems: dict[str, PalpateError] = {}
        self._serials: dict[str, str] = {}
        """The finger that each sensor with a bundle of its own was, when it sent last."""
        self._owed: dict[str, ModelAction] = {}
        """The last command to each sensor that took effect and could not be remembered."""
        wanted = {DEFAULT: config.bundle, **config.bundles}
        assigned: dict[str, Assignment] = {}
        self._serving = Serving(assigned)
        try:
            remembered = None if file is None else file.recall(wanted)
        except ConfigError as error:
            self._problems[DEFAULT] = error
            return
        if remembered is None:
            for sensor, bundle in wanted.items():
                assigned[sensor] = Assignment(self._first(bundle), time.time_ns())
        else:
            for sensor, one in remembered.items():
                assigned[sensor] = self._restored(sensor, one, wanted.get(sensor))
            # A command that came while the file could not be read was remembered alone.
            for sensor, bundle in wanted.items():
                if sensor not in assigned:
                    assigned[sensor] = Assignment(self._first(bundle), time.time_ns())
        self._serving = Serving(assigned)
        try:
            self._remember()
        except ConfigError as error:  # a full disk is no reason not to serve
            _log.warning("%s", error)

    def _first(self, bundle: str) -> Choice:
        """Load a bundle that the profile names; one of another task is a mistake of the profile."""
        task = self._repository.read(self._repository.resolve(bundle)).manifest.task
        if task != self._task:
            raise ConfigError(
                f"bundle {bundle!r} is for the task {task!r}, not {self._task!r}",
                remedy=f"name one of the task {self._task!r}: palpate model list",
            )
        return self._open(bundle)

    @property
    def problem(self) -> PalpateError | None:
        """Why a bundle that was served before a restart does not serve; None = all do."""
        return next(iter(self._problems.values()), None)

    def of(self, sensor: str) -> Runtime | None:
        """The bundle of a sensor; None = there is none."""
        return self._serving.of(sensor)

    def meet(self, sensor: str, serial: str) -> bool:
        """Note which finger a sensor with a bundle of its own is; whether it is another one."""
        if self._serials.get(sensor) == serial or sensor not in self._serving.assigned:
            return False
        self._serials[sensor] = serial
        return True

    def all(self) -> list[Runtime]:
        """The bundles that serve, that of all other sensors first."""
        found = {
            id(one): one
            for sensor in (DEFAULT, *self._serving.assigned)
            if (one := self._serving.of(sensor)) is not None
        }
        return list(found.values())

    def obey(self, command: ModelCommand, instance: str) -> ModelInventory:
        """Carry out a command that is permitted; what serves, and what could.

        ``instance`` is the name of this process.

        Raises:
            ConfigError: There is no such bundle, or the change cannot be remembered.
            BundleError: It breaks its contract; what served still serves.
            RemoteError: There is nothing to unload or to roll back, too much is loaded, or another
                command came between.
        """
        began_s = time.monotonic()
        changed_s = None
        if command.action is not ModelAction.LIST and not self._given_again(command):
            before = self._serving.assigned.get(command.sensor, _NOTHING)
            choice = self._chosen(command, before)
            changed_s = self._assign(command, choice, before)
        return ModelInventory(
            instance,
            _listed(self._serving),
            tuple(self._repository.available(self._task)),
            0.0 if changed_s is None else changed_s - began_s,
        )

    def _given_again(self, command: ModelCommand) -> bool:
        """Whether this command has taken effect already, and had only to be remembered.

        A second roll back would undo the first. A load is known by what it loads.
        """
        action = command.action
        with self._changing:
            if action is ModelAction.LOAD or self._owed.get(command.sensor) is not action:
                return False
            self._remember()
            return True

    def _chosen(self, command: ModelCommand, before: Assignment) -> Choice | None:
        """What a command wants to serve, loaded; None = nothing."""
        sensor = command.sensor
        if command.action is ModelAction.UNLOAD:
            if before.current is None:
                _refuse(f"{_whose(sensor)} no bundle to unload", "palpate model served")
            return None
        if command.action is ModelAction.ROLL_BACK:
            if not before.changed:
                _refuse(f"{_whose(sensor)} no bundle from before", "palpate model load NAME")
            if before.previous is None or before.previous.runtime is not None:
                return before.previous
            with self._one_load():
                return self._again(before.previous)
        if "/" in command.bundle or command.bundle.startswith("."):
            _refuse("a bundle is loaded by name, not by path", "palpate model import FOLDER")
        if before is _NOTHING and len(self._serving.assigned) > SENSORS_MOST:
            _refuse_more(f"{SENSORS_MOST} sensors have a bundle of their own", self._task)
        with self._one_load():
            return self._open(command.bundle)

    @contextmanager
    def _one_load(self) -> Iterator[None]:
        """Load one bundle at a time; whoever comes second is told so, and keeps nobody waiting."""
        if not self._loading.acquire(blocking=False):
            raise RemoteError(
                "another bundle is being loaded",
                remedy="ask again later",
                code=ErrorCode.RESOURCE_EXHAUSTED,
                retry_after_s=1.0,
            )
        try:
            yield
        finally:
            self._loading.release()

    def _assign(
        self, command: ModelCommand, choice: Choice | None, before: Assignment
    ) -> float | None:
        """Let a bundle serve; since when it does [s, monotonic], None = it did already.

        A roll back that came while it was loading is the newer order, and counts.
        """
        sensor = command.sensor
        with self._changing:
            assigned = self._serving.assigned
            if assigned.get(sensor, _NOTHING) != before:
                raise RemoteError(
                    "another command has changed meanwhile what serves",
                    remedy="look with palpate model served, then give the command again",
                    code=ErrorCode.UNAVAILABLE,
                )
            current = before.current
            if choice is not None and current is not None and current.runtime is choice.runtime:
                if self._owed:
                    self._remember()
                return None
            changed = Assignment(choice, time.time_ns(), current, changed=True)
            self._serving = Serving({**assigned, sensor: changed})
            changed_s = time.monotonic()
            _log.info("%s: %s -> %s", sensor or "all sensors", _name(current), _name(choice))
            self._problems.pop(sensor, None)
            self._owed[sensor] = command.action
            self._remember()
            return changed_s

    def describe(self) -> str:
        """One line for people."""
        if self.standby:
            return self.standby
        names = [
            f"{sensor} {_name(one.current)}{self._of_another(sensor, one.current)}"
            if sensor
            else _name(one.current)
            for sensor, one in sorted(self._serving.assigned.items())
            if one.current is not None or sensor == DEFAULT
        ]
        return f"serving {', '.join(names) or 'no bundle'}"

    def _of_another(self, sensor: str, choice: Choice | None) -> str:
        """That a sensor's own bundle was made for another finger, in words; empty = it was not."""
        serial = self._serials.get(sensor)
        if choice is None or choice.runtime is None or serial is None:
            return ""
        return choice.runtime.made_for_others(serial)

    def labels(self) -> tuple[str, ...]:
        """What is served, each bundle once as ``name:version``."""
        current = [one.current for one in self._serving.assigned.values()]
        return tuple(sorted({one.runtime.label for one in current if one and one.runtime}))

    def metadata(self) -> ModelMetadata:
        """Description of the first bundle for clients, and which bundle serves which sensor.

        Raises:
            RemoteError: No bundle serves.
        """
        serving = self._serving
        for _, one in sorted(serving.assigned.items()):
            if one.current is not None and one.current.runtime is not None:
                return replace(one.current.runtime.metadata(), served=_listed(serving))
        raise RemoteError(
            "no bundle serves: it was unloaded, or is not to be had since a restart",
            remedy="load one: palpate model load NAME",
            code=ErrorCode.UNAVAILABLE,
        )

    def _open(self, source: str, *, tried: bytes = b"") -> Choice:
        """Load a bundle until it could serve; one that is loaded is taken as it is.

        The bundle of the digest ``tried`` has served on this host: it needs no trial again.
        """
        folder = self._repository.resolve(source)
        bundle = self._repository.read(folder)
        runtime = self._loaded().get(bundle.sha256)
        if runtime is None:
            if len(self._loaded()) >= LOADED_MOST:
                self._forget_previous()
            if len(self._loaded()) >= LOADED_MOST:
                _refuse_more(f"{LOADED_MOST} bundles are loaded", self._task)
            if bundle.sha256 != tried:
                bundle = proven(bundle, self._task)
            runtime = load(bundle, self._task)
        by_path = "/" in source or source.startswith(".")
        label = f"{bundle.manifest.name}:{bundle.manifest.version}"
        return Choice(str(folder.absolute()) if by_path else label, bundle.sha256, runtime)

    def _again(self, choice: Choice) -> Choice:
        """A bundle that served before, loaded, and still the same."""
        if choice.runtime is not None:
            return choice
        found = self._open(choice.source, tried=choice.sha256)
        if found.sha256 != choice.sha256:
            raise BundleError(
                f"bundle {choice.source} has changed since it served: its digest was "
                f"{choice.sha256.hex()[:12]} and is {found.sha256.hex()[:12]}",
                remedy="bundles never change: restore it, or load another version",
            )
        return found

    def _forget_previous(self) -> None:
        """Give the room of bundles that only wait for a roll back, which loads its own again."""
        with self._changing:
            assigned = {
                sensor: replace(one, previous=one.previous and replace(one.previous, runtime=None))
                for sensor, one in self._serving.assigned.items()
            }
            self._serving = Serving(assigned)

    def _loaded(self) -> dict[bytes, Runtime]:
        return {
            choice.sha256: choice.runtime
            for one in self._serving.assigned.values()
            for choice in (one.current, one.previous)
            if choice is not None and choice.runtime is not None
        }

    def _restored(self, sensor: str, remembered: Remembered, wanted: str | None) -> Assignment:
        """What served a sensor before this process began, loaded again.

        If that is not to be had, e.g. after an upgrade of palpate, and no command had chosen it,
        the bundle that the profile wants is chosen anew.
        """
        current = None
        if remembered.bundle:
            current = Choice(remembered.bundle, remembered.sha256, None)
            try:
                current = self._again(current)
            except PalpateError as error:
                if wanted is not None and not remembered.changed:
                    _log.warning("%s; the profile counts again", error)
                    return Assignment(self._open(wanted), time.time_ns())
                self._problems[sensor] = _not_again(self._task, sensor, current, error)
                _log.error("%s", self._problems[sensor])
        previous = (
            Choice(remembered.previous, remembered.previous_sha256, None)
            if remembered.previous
            else None
        )
        return Assignment(current, time.time_ns(), previous, remembered.changed)

    def _remember(self) -> None:
        if self._file is not None:
            self._file.keep(
                {
                    sensor: Remembered(
                        *_found_by(one.current), *_found_by(one.previous), one.changed
                    )
                    for sensor, one in self._serving.assigned.items()
                }
            )
        self._owed.clear()


def _not_again(service: str, sensor: str, choice: Choice, error: PalpateError) -> BundleError:
    """Why a bundle that served before a restart does not; what to do depends on the sensor."""
    whose, option = (f"sensor {sensor!r}", f" --sensor {sensor}") if sensor else ("all sensors", "")
    return BundleError(
        f"{choice.source} does not serve {whose} again: {error.problem}",
        remedy=f"restore it and start the service again, or: palpate model load NAME{option}, or: "
        f"palpate model unload --service {service}{option}",
    )


def _listed(serving: Serving) -> tuple[ServedModel, ...]:
    others = serving.assigned.get(DEFAULT, _NOTHING).current
    return tuple(
        ServedModel(
            sensor,
            *_identity(one.current or others),
            one.since_wall_ns,
            _name(one.previous) if one.previous else "",
        )
        for sensor, one in sorted(serving.assigned.items())
    )


def _name(choice: Choice | None) -> str:
    if choice is None:
        return "no bundle"
    return choice.source if choice.runtime is None else choice.runtime.label


def _identity(choice: Choice | None) -> tuple[str, int, bytes]:
    if choice is None or choice.runtime is None:
        return "", 0, b""
    manifest = choice.runtime.manifest
    return manifest.name, manifest.version, choice.sha256


def _found_by(choice: Choice | None) -> tuple[str, bytes]:
    return ("", b"") if choice is None else (choice.source, choice.sha256)


def _whose(sensor: str) -> str:
    return f"sensor {sensor!r} has" if sensor else "the service has"


def _refuse(problem: str, remedy: str) -> NoReturn:
    raise RemoteError(problem, remedy=f"see {remedy}", code=ErrorCode.INVALID_REQUEST)


def _refuse_more(problem: str, service: str) -> NoReturn:
    raise RemoteError(
        problem,
        remedy=f"unload some: palpate model unload --service {service} --sensor NAME",
        code=ErrorCode.RESOURCE_EXHAUSTED,
    )


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
