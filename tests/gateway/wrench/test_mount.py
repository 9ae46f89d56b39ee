"""From a force/torque sensor's own frame to the wrench on the BioTac."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from palpate.config import parse_config
from palpate.errors import ConfigError
from palpate_gateway.readings import WrenchReading
from palpate_gateway.wrench.device import Mount, MountOptions, WrenchDevice, WrenchOptions

FORCE, TORQUE = np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3])


def mount(**options: Any) -> Mount:
    return Mount(parse_config(MountOptions, options, where="test"))


def test_as_measured_where_nothing_is_said() -> None:
    force, torque = mount().on_biotac(np.concatenate([FORCE, TORQUE]))
    assert force.dtype == torque.dtype == np.float32
    np.testing.assert_allclose(force, FORCE)
    np.testing.assert_allclose(torque, TORQUE)


def test_an_indenter_feels_the_reaction() -> None:
    force, torque = mount(carries="indenter").on_biotac(np.concatenate([FORCE, TORQUE]))
    np.testing.assert_allclose(force, -FORCE)
    np.testing.assert_allclose(torque, -TORQUE)


def test_a_quarter_turn_about_z() -> None:
    half = np.sqrt(0.5)
    force, torque = mount(orientation_wxyz=[half, 0.0, 0.0, half]).on_biotac(
        np.concatenate([FORCE, TORQUE])
    )
    np.testing.assert_allclose(force, [-2.0, 1.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose(torque, [-0.2, 0.1, 0.3], rtol=1e-6)


def test_torque_is_about_the_sensor_frame() -> None:
    """A force through the force/torque sensor's origin, 2 cm away, has a moment here."""
    force, torque = mount(origin_m=[0.0, 0.0, 0.02]).on_biotac(np.eye(6)[0])
    np.testing.assert_allclose(torque, [0.0, 0.02, 0.0], atol=1e-9)
    # and the power of any wrench is the same in both frames
    turn = np.array([0.5, 0.5, -0.5, 0.5])
    both = mount(orientation_wxyz=turn, origin_m=[0.01, -0.02, 0.03], carries="indenter")
    there_v, there_w = np.array([0.3, -0.1, 0.2]), np.array([1.0, 2.0, -1.0])
    force, torque = both.on_biotac(np.concatenate([FORCE, TORQUE]))
    axes = [both.on_biotac(unit)[0] for unit in np.eye(6)[:3]]
    rotation = -np.array(axes).T
    here_w = rotation @ there_w
    here_v = rotation @ there_v - np.cross(here_w, [0.01, -0.02, 0.03])
    assert force @ here_v + torque @ here_w == pytest.approx(
        -(FORCE @ there_v + TORQUE @ there_w), rel=1e-5
    )


class OneReading(WrenchDevice):
    """Has no device; makes a reading of whatever it is told."""

    def __init__(self, **options: Any) -> None:
        values = parse_config(WrenchOptions, options, where="test")
        super().__init__("test", "a test", 100.0, values)

    def zero(self) -> None: ...

    def _connect(self) -> str:
        return "test"

    def _close(self) -> None: ...

    def _receive(self, timeout_s: float) -> list[WrenchReading]:
        return []

    def _protocol_counters(self) -> dict[str, int]:
        return {}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("wrong", [np.nan, np.inf, 3.3e38, -1e39, 1e300])
@pytest.mark.parametrize("mount", [{}, {"origin_m": [0.0, 0.0, 0.9]}])
def test_garbage_is_counted_and_dropped(mount: dict[str, Any], wrong: float) -> None:
    device = OneReading(mount=mount)
    assert device._reading((wrong, 2.0, 3.0, 0.1, 0.2, 0.3)) is None
    assert device._reading((1.0, 2.0, 3.0, 0.1, 0.2, -wrong)) is None
    assert device.counters == {"not_finite": 2}
    good = device._reading((1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
    assert good is not None
    np.testing.assert_allclose(good.force, FORCE)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"orientation_wxyz": [1.0, 1.0, 0.0, 0.0]}, "length 1.414, not 1"),
        ({"orientation_wxyz": [0.0, 0.0, 0.0, 0.0]}, "length 0, not 1"),
        ({"orientation_wxyz": [float("nan"), 0.0, 0.0, 0.0]}, "length nan"),
        ({"origin_m": [0.0, float("inf"), 0.0]}, "not finite"),
        ({"origin_m": [50, 0, 0]}, r"origin_m \(50.0, 0.0, 0.0\) is 50 m .* metres, not mm"),
        ({"origin_m": [0.0, 0.0, -1.0]}, "metres, not mm"),
        ({"carries": "cup"}, "carries"),
    ],
)
def test_what_is_no_mount_is_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        mount(**options)
