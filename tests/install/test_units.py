"""The units are understood by systemd, as closed as they say, and reach what the profile needs."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tests.install import scores
from tests.install.scores import SCORE_MAX, plan_of_case
from tests.install.service_manager import UnitFile

from palpate.heartbeat import LIMIT_S
from palpate_deploy.install.needs import HostNeeds, needs_of
from palpate_deploy.station import supervision
from palpate_deploy.station.profile import parse_profile

Units = dict[str, Path]


@pytest.fixture
def units(case: str, tmp_path: Path) -> Units:
    """Unit files of a case by kind, ``palpate`` or ``palpate-fem``; their command is there."""
    found = {}
    for path, text in plan_of_case(case).files().items():
        if path.endswith(".service"):
            unit = tmp_path / Path(path).name
            unit.write_text(text.replace(scores.PROGRAM, "/bin/true"), encoding="utf-8")
            found[unit.name.partition("@")[0]] = unit
    return found


def test_systemd_understands_every_unit(units: Units) -> None:
    if scores.analyse() is None:
        pytest.skip("systemd-analyze is not installed")
    result = subprocess.run(
        [str(scores.analyse()), "verify", *map(str, units.values())],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stderr) == (0, "")


def test_every_unit_is_closed(units: Units) -> None:
    if scores.analyse() is None:
        pytest.skip("systemd-analyze is not installed")
    for unit in units.values():
        assert scores.score(unit) <= SCORE_MAX, unit.name
        # And by systemd's own judgement, so that a change of its output cannot hide a score.
        threshold = ["security", "--offline=true", f"--threshold={SCORE_MAX * 10:.0f}"]
        command = [str(scores.analyse()), *threshold, str(unit)]
        assert subprocess.run(command, capture_output=True, check=False).returncode == 0


def test_a_unit_that_is_open_is_found(units: Units) -> None:
    if scores.analyse() is None:
        pytest.skip("systemd-analyze is not installed")
    unit = units["palpate"]
    unit.write_text(unit.read_text("utf-8").replace("CapabilityBoundingSet=\n", ""))
    assert scores.score(unit) > SCORE_MAX


def test_only_finite_elements_may_write_code(case: str, units: Units) -> None:
    assert UnitFile.read(units["palpate"]).one("MemoryDenyWriteExecute") == "yes"
    assert ("palpate-fem" in units) == (case in ("elements", "everything"))
    if "palpate-fem" in units:
        station, solver = (UnitFile.read(units[kind]) for kind in ("palpate", "palpate-fem"))
        assert "fem" not in station.environment["PALPATE_PROCESSES"]
        assert solver.one("MemoryDenyWriteExecute", "no") == "no"
        # Otherwise it is as closed as the station, and reaches no device.
        for key in station.settings.keys() & solver.settings.keys():
            if key.startswith(("Protect", "Private", "Restrict", "Capability", "NoNew")):
                families = key == "RestrictAddressFamilies"
                assert families or station.one(key) == solver.one(key), key
        assert "AF_CAN" not in solver.one("RestrictAddressFamilies")
        assert solver.one("IPAddressAllow") == "localhost"
        assert solver.settings.get("DeviceAllow", []) == []
        assert solver.one("PrivateDevices") == "yes"


def test_what_the_profile_needs_is_let_through(case: str, units: Units) -> None:
    unit = UnitFile.read(units["palpate"])
    everything = case == "everything"
    assert ("AF_CAN" in unit.one("RestrictAddressFamilies")) == (case == "can" or everything)
    network = case == "network" or everything
    assert unit.one("IPAddressAllow") == ("localhost 192.168.1.1" if network else "localhost")
    serial = case == "serial" or everything
    assert unit.settings.get("DeviceAllow", []) == (
        ["char-ttyUSB rw", "char-ttyACM rw"] if serial else []
    )
    assert unit.one("SupplementaryGroups") == ("dialout" if serial else "")
    rules = [path for path in plan_of_case(case).files() if path.endswith(".rules")]
    assert rules == (["/etc/udev/rules.d/70-palpate-lab.rules"] if serial else [])


def test_address_that_a_driver_assumes_is_let_through() -> None:
    sensor = {"name": "w", "driver": "wrench_rdt", "options": {"product": "ati_net_ft"}}
    profile = parse_profile({"gateway": {"sensors": [sensor]}}, where="test")
    assert needs_of(profile) == HostNeeds(device_networks=("192.168.1.1",))


def test_multicast_bus_and_serial_server_are_let_through() -> None:
    bus = {"interface": "udp_multicast", "channel": "239.74.163.2"}
    server = {"port": "socket://10.0.0.7:4000", "rate_hz": 800}
    profile = parse_profile(
        {
            "gateway": {
                "sensors": [
                    {"name": "a", "driver": "biotac_can", "options": bus},
                    {"name": "b", "driver": "wrench_bota", "options": server},
                ]
            },
            "link": {"connect": ["tcp/10.0.0.8:7447"]},
        },
        where="test",
    )
    assert needs_of(profile) == HostNeeds(
        networks=("10.0.0.8",), device_networks=("239.74.163.2", "10.0.0.7")
    )


def test_gateway_may_stay_on_one_core(units: Units) -> None:
    unit = UnitFile.read(units["palpate"])
    assert unit.settings["SystemCallFilter"][-1] == "sched_setaffinity"
    assert unit.one("ProcSubset", "all") == "all"


def test_watchdog_waits_longer_than_an_answer_may_take(units: Units) -> None:
    for kind, unit in units.items():
        settings = UnitFile.read(unit)
        assert settings.one("Type") == "notify"
        limit_s = float(settings.one("WatchdogSec"))
        # `palpate up` may wait this long for an answer of supervisord, twice, before it gives up.
        assert limit_s > (2 * supervision._ANSWER_S if kind == "palpate" else LIMIT_S)
        # One that is stopped does not follow the signal: it must not have minutes for it.
        assert float(settings.one("TimeoutAbortSec")) <= 10


def test_every_process_has_its_time_to_stop(case: str, units: Units) -> None:
    processes = len(plan_of_case(case).supervised)
    stop_s = float(UnitFile.read(units["palpate"]).one("TimeoutStopSec"))
    assert stop_s > processes * supervision.STOP_WAIT_S
    assert UnitFile.read(units["palpate"]).one("KillMode") == "mixed"


def test_wrong_profile_is_not_started_again_and_again(units: Units) -> None:
    for unit in units.values():
        assert UnitFile.read(unit).one("RestartPreventExitStatus") == "2"


def test_a_station_is_tried_until_its_disk_has_room_again(units: Units) -> None:
    """A full disk ends each start within seconds: a limit of starts would be reached at once."""
    for unit in units.values():
        settings = UnitFile.read(unit)
        assert settings.one("Restart") == "on-failure"
        assert settings.one("StartLimitIntervalSec") == "0"


_DOUBLE = """
import ctypes, sys
PR_SET_MDWE = 65
if sys.argv[2:] and ctypes.CDLL(None).prctl(PR_SET_MDWE, 1, 0, 0, 0):
    sys.exit(77)
import numpy as np, warp as wp
wp.config.kernel_cache_dir, wp.config.quiet = sys.argv[1], True
@wp.kernel
def double(values: wp.array(dtype=float)):
    values[wp.tid()] = 2.0 * values[wp.tid()]
values = wp.array(np.ones(4, np.float32), device="cpu")
wp.launch(double, dim=4, inputs=[values], device="cpu")
assert values.numpy().tolist() == [2.0] * 4
"""


@pytest.mark.slow
def test_warp_cannot_do_without_writing_code(tmp_path: Path) -> None:
    """Should this fail one day, the unit of the finite elements can be closed further."""
    program = tmp_path / "double.py"
    program.write_text(_DOUBLE)
    command = [sys.executable, str(program), str(tmp_path)]
    free = subprocess.run(command, capture_output=True, text=True, check=False)
    if "No module named 'warp'" in free.stderr:
        pytest.skip("warp is not installed (extra fem)")
    assert free.returncode == 0, free.stderr
    for cached in tmp_path.glob("[0-9]*"):
        shutil.rmtree(cached)
    shut = subprocess.run([*command, "shut"], capture_output=True, text=True, check=False)
    if shut.returncode == 77:
        pytest.skip("this kernel has no PR_SET_MDWE")
    assert "Failed to find forward kernel" in shut.stderr
