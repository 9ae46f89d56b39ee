"""The driver table: names of drivers and their device classes, imported only when used.

Other distributions add drivers through the entry-point group ``palpate.devices``; each names a
subclass of ``Device``. A built-in name cannot be replaced.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any, cast

from palpate.config import parse_config
from palpate.errors import ConfigError, MissingExtraError
from palpate.process import check_installed
from palpate_gateway.device import Device

ENTRY_POINTS = "palpate.devices"

DRIVERS: dict[str, str] = {
    "virtual": "palpate_gateway.virtual.finger:VirtualFinger",
    "text_log": "palpate_gateway.recordings.text_log:TextLog",
    "record": "palpate_gateway.recordings.record:RecordReplay",
    "biotac_can": "palpate_gateway.biotac.can_fingers:BiotacCan",
    "biotac_bridge": "palpate_gateway.biotac.bridge:BiotacBridge",
    "biotac_pic32": "palpate_gateway.biotac.pic32:BiotacPic32",
    "pose_zenoh": "palpate_gateway.pose.robot:PoseZenoh",
    "pose_file": "palpate_gateway.pose.file:PoseFile",
    "wrench_kms40": "palpate_gateway.wrench.kms40:WrenchKms40",
    "wrench_rdt": "palpate_gateway.wrench.rdt:WrenchRdt",
    "wrench_robotous": "palpate_gateway.wrench.robotous:WrenchRobotous",
    "wrench_bota": "palpate_gateway.wrench.bota:WrenchBota",
    "ros_biotac": "palpate_gateway.ros.biotac:RosBiotac",
    "ros_wrench": "palpate_gateway.ros.wrench:RosWrench",
    "ros_bag": "palpate_gateway.ros.bag:RosBag",
}
"""Built-in drivers, ``module:Class``."""


def driver_names() -> list[str]:
    """Names of all drivers, built in and installed."""
    return sorted({*DRIVERS, *(point.name for point in entry_points(group=ENTRY_POINTS))})


def load_driver(name: str) -> type[Device]:
    """The device class of a driver that can be used here.

    Raises:
        ConfigError: There is no such driver, or its table entry names no device class.
        MissingExtraError: It needs a package that is not installed.
    """
    device = find_driver(name)
    for module_name in device.needs:
        check_installed(module_name, extra="gateway")
    return device


def find_driver(name: str) -> type[Device]:
    """The device class of a driver, also without the packages that it ``needs``.

    Raises:
        ConfigError: There is no such driver, or its table entry names no device class.
        MissingExtraError: A package without which it cannot even be imported is not installed.
    """
    target = DRIVERS.get(name)
    if target is None:
        for point in entry_points(group=ENTRY_POINTS, name=name):
            target = point.value
    if target is None:
        known = driver_names()
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        raise ConfigError(
            f"unknown driver {name!r}",
            remedy=f"did you mean {near[0]!r}?" if near else f"known drivers: {', '.join(known)}",
        )
    module_name, _, class_name = target.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        # The module itself, or a package that it is in: else it is one that it imports.
        if error.name is None or f"{module_name}.".startswith(f"{error.name}."):
            raise ConfigError(
                f"driver {name!r} names the module {module_name!r}, which does not exist",
                remedy="reinstall the distribution that provides this driver",
            ) from error
        raise MissingExtraError(error.name, extra="gateway") from error
    device = getattr(module, class_name, None)
    if not (isinstance(device, type) and issubclass(device, Device)):
        raise ConfigError(
            f"driver {name!r} names {target!r}, which is no device class",
            remedy="name a subclass of palpate_gateway.device.Device as 'module:Class'",
        )
    return device


def make_device(
    driver: str, options: Mapping[str, Any] | None = None, *, where: str = ""
) -> Device:
    """A closed device.

    Args:
        driver: Name in the driver table.
        options: The driver's options.
        where: File or table the options come from, for errors.

    Raises:
        ConfigError: Unknown driver, or an option is unknown or wrong.
        MissingExtraError: The driver needs a package that is not installed.
    """
    device = load_driver(driver)
    where = where or f"options of driver {driver!r}"
    checked = parse_config(device.options_class, options or {}, where=where)
    return cast(Device, cast(Any, device)(checked))
