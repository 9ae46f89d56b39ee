from __future__ import annotations

import pytest

from palpate.config import parse_config
from palpate.errors import ConfigError
from palpate_gateway.config import GatewayConfig


def test_defaults_are_one_virtual_finger() -> None:
    config = GatewayConfig()
    assert [(s.name, s.driver) for s in config.sensors] == [("finger", "virtual")]
    assert config.tare_frames == 50


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sensor": []}, r"unknown key 'sensor' -> did you mean 'sensors'"),
        ({"sensors": [{"nam": "a"}]}, r"unknown key 'sensors.0.nam' -> did you mean 'name'"),
        ({"sensors": []}, "sensors"),
        ({"sensors": [{"name": "a"}, {"name": "a"}]}, "sensor name 'a' is given twice"),
        ({"pace": "slow"}, "pace"),
        ({"tare_frames": 1}, "tare_frames"),
        ({"sensors": [{"name": "Left Hand"}]}, "Left Hand"),
    ],
)
def test_wrong_configuration_is_named(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_config(GatewayConfig, values, where="lab.toml [gateway]")
