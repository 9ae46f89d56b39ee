"""A profile: everything a station runs, in one TOML file (docs/conventions.md, configuration).

Every room reads only its own table. An unknown key is an error that names the nearest known one.
Environment variables override the file: ``PALPATE_FEATURES__BUNDLE=my-bundle``.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import (
    BaseSettings,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
)

from palpate.config import (
    DEFAULT_ROUTER,
    JOINING_VARIABLES,
    LinkConfig,
    Name,
    StrictConfig,
    config_error,
    endpoint_host_port,
    is_loopback,
    looking_at,
)
from palpate.errors import ConfigError
from palpate_deploy.station.logs import LogFormat, LogLevel
from palpate_fem.service.config import FemConfig
from palpate_gateway.config import GatewayConfig
from palpate_services.config import (
    FeaturesServiceConfig,
    FieldServiceConfig,
    ModelsConfig,
    RecorderConfig,
    RosBridgeConfig,
    SynthesisServiceConfig,
)

PROFILES = Path(__file__).parent.parent / "profiles"
"""Profiles that ship with palpate."""

ENV_PREFIX = "PALPATE_"
ENV_NESTED = "__"

Service = Literal[
    "router",
    "gateway",
    "features",
    "field",
    "synthesis",
    "recorder",
    "fem",
    "metrics",
    "web",
    "ros_bridge",
]
SERVICES: tuple[Service, ...] = ("router", "gateway", "features", "recorder")
"""What a station runs by default; a profile names the others if it needs them."""


class RouterConfig(StrictConfig):
    """Where the router listens, and to which site it connects.

    Attributes:
        listen: Endpoints; any that is not loopback needs certificates: ``[link] certificates``.
        connect: Endpoints of the router of a site, to which those of several stations connect, so
            that the station can be reached from there; empty = the station is alone.
    """

    listen: tuple[str, ...] = (DEFAULT_ROUTER,)
    connect: tuple[str, ...] = ()

    @field_validator("listen", "connect")
    @classmethod
    def _endpoints(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for endpoint in value:
            endpoint_host_port(endpoint)
        return value


class MetricsConfig(StrictConfig):
    """Metrics for Prometheus.

    Attributes:
        listen: ``HOST:PORT`` of this host's loopback; a Prometheus on another host needs a proxy
            with TLS in front.
    """

    listen: str = "127.0.0.1:9464"

    @field_validator("listen")
    @classmethod
    def _loopback(cls, value: str) -> str:
        try:
            host, port = endpoint_host_port(f"tcp/{value}")
        except ValueError:
            raise ValueError(f"{value!r} is not HOST:PORT") from None
        if not is_loopback(host) or port == 0:
            raise ValueError(f"{value!r} is not a port of loopback, e.g. 127.0.0.1:9464")
        return value


class WebConfig(StrictConfig):
    """The page of a station for browsers, which only shows.

    Attributes:
        listen: ``HOST:PORT``. Who reaches it sees everything; there is no password and no TLS.
        names: Names of this host by which browsers may ask for it, beside ``localhost`` and
            addresses.
        live: Whether there is a live view.
        bundles: Names or folders of bundles with meshes of its fields, beside the packaged ones.
    """

    listen: str = "127.0.0.1:7480"
    names: tuple[str, ...] = ()
    live: bool = True
    bundles: tuple[str, ...] = ()

    @field_validator("listen")
    @classmethod
    def _address(cls, value: str) -> str:
        try:
            _, port = endpoint_host_port(f"tcp/{value}")
        except ValueError:
            port = 0
        if port == 0:
            raise ValueError(f"{value!r} is not HOST:PORT, e.g. 127.0.0.1:7480")
        return value


class LogConfig(StrictConfig):
    """What the processes write into their logs.

    Attributes:
        level: The lowest level that is written.
        format: ``text`` for people, ``json`` for machines.
    """

    level: LogLevel = "info"
    format: LogFormat = "text"


class Profile(StrictConfig):
    """One station.

    Attributes:
        station: Name of the station, the third part of every key on the bus.
        replica: Distinguishes the processes of this profile where another host runs the same ones
            for the same station: ``b`` makes ``features-b`` of ``features``. Empty = it has none.
        processes: The processes that ``palpate up`` starts here.
        link: How every process joins the bus.
        router: Where the router listens.
        gateway: The sensors.
        features: Electrodes to features.
        field: Electrodes to displacement fields, if ``processes`` names ``field``.
        synthesis: Displacement fields to electrodes, if ``processes`` names ``synthesis``.
        recorder: What is recorded, and where.
        models: The user's bundles, and what is remembered of those that serve.
        fem: How simulations are served, if ``processes`` names ``fem``.
        metrics: Where Prometheus finds metrics, if ``processes`` names ``metrics``.
        web: Where browsers find the page, if ``processes`` names ``web``.
        ros_bridge: What nodes of ROS 2 get, if ``processes`` names ``ros_bridge``.
        log: What the processes write into their logs.
    """

    station: Name = "lab"
    replica: str = Field(default="", pattern=r"^([a-z0-9][a-z0-9_-]{0,47})?$")
    processes: tuple[Service, ...] = Field(default=SERVICES, min_length=1)
    link: LinkConfig = LinkConfig()
    router: RouterConfig = RouterConfig()
    gateway: GatewayConfig = Field(default_factory=GatewayConfig)
    features: FeaturesServiceConfig = FeaturesServiceConfig()
    field: FieldServiceConfig = FieldServiceConfig()
    synthesis: SynthesisServiceConfig = SynthesisServiceConfig()
    recorder: RecorderConfig = RecorderConfig()
    models: ModelsConfig = Field(default_factory=ModelsConfig)
    fem: FemConfig = FemConfig()
    metrics: MetricsConfig = MetricsConfig()
    web: WebConfig = WebConfig()
    ros_bridge: RosBridgeConfig = Field(default_factory=RosBridgeConfig)
    log: LogConfig = LogConfig()

    def instance(self, service: str) -> str:
        """Name of a process among several of its kind; a station has one router."""
        return f"{service}-{self.replica}" if self.replica and service != "router" else service

    @field_validator("processes")
    @classmethod
    def _each_once(cls, value: tuple[Service, ...]) -> tuple[Service, ...]:
        if len(set(value)) != len(value):
            raise ValueError("each process can be named once")
        return value


class _FileAndEnvironment(BaseSettings, Profile):
    """A profile while it is read: values of the environment override those of the file."""

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX, env_nested_delimiter=ENV_NESTED, frozen=True, extra="forbid"
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """The file's values are the constructor's arguments; the environment overrides them."""
        return env_settings, init_settings


def profile_names() -> list[str]:
    """Names of the profiles that ship with palpate."""
    return sorted(path.stem for path in PROFILES.glob("*.toml"))


def profile_path(profile: str | Path) -> Path:
    """File of a profile given by name (``demo``) or by path (``./mine.toml``).

    Raises:
        ConfigError: There is no such profile, where the error lists what exists; or another user's
            folder is closed.
    """
    text = str(profile)
    if "/" in text or text.endswith(".toml"):
        path = Path(text).expanduser()
        with looking_at(path):
            if path.is_file():
                return path
            why = "is no file" if path.exists() else "does not exist"
        raise ConfigError(
            f"profile {path} {why}",
            remedy=f"check the path, or use one by name: {', '.join(profile_names())}",
        )
    path = PROFILES / f"{text}.toml"
    if path.is_file():
        return path
    near = difflib.get_close_matches(text, profile_names(), n=1, cutoff=0.5)
    raise ConfigError(
        f"profile {text!r} does not exist",
        remedy=f"did you mean {near[0]!r}?"
        if near
        else f"known: {', '.join(profile_names())}; your own by path: ./{text}.toml",
    )


def load_profile(profile: str | Path) -> Profile:
    """Read a profile by name or path.

    Raises:
        ConfigError: Names the file, the key and what was expected.
    """
    path = profile_path(profile)
    return parse_profile(read_toml(path), where=str(path))


def parse_profile(values: Mapping[str, Any], *, where: str) -> Profile:
    """Build a profile from plain values, as in the TOML file, and the environment.

    Raises:
        ConfigError: Names ``where`` the values come from, the key and what was expected.
    """
    _check_environment()
    try:
        # Keys such as `_env_file` would be arguments of BaseSettings itself.
        Profile.model_validate(
            {key: values[key] for key in set(values) - set(Profile.model_fields)}
        )
        read = _FileAndEnvironment(**values)
    except ValidationError as error:
        blamed = _variable_of(error.errors()[0]["loc"])
        raise config_error(Profile, error, where=blamed or where) from error
    except SettingsError as error:
        raise ConfigError(
            f"environment: {error}",
            remedy=f"tables and lists in {ENV_PREFIX}* variables are written as JSON",
        ) from error
    except ConfigError as error:  # a name that cannot stand in a key
        raise ConfigError(f"{where}: {error.problem}", remedy=error.remedy) from error
    _check_router(read, where)
    if "router" in read.processes and "connect" not in read.link.model_fields_set:
        # One address is enough: whoever starts the router also connects to it.
        link = read.link.model_copy(update={"connect": _connect_to(read.router.listen)})
    else:
        link = read.link
    return Profile.model_validate({**read.model_dump(), "link": link.model_dump()})


def changed(profile: Profile, **tables: Mapping[str, Any]) -> Profile:
    """A copy with some keys of some tables replaced, e.g. ``recorder={"out": "runs/1"}``.

    Raises:
        ConfigError: A replaced value is wrong; values are checked like those of a file.
    """
    values = plain_values(profile)
    for table, keys in tables.items():
        values[table] = {**values.get(table, {}), **keys}
    try:
        replaced = Profile.model_validate(values)
    except ValidationError as error:
        raise config_error(Profile, error, where="command line") from error
    _check_router(replaced, "command line")
    return replaced


def plain_values(profile: Profile) -> dict[str, Any]:
    """A profile as plain values: strings, numbers, lists, mappings."""
    # Not through JSON text, which has no infinity. A key without value has its default.
    return profile.model_dump(mode="json", exclude_none=True)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        ConfigError: It cannot be read or is not TOML; the error names the line.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path} is not TOML: {error}", remedy="correct that place; strings need quotes"
        ) from error
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror or error}", remedy="check its permissions"
        ) from error


def _check_environment() -> None:
    """Raise an error for a misspelt variable, which would otherwise have no effect at all."""
    for variable in os.environ:
        if not variable.upper().startswith(ENV_PREFIX) or variable in JOINING_VARIABLES:
            continue
        field = variable[len(ENV_PREFIX) :].lower().split(ENV_NESTED)[0]
        if field not in Profile.model_fields:
            near = difflib.get_close_matches(field, Profile.model_fields, n=1, cutoff=0.5)
            hint = f"did you mean {ENV_PREFIX}{near[0].upper()}? " if near else ""
            raise ConfigError(
                f"environment variable {variable} is not a key of a profile",
                remedy=f"{hint}keys: {', '.join(Profile.model_fields)}; nested by {ENV_NESTED}",
            )


def _variable_of(loc: tuple[int | str, ...]) -> str | None:
    """The environment variable that set the value at ``loc``, if there is one."""
    set_here = {variable.upper(): variable for variable in os.environ}
    for depth in range(len(loc), 0, -1):
        name = ENV_PREFIX + ENV_NESTED.join(str(part) for part in loc[:depth]).upper()
        if name in set_here:
            return f"environment variable {set_here[name]}"
    return None


def _connect_to(listen: tuple[str, ...]) -> tuple[str, ...]:
    """Endpoints at which this host reaches its router, which listens at ``listen``.

    Where there is a listener of loopback beside others, it is for this host: nobody else can keep
    that one busy (docs/security.md).
    """
    own = tuple(one for one in listen if is_loopback(endpoint_host_port(one)[0]))
    return own or tuple(
        endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
        for endpoint in listen
    )


def _check_router(profile: Profile, where: str) -> None:
    if "router" not in profile.processes:
        return
    if not profile.router.listen:
        raise ConfigError(
            f"{where}: router.listen is empty, so that nobody can reach the router",
            remedy=f'name an address, e.g. listen = ["{DEFAULT_ROUTER}"], or leave it out',
        )
    for endpoint in profile.router.listen:
        host, port = endpoint_host_port(endpoint)
        if port == 0:
            raise ConfigError(
                f"{where}: router.listen {endpoint!r} has no port that others could know",
                remedy="name a port, e.g. 7447",
            )
        exposed = not is_loopback(host)
        if exposed and not (profile.link.has_tls and endpoint.startswith("tls/")):
            raise ConfigError(
                f"{where}: router.listen {endpoint!r} is reachable from other hosts without "
                "mutual TLS",
                remedy="use tls/HOST:PORT and [link] certificates, or listen on 127.0.0.1",
            )
        if endpoint.startswith("tls/") and not profile.link.has_tls:
            raise ConfigError(
                f"{where}: router.listen {endpoint!r} needs certificates, and there are none",
                remedy="name their folder: [link] certificates; or listen at "
                f"tcp/{endpoint.partition('/')[2]}",
            )
    own = {endpoint_host_port(endpoint) for endpoint in profile.router.listen}
    for host, port in sorted(own):
        # All addresses of IPv6 are those of IPv4, too.
        same = [one for one, other in own - {(host, port)} if other == port]
        excluded = [one for one in same if host == "::" or ":" not in one]
        if host in ("0.0.0.0", "::") and excluded:
            raise ConfigError(
                f"{where}: router.listen names port {port} at {host}, which is all addresses, and "
                "at another one",
                remedy="leave the other one out",
            )
    for endpoint in profile.router.connect:
        if profile.link.has_roles and not endpoint.startswith("tls/"):
            raise ConfigError(
                f"{where}: router.connect {endpoint!r} shows no certificate, so that nothing it "
                "says would be believed",
                remedy=f"connect to tls/{endpoint.partition('/')[2]}",
            )
        if endpoint_host_port(endpoint) in own:
            raise ConfigError(
                f"{where}: router.connect {endpoint!r} is where this router itself listens",
                remedy="name the router of the site, or leave connect out",
            )
    for endpoint in profile.router.listen:
        if profile.link.has_roles and not endpoint.startswith("tls/"):
            raise ConfigError(
                f"{where}: router.listen {endpoint!r} asks for no certificate, so that whoever "
                "comes has no role",
                remedy="use tls/HOST:PORT",
            )
