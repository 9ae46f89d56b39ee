"""From poses of the flange to poses of the tip, for both ways in which a robot can press."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from palpate.config import parse_config
from palpate.errors import ConfigError
from palpate.messages import Pose
from palpate.rigid import compose, inverse
from palpate_gateway.pose.placement import Placement, PlacementOptions

fakes: Any = importlib.import_module("pose_fakes")
matrix, poses, NEAR = fakes.matrix, fakes.poses, fakes.NEAR
HALF = math.sqrt(0.5)
STRAIGHT = (1.0, 0.0, 0.0, 0.0)


def table(pose: Pose) -> dict[str, Any]:
    return {"position_m": pose.position, "orientation_wxyz": pose.orientation}


def placement(**options: Any) -> Placement:
    tables = {k: table(v) if isinstance(v, Pose) else v for k, v in options.items()}
    values = {"indenter": "sphere_7mm", **tables}
    return Placement(parse_config(PlacementOptions, values, where="test"))


def test_a_robot_presses_straight_down_on_a_finger_that_lies_on_its_back() -> None:
    # The finger's nail is on the table: its z points down, so half a turn about x takes it there.
    finger = Pose((0.4, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0))
    tool = Pose((0.0, 0.0, 0.12), STRAIGHT)
    # The flange looks down, too, and stands 0.12 + 0.011 m above the finger's origin, 4 mm aside.
    flange = Pose((0.404, 0.0, 0.231), (0.0, 1.0, 0.0, 0.0))
    tip = placement(base_sensor=finger, flange_indenter=tool).tip(flange)
    # 4 mm distal and 11 mm ventral (below the pad), pressing along +z of the sensor frame.
    assert tip.position == pytest.approx((0.004, 0.0, -0.011), abs=NEAR)
    assert tip.orientation == pytest.approx(STRAIGHT, abs=NEAR)
    deeper = Pose((0.404, 0.0, 0.230), flange.orientation)
    tip = placement(base_sensor=finger, flange_indenter=tool).tip(deeper)
    assert tip.position == pytest.approx((0.004, 0.0, -0.010), abs=NEAR)


def test_a_robot_moves_the_finger_against_a_pin() -> None:
    # The finger's frame is that of the flange, 50 mm out; the pin stands upright at the base.
    mount = Pose((0.0, 0.0, 0.05), STRAIGHT)
    pin = Pose((0.3, 0.0, 0.0), STRAIGHT)
    device = placement(carries="biotac", flange_sensor=mount, base_indenter=pin)
    # With a flange that is turned a quarter about z, y of the base is x of the sensor.
    flange = Pose((0.3, -0.005, -0.04), (HALF, 0.0, 0.0, HALF))
    tip = device.tip(flange)
    assert tip.position == pytest.approx((0.005, 0.0, -0.01), abs=NEAR)
    assert tip.orientation == pytest.approx((HALF, 0.0, 0.0, -HALF), abs=NEAR)


@given(poses(), poses(), poses())
def test_a_carried_indenter_is_where_the_chain_was_made_to_end(
    base_sensor: Pose, flange_indenter: Pose, tip: Pose
) -> None:
    base_flange = compose(compose(base_sensor, tip), inverse(flange_indenter))
    device = placement(base_sensor=base_sensor, flange_indenter=flange_indenter)
    np.testing.assert_allclose(matrix(device.tip(base_flange)), matrix(tip), atol=10 * NEAR)


@given(poses(), poses(), poses())
def test_a_carried_finger_sees_the_tip_where_the_chain_was_made_to_end(
    flange_sensor: Pose, base_indenter: Pose, tip: Pose
) -> None:
    base_flange = compose(compose(base_indenter, inverse(tip)), inverse(flange_sensor))
    device = placement(carries="biotac", flange_sensor=flange_sensor, base_indenter=base_indenter)
    np.testing.assert_allclose(matrix(device.tip(base_flange)), matrix(tip), atol=10 * NEAR)


def test_quaternions_with_few_digits_are_normalised() -> None:
    rough = (0.7071, 0.0, 0.7071, 0.0)
    device = placement(
        base_sensor=Pose((0.0, 0.0, 0.0), rough), flange_indenter=Pose((0.0, 0.0, 0.1), rough)
    )
    tip = device.tip(Pose((0.1, 0.2, 0.3), rough))
    assert math.hypot(*tip.orientation) == pytest.approx(1.0, abs=1e-15)
    reading = device.reading(Pose((0.1, 0.2, 0.3), rough), tick=4, time_s=0.5, missed_before=2)
    assert reading.indenter == "sphere_7mm"
    assert (reading.tick, reading.time_s, reading.missed_before) == (4, 0.5, 2)
    assert reading.in_contact is None, "a robot does not know what it touches"
    np.testing.assert_array_equal(reading.position, tip.position)
    assert reading.position.dtype == reading.orientation.dtype == np.float64


GOOD = {
    "base_sensor": {"position_m": [0, 0, 0], "orientation_wxyz": [1, 0, 0, 0]},
    "flange_indenter": {"position_m": [0, 0, 0.1], "orientation_wxyz": [1, 0, 0, 0]},
    "indenter": "cube",
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"indenter": None}, "indenter"),
        ({"indenter": ""}, "1-64 printable ASCII"),
        ({"base_sensor": None}, "base_sensor is missing: where the robot carries the indenter"),
        ({"flange_sensor": GOOD["base_sensor"]}, "flange_sensor is not used"),
        ({"carries": "biotac"}, "give flange_sensor and base_indenter"),
        ({"carries": "finger"}, "carries"),
        ({"base_sensor": {"position_m": [0, 0, 0]}}, "base_sensor.orientation_wxyz' is missing"),
        (
            {"base_sensor": {"position_m": [0, 0, 0], "orientation_wxyz": [1, 1, 0, 0]}},
            "has length 1.414, not 1",
        ),
        (
            {"base_sensor": {"position_m": [0, math.nan, 0], "orientation_wxyz": [1, 0, 0, 0]}},
            "is not finite",
        ),
        (
            {"base_sensor": {"position_m": [410, 0, 130], "orientation_wxyz": [1, 0, 0, 0]}},
            "give metres, not mm",
        ),
        ({"base_sensors": {}}, "did you mean 'base_sensor'"),
    ],
)
def test_wrong_options_are_named(changes: dict[str, Any], message: str) -> None:
    values = {k: v for k, v in {**GOOD, **changes}.items() if v is not None}
    with pytest.raises(ConfigError, match=message):
        parse_config(PlacementOptions, values, where="test")
