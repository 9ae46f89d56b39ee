"""A station goes on when the disk of its folders is full, and works in folders of any name."""

from __future__ import annotations

import errno
import io
import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest

from palpate_deploy.station import supervision
from palpate_deploy.station.host import new_run_folder, private_profile
from palpate_deploy.station.lifetime import start_child
from palpate_deploy.station.supervision import ProcessState
from palpate_deploy.station.up import _LossyConsole, _print_changes

WaitUntil = Callable[[Callable[[], bool], float, str], float]

FULL = Path("/dev/full")
PATIENCE_S = 60.0
LOGS = ("supervisord", "router", "gateway")


@pytest.mark.slow
def test_a_folder_may_have_any_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wait_until: WaitUntil
) -> None:
    """For supervisord `` #`` and `` ;`` begin a comment, and ``%`` an expansion."""
    folder = tmp_path / "Lab #2 ;50 %(x)s "
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(folder / "state #1"))
    profile = private_profile("virtual").model_copy(update={"processes": ("router",)})
    with supervision.Supervisor(profile, "lab ;2 #3") as supervisor:
        wait_until(lambda: supervisor.processes()[0].served, PATIENCE_S, "the router serves")
        assert Path(f"/proc/{supervisor.processes()[0].pid}/cwd").readlink() == folder
        assert (supervisor.logs / "router.log").exists()
        assert supervisor.logs.is_relative_to(folder)


@pytest.mark.slow
@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_logs_on_a_full_disk_do_not_end_the_processes(
    monkeypatch: pytest.MonkeyPatch, wait_until: WaitUntil
) -> None:
    def full_folder(name: str) -> Path:
        folder = new_run_folder(name)
        for log in LOGS:
            (folder / "logs" / f"{log}.log").symlink_to(FULL)
        return folder

    def start_mute(
        command: Sequence[str], _: Path, variables: Mapping[str, str]
    ) -> subprocess.Popen[bytes]:
        return start_child(command, FULL, variables)

    monkeypatch.setattr(supervision, "new_run_folder", full_folder)
    monkeypatch.setattr(supervision, "start_child", start_mute)
    profile = private_profile("virtual", log={"level": "debug"})
    profile = profile.model_copy(update={"processes": ("router", "gateway")})
    with supervision.Supervisor(profile, "full") as supervisor:
        wait_until(
            lambda: all(one.served for one in supervisor.processes()),
            PATIENCE_S,
            "all processes serve",
        )
        assert [one.restarts for one in supervisor.processes()] == [0, 0]
    assert supervisor._process.returncode == 0


class FullFile(io.StringIO):
    """A text file that takes nothing while its disk is full."""

    full = True

    def write(self, text: str) -> int:
        if self.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(text)


def test_output_into_a_file_on_a_full_disk_ends_nothing() -> None:
    """As in ``nohup palpate up > up.log``; what comes once there is room is written."""
    one = ProcessState("gateway", "RUNNING", 10, 900.0, 0, 0, True, 0, "")
    file = FullFile()
    console = _LossyConsole(file=file, width=160)
    _print_changes(console, [one], {})
    file.full = False
    console.print("stopping ...")
    assert file.getvalue() == "stopping ...\n"
