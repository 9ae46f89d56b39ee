"""Configuration shared by all rooms: strict models, names in keys, links to the bus."""

from __future__ import annotations

import difflib
import ipaddress
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from palpate.errors import ConfigError

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")


def is_name(text: str) -> bool:
    """Whether a text may be one part of a key."""
    return _NAME.fullmatch(text) is not None


def check_name(name: str, what: str = "name") -> str:
    """Check that a name may be part of a key, and return it; ``what`` says what it names.

    Raises:
        ConfigError: It may not be; the error names it and the rule.
    """
    if not is_name(name):
        raise ConfigError(
            f"{what} {name!r} cannot stand in a Zenoh key",
            remedy="use 1-63 of a-z, 0-9, '-', '_', starting with a letter or digit",
        )
    return name


def check_duration(seconds: float, what: str, *, most: float) -> float:
    """Check that a time is a number of seconds in (0, ``most``], and return it.

    Raises:
        ConfigError: It is not; the error calls it ``what``.
    """
    if not 0.0 < seconds <= most:  # NaN is refused, too
        raise ConfigError(
            f"{what} = {seconds!r} is no time from 0 to {most:g} s",
            remedy=f"give {what} in seconds, more than 0",
        )
    return seconds


@contextmanager
def looking_at(path: Path) -> Iterator[None]:
    """For a block that looks at a path: what exists may lie in a folder of another user.

    Raises:
        ConfigError: The block may not look at it.
    """
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="read it as its owner, or name another place",
        ) from error


Name = Annotated[str, AfterValidator(check_name)]
"""A configuration value that is checked by :func:`check_name`."""


C = TypeVar("C", bound=BaseModel)

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"


class StrictConfig(BaseModel):
    """Base of all configuration: immutable, and an unknown key is an error."""

    # ``constants``: pydantic makes None of infinity and NaN else, where a key has no type.
    model_config = ConfigDict(
        frozen=True, extra="forbid", str_strip_whitespace=True, ser_json_inf_nan="constants"
    )


class Role(StrEnum):
    """What a holder of a certificate is for; ``palpate.bus.access`` says what each may do."""

    ROUTER = "router"
    GATEWAY = "gateway"
    SERVICE = "service"
    ROBOT = "robot"
    OPERATOR = "operator"

    @property
    def common_name(self) -> str:
        """Common name of its certificates: Zenoh compares whole names, without wildcards."""
        return f"palpate-{self.value}"


TLS_FILES = {
    "root_ca_certificate": "ca.pem",
    "certificate": "cert.pem",
    "private_key": "key.pem",
}
"""What a folder of certificates holds."""


class TlsConfig(StrictConfig):
    """Certificates for mutual TLS (Zenoh ``transport/link/tls``).

    Attributes:
        root_ca_certificate: Certificate of the authority that issued all others.
        certificate: This process's own.
        private_key: Its key.
        roles: Whether what others may do follows from the role in their certificate, as
            ``palpate certs`` writes it; False = whoever has a certificate may do everything.
    """

    root_ca_certificate: Path
    certificate: Path
    private_key: Path
    roles: bool = True

    @classmethod
    def of_folder(cls, folder: str | Path) -> TlsConfig:
        """The certificates of a folder with ``ca.pem``, ``cert.pem`` and ``key.pem``.

        Raises:
            ConfigError: One of them is missing, or the folder is closed.
        """
        paths = {key: Path(folder) / name for key, name in TLS_FILES.items()}
        for path in paths.values():
            with looking_at(path):
                found = path.is_file()
            if not found:
                raise ConfigError(
                    f"{path} does not exist",
                    remedy=f"name a folder that holds {', '.join(TLS_FILES.values())}: "
                    "palpate certs issue makes it",
                )
        return cls.model_validate(paths)

    @classmethod
    def of_role(cls, folder: Path, role: Role) -> TlsConfig:
        """The certificates of a role: ``FOLDER/router/cert.pem`` and so on.

        Or ``FOLDER/router_cert.pem``, as a unit of systemd hands them over (``palpate install``).

        Raises:
            ConfigError: One of them is missing, or the folder is closed.
        """
        flat = {key: folder / f"{role.value}_{name}" for key, name in TLS_FILES.items()}
        with looking_at(folder):
            handed_over = all(path.is_file() for path in flat.values())
        if handed_over:
            return cls.model_validate(flat)
        return cls.of_folder(folder / role.value)


class RouterOptions(StrictConfig):
    """A router that may be another than one's own.

    Attributes:
        connect: Endpoint of the router; empty = one's own.
        tls: Certificates for that router.
    """

    connect: str = ""
    tls: TlsConfig | None = None

    @field_validator("connect")
    @classmethod
    def _is_endpoint(cls, value: str) -> str:
        if value:
            endpoint_host_port(value)
        return value

    @model_validator(mode="after")
    def _tls_has_a_router(self) -> RouterOptions:
        if self.tls is not None and not self.connect:
            raise ValueError("tls is for the router that connect names, and connect is empty")
        return self

    def changed(self, link: LinkConfig, *, roles: bool = True, **changes: object) -> LinkConfig:
        """A link with this router, if one is named, and with other changes.

        ``roles`` False: those who join that router, e.g. ROS, have no roles of palpate.

        Raises:
            ConfigError: They would have to join a router that refuses whoever has no role.
        """
        if not roles and not self.connect and link.has_roles:
            raise ConfigError(
                "the station's own router passes on only what the roles of palpate may send",
                remedy="give ROS a router of its own (rmw_zenohd), and name it: connect",
            )
        if self.connect:
            tls = self.tls
            if tls is not None and not roles:
                tls = tls.model_copy(update={"roles": False})
            changes |= {"connect": (self.connect,), "tls": tls}
        return link.model_copy(update=changes)


class LinkConfig(StrictConfig):
    """How a process joins the bus.

    Attributes:
        connect: Endpoints of routers, e.g. ``tcp/127.0.0.1:7447``.
        listen: Endpoints for direct links from peers; port 0 = any free one.
        direct: Whether processes link to one another directly (least latency). False = all data
            through the router: one path, so that nothing is overtaken while a direct link comes
            up. A lossless replay needs that. So it is, too, for who reaches the router at another
            host and listens on loopback only.
        wait_for_router_s: How long opening waits for a router [s]; negative = no limit (services),
            a minute where all data goes through the router.
        lease_s: A peer silent for this long is gone [s].
        wall_clock_error_s: How far the wall clock of another host may be from this host's [s]. A
            reading that seems to come from farther in the future is refused.
        tls: Certificates; required for any listener that is not loopback.
        certificates: Instead of ``tls``: a folder with a folder of certificates for each role that
            runs on this host, as ``palpate certs`` makes it.
    """

    connect: tuple[str, ...] = (DEFAULT_ROUTER,)
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    direct: bool = True
    wait_for_router_s: float = Field(default=-1.0, le=86_400.0, allow_inf_nan=False)
    lease_s: float = Field(default=2.0, gt=0.1, le=600.0, allow_inf_nan=False)
    wall_clock_error_s: float = Field(default=0.05, ge=0, le=10, allow_inf_nan=False)
    tls: TlsConfig | None = None
    certificates: Path | None = None

    @model_validator(mode="before")
    @classmethod
    def _links_have_certificates(cls, values: Any) -> Any:
        """Where certificates tell who somebody is, direct links have them, too."""
        if isinstance(values, dict) and "listen" not in values and _has_roles(values):
            return {**values, "listen": ("tls/127.0.0.1:0",)}
        return values

    @field_validator("connect", "listen")
    @classmethod
    def _endpoints(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for endpoint in value:
            endpoint_host_port(endpoint)
        return value

    @property
    def has_tls(self) -> bool:
        """Whether there are certificates, of this process or for each role."""
        return self.tls is not None or self.certificates is not None

    @property
    def has_roles(self) -> bool:
        """Whether certificates say what others may do."""
        return self.certificates is not None or (self.tls is not None and self.tls.roles)

    @property
    def links_directly(self) -> bool:
        """Whether a process links to others directly: as ``direct`` says, where they can reach it.

        One that joins a router on another host and listens on loopback cannot be reached by the
        other processes of that router. As a peer it would get nothing of theirs, because the router
        passes nothing on between peers; so all goes through the router.
        """

        def here(endpoints: tuple[str, ...]) -> bool:
            return any(is_loopback(endpoint_host_port(one)[0]) for one in endpoints)

        beyond = any(not is_loopback(endpoint_host_port(one)[0]) for one in self.listen)
        return self.direct and (not self.connect or here(self.connect) or beyond)

    @model_validator(mode="after")
    def _exposed_listener_needs_tls(self) -> LinkConfig:
        if self.tls is not None and self.certificates is not None:
            raise ValueError("tls and certificates exclude one another: set one of them")
        for endpoint in self.listen:
            host, _ = endpoint_host_port(endpoint)
            if not is_loopback(host) and not (self.has_tls and endpoint.startswith("tls/")):
                raise ValueError(
                    f"listener {endpoint!r} is reachable from other hosts without mutual TLS: "
                    "use tls/HOST:PORT with [link.tls] certificates, or listen on 127.0.0.1"
                )
            if self.has_roles and not endpoint.startswith("tls/"):
                raise ValueError(
                    f"listener {endpoint!r} asks for no certificate, so that whoever comes has no "
                    "role: use tls/HOST:PORT, or tls.roles = false"
                )
        return self

    def as_role(self, role: Role) -> LinkConfig:
        """The link of a process with this role: with its certificates from ``certificates``.

        Raises:
            ConfigError: That folder has none for the role.
        """
        if self.certificates is None:
            return self
        tls = TlsConfig.of_role(self.certificates.expanduser(), role)
        return self.model_copy(update={"tls": tls, "certificates": None})


def _has_roles(values: Mapping[str, Any]) -> bool:
    """Whether the values of a link have certificates with roles, before they are checked."""
    tls = values.get("tls")
    roles = tls.get("roles", True) if isinstance(tls, Mapping) else getattr(tls, "roles", False)
    return values.get("certificates") is not None or (tls is not None and bool(roles))


CONNECT_VARIABLE = "PALPATE_CONNECT"
STATION_VARIABLE = "PALPATE_STATION"
TLS_VARIABLE = "PALPATE_TLS"
JOINING_VARIABLES = (CONNECT_VARIABLE, STATION_VARIABLE, TLS_VARIABLE)
"""Environment variables of who joins a running station: its router, its name and the folder of
certificates, where nothing else is given."""


def joining_link(
    connect: str | None = None,
    *,
    wait_s: float,
    tls: TlsConfig | Path | str | None = None,
) -> LinkConfig:
    """Link of a program that joins a running station.

    Args:
        connect: Endpoint of the router; None = ``$PALPATE_CONNECT``, else the default one.
        wait_s: How long joining may take [s]; negative = no limit.
        tls: Certificates, or their folder (``TLS_FILES``); None = ``$PALPATE_TLS``, for an
            endpoint that begins with ``tls/``.

    Raises:
        ConfigError: No endpoint, no time, or certificates and endpoint do not fit together.
    """
    endpoint = connect or os.environ.get(CONNECT_VARIABLE) or DEFAULT_ROUTER
    if isinstance(tls, str | Path):
        tls = TlsConfig.of_folder(tls)
    given = tls is not None
    if tls is None and endpoint.startswith("tls/") and os.environ.get(TLS_VARIABLE):
        tls = TlsConfig.of_folder(os.environ[TLS_VARIABLE])
    link = parse_config(
        LinkConfig,
        {"connect": (endpoint,), "wait_for_router_s": wait_s, "tls": tls},
        where=f"router {endpoint}",
    )
    if endpoint.startswith("tls/") and tls is None:
        raise ConfigError(
            f"{endpoint} needs certificates",
            remedy=f"name their folder: --tls FOLDER, Client(tls=...) or ${TLS_VARIABLE}",
        )
    exposed = not is_loopback(endpoint_host_port(endpoint)[0])
    if given and exposed and not endpoint.startswith("tls/"):
        raise ConfigError(
            f"{endpoint} is not encrypted, although certificates are given",
            remedy=f"connect to tls/{endpoint.partition('/')[2]}, or leave the certificates out",
        )
    return link


def endpoint_host_port(endpoint: str) -> tuple[str, int]:
    """Host and port of a Zenoh endpoint such as ``tcp/127.0.0.1:7447``.

    Raises:
        ValueError: It is not ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls") or not host or not port.isdigit() or int(port) > 65535:
        raise ValueError(f"endpoint {endpoint!r} is not tcp/HOST:PORT or tls/HOST:PORT")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether ``host`` can be reached from this host only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def parse_config(model: type[C], values: Mapping[str, Any], *, where: str) -> C:
    """Build a configuration from e.g. a TOML table, and translate what is wrong with it.

    Raises:
        ConfigError: Names ``where``, the key, and for an unknown key the nearest known one.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise config_error(model, error, where=where) from error


def config_error(model: type[BaseModel], error: ValidationError, *, where: str) -> ConfigError:
    """Translate pydantic's first complaint into one line that names file, key and remedy."""
    first = error.errors()[0]
    path = ".".join(str(part) for part in _keys(model, first["loc"]))
    if first["type"] == "extra_forbidden":
        known = _known_keys(model, first["loc"])
        near = difflib.get_close_matches(str(first["loc"][-1]), known, n=1, cutoff=0.5)
        remedy = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(sorted(known))}"
        return ConfigError(f"{where}: unknown key {path!r}", remedy=remedy)
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if first["type"] == "missing":
        return ConfigError(f"{where}: key {path!r} is missing{more}", remedy=f"set {path}")
    message = first["msg"].removeprefix("Value error, ")
    return ConfigError(
        f"{where}: {path or 'configuration'} = {first['input']!r}: {message}{more}",
        remedy=f"correct {path or 'it'} in {where}",
    )


def _keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[int | str]:
    """The keys of a place in a configuration: pydantic adds the member of a union that it tried."""
    current: type[BaseModel] | None = model
    keys: list[int | str] = []
    for part in loc:
        keys.append(part)
        field = None if current is None else current.model_fields.get(str(part))
        if field is not None:
            current = _nested_model(field.annotation)
            members = {*get_args(field.annotation)} - {type(None)}
            united = get_origin(field.annotation) in (Union, UnionType)
            if united and current is None and len(members) > 1:
                break
    return keys


def _known_keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Keys of the (nested) model in which the last part of ``loc`` was not known."""
    current: Any = model
    for part in loc[:-1]:
        if isinstance(part, int):
            continue
        field = current.model_fields.get(part)
        nested = None if field is None else _nested_model(field.annotation)
        if nested is None:
            return []
        current = nested
    return list(current.model_fields)


def _nested_model(annotation: Any) -> type[BaseModel] | None:
    """The model inside ``X``, ``X | None``, ``tuple[X, ...]`` or ``list[X]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        found = _nested_model(inner)
        if found is not None:
            return found
    return None
