"""What a profile needs of its host, so that a service gets this and no more."""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.config import JOINING_VARIABLES, endpoint_host_port, is_loopback, parse_config
from palpate.errors import ConfigError
from palpate_deploy.station.profile import ENV_PREFIX, Profile, plain_values

_ENDPOINT = re.compile(r"(?:tcp|tls)/.+:\d+")
_URL = re.compile(r"[a-z0-9]+://(?:[^@/]*@)?(\[[^\]]+\]|[^:/]+)")
_HIDDEN = re.compile(r"(?:~|/home|/root|/run/user|/tmp|/var/tmp)(?:/.*)?")

UNSEEN_FOLDERS = "/home, /root, /run/user, /tmp and /var/tmp"
"""A service has its own empty ones in place of them."""


@dataclass(frozen=True, slots=True)
class HostNeeds:
    """What a station's processes reach beyond their own folder and loopback.

    Attributes:
        serial: Serial lines as the profile names them.
        can: Whether a sensor is on SocketCAN.
        networks: Addresses and networks of other hosts, for every process.
        device_networks: Addresses of sensors, for the gateway.
        gpu: Whether the finite elements may compute on a GPU.
    """

    serial: tuple[str, ...] = ()
    can: bool = False
    networks: tuple[str, ...] = ()
    device_networks: tuple[str, ...] = ()
    gpu: bool = False


def hidden(path: str | Path) -> bool:
    """Whether a service does not see this path, because it lies in ``UNSEEN_FOLDERS``."""
    return _HIDDEN.fullmatch(str(path)) is not None


def check_environment_is_plain() -> None:
    """Check that no variable of this shell changes the profile: a service would not have it.

    Raises:
        ConfigError: One does.
    """
    for variable in sorted(os.environ):
        if variable.upper().startswith(ENV_PREFIX) and variable not in JOINING_VARIABLES:
            raise ConfigError(
                f"{variable} is set here, and no service will have it",
                remedy=f"write its value into the profile, then: unset {variable}",
            )


def needs_of(profile: Profile, allowed: Sequence[str] = ()) -> HostNeeds:
    """What a profile needs; ``allowed`` are networks beside those that it names itself.

    Raises:
        ConfigError: A host is given by name, a file lies where no service looks, the router is
            there for hosts that nobody named, or a sensor's options are wrong.
        MissingExtraError: A sensor's driver cannot be loaded.
    """
    # Certificates of the link come by way of the service manager, which sees all files.
    link = profile.link.model_copy(update={"tls": None})
    _check_files(plain_values(profile.model_copy(update={"link": link})), "")
    networks = [_network(text) for text in allowed]
    devices: list[str] = []
    serial: list[str] = []
    can = False
    if "gateway" in profile.processes:
        for sensor in profile.gateway.sensors:
            options = _resolved_options(sensor.driver, sensor.options, sensor.name)
            _check_files(options, f"options of sensor {sensor.name!r}: ")
            can = can or (options.get("interface") == "socketcan" and bool(options.get("channel")))
            serial += [text for _, text in _texts(options, "") if text.startswith("/dev/")]
            devices += _networks_of(options, f"sensor {sensor.name!r}")
    links = {
        "link": profile.link.connect,
        "router": profile.router.connect,
        "ros_bridge": (profile.ros_bridge.connect,),
    }
    for table, endpoints in links.items():
        if table == "link" or table in profile.processes:
            try:
                networks += _networks_of({table: list(endpoints)}, f"[{table}]")
            except ConfigError:
                if table != "router" or not allowed:  # which may be where the name leads
                    raise
    _check_listeners(profile, networks)
    gpu = "fem" in profile.processes and profile.fem.device is not None
    return HostNeeds(
        serial=tuple(dict.fromkeys(serial)),
        can=can,
        networks=tuple(dict.fromkeys(networks)),
        device_networks=tuple(dict.fromkeys(devices)),
        gpu=gpu,
    )


def _resolved_options(driver: str, options: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A sensor's options with the driver's defaults: the factory's address of a sensor is one."""
    from palpate_gateway.drivers import load_driver

    where = f"options of sensor {name!r}"
    checked = parse_config(load_driver(driver).options_class, options, where=where)
    return checked.model_dump(mode="json", exclude_none=True)


def _check_listeners(profile: Profile, networks: list[str]) -> None:
    listeners = list(profile.link.listen)
    if "router" in profile.processes:
        listeners += profile.router.listen
    if "web" in profile.processes:
        listeners.append(f"tcp/{profile.web.listen}")
    exposed = [one for one in listeners if not is_loopback(endpoint_host_port(one)[0])]
    if exposed and not networks:
        raise ConfigError(
            f"{exposed[0]} is there for other hosts, and a service talks to none that is not named",
            remedy="name them, e.g. --allow 192.168.1.0/24",
        )


def _networks_of(values: Mapping[str, Any], where: str) -> Iterator[str]:
    """Addresses beyond loopback in options: hosts, endpoints, URLs, multicast groups."""
    multicast = values.get("interface") == "udp_multicast"
    for key, text in _texts(values, ""):
        if _ENDPOINT.fullmatch(text):
            host = endpoint_host_port(text)[0]
        elif found := _URL.match(text):
            host = found[1].strip("[]")
        elif key == "host" or (multicast and key == "channel"):
            host = text
        else:
            continue
        if is_loopback(host):
            continue
        try:
            yield str(ipaddress.ip_address(host))
        except ValueError:
            raise ConfigError(
                f"{where}: {host!r} is a name, and a service is shut off by addresses",
                remedy="write the address into the profile",
            ) from None


def _network(text: str) -> str:
    try:
        return str(ipaddress.ip_network(text, strict=False))
    except ValueError:
        raise ConfigError(
            f"--allow {text!r} is no network", remedy="write e.g. 192.168.1.0/24"
        ) from None


def _texts(value: Any, key: str) -> Iterator[tuple[str, str]]:
    """Every text in plain values, with the key that is next to it."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, Mapping):
        for inner_key, inner in value.items():
            yield from _texts(inner, str(inner_key))
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner, key)


def _check_files(values: Mapping[str, Any], where: str) -> None:
    for key, text in _texts(values, ""):
        if hidden(text):
            raise ConfigError(
                f"{where}{key} = {text!r}: a service does not see {UNSEEN_FOLDERS}",
                remedy="move it, e.g. to /srv/palpate or /etc/palpate, and name that place",
            )
