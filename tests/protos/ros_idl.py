"""Messages of ROS 2 in pycdr2, a library of CDR that shares no code with the one that palpate uses.

Without ``from __future__ import annotations``: pycdr2 reads the annotations.
"""

# mypy: disable-error-code="misc"
from dataclasses import dataclass

from pycdr2 import IdlStruct, types


@dataclass
class Time(IdlStruct):
    sec: types.int32
    nanosec: types.uint32


@dataclass
class Header(IdlStruct):
    stamp: Time
    frame_id: str


@dataclass
class Biotac(IdlStruct):
    pac0: types.int16
    pac1: types.int16
    pdc: types.int16
    tac: types.int16
    tdc: types.int16
    electrodes: types.sequence[types.int16]


@dataclass
class BiotacAll(IdlStruct):
    header: Header
    tactiles: types.array[Biotac, 5]


@dataclass
class BioTacData(IdlStruct):
    bt_serial: str
    bt_position: types.uint16
    tdc_data: types.uint16
    tac_data: types.uint16
    pdc_data: types.uint16
    pac_data: types.array[types.uint16, 22]
    electrode_data: types.array[types.uint16, 19]


@dataclass
class BioTacTime(IdlStruct):
    frame_start_time: Time
    frame_end_time: Time
    tdc_ns_offset: types.uint32
    tac_ns_offset: types.uint32
    pdc_ns_offset: types.uint32
    pac_ns_offset: types.array[types.uint32, 22]
    electrode_ns_offset: types.array[types.uint32, 19]


@dataclass
class BioTacHand(IdlStruct):
    header: Header
    hand_id: str
    bt_data: types.sequence[BioTacData]
    bt_time: BioTacTime


@dataclass
class Vector3(IdlStruct):
    x: types.float64
    y: types.float64
    z: types.float64


@dataclass
class Wrench(IdlStruct):
    force: Vector3
    torque: Vector3


@dataclass
class WrenchStamped(IdlStruct):
    header: Header
    wrench: Wrench


@dataclass
class Point(IdlStruct):
    x: types.float64
    y: types.float64
    z: types.float64


@dataclass
class PointStamped(IdlStruct):
    header: Header
    point: Point


@dataclass
class Features(IdlStruct):
    header: Header
    sensor_serial: str
    sequence: types.uint64
    in_contact: bool
    force: Vector3
    force_sd: Vector3
    contact_location: Point
    contact_location_sd: Vector3
    centre_of_pressure: Point
    centre_of_pressure_sd: Vector3
    contact_normal: Vector3
    contact_normal_sd: types.float64
    quality: types.sequence[types.uint8]
    bundle: str
