"""An install or uninstall that is killed at any step, meets another one, or finds the disk full."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.install.conftest import PROGRAM, Install
from tests.install.image import contents, difference

from palpate_deploy.install import service
from palpate_deploy.install.ledger import Host, InstallError
from palpate_deploy.install.plan import InstallOrder

pytestmark = pytest.mark.slow

_STEPS = {
    "open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.chmod", "os.link", "os.symlink",
    "shutil.rmtree",
}  # fmt: skip
"""What Python tells an audit hook before it changes a file system."""

_STEPS_MAX = 300


def killed_at(step: int, root: Path, act: Callable[[], object]) -> bool:
    """Run ``act`` in a child that is killed before its n-th step below ``root``; whether it was."""
    child = os.fork()
    if child == 0:
        left = step

        def hook(event: str, arguments: tuple[object, ...]) -> None:
            nonlocal left
            if event in _STEPS and str(root) in str(arguments[0]):
                if left == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                left -= 1

        try:
            sys.stdout = open(os.devnull, "w")
            sys.addaudithook(hook)
            act()
        except BaseException:
            os._exit(3)
        os._exit(0)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, -signal.SIGKILL), f"step {step}: it ended with {status}"
    return status != 0


def _first(root: Path, profile: Path) -> None:
    service.install(InstallOrder(str(profile), "", root, PROGRAM))


def _upgrade(root: Path, profile: Path) -> None:
    service.install(InstallOrder(str(profile), "", root, "/opt/palpate-2/bin/palpate"))


def _roll_back(root: Path, profile: Path) -> None:
    service.roll_back("lab", root)


def _remove(root: Path, profile: Path) -> None:
    service.uninstall("lab", root, purge=False)


def _purge(root: Path, profile: Path) -> None:
    with contextlib.suppress(InstallError):  # a killed one had come to its end
        service.uninstall("lab", root, purge=True)


Act = Callable[[Path, Path], None]


@pytest.mark.parametrize(
    ("earlier", "killed"),
    [
        ([], _first),
        ([_first], _upgrade),
        ([_first, _upgrade], _roll_back),
        ([_first], _remove),
        ([_first], _purge),
    ],
    ids=["install", "upgrade", "rollback", "uninstall", "purge"],
)
@pytest.mark.parametrize("then", [_first, _upgrade, _purge], ids=["install", "upgrade", "purge"])
def test_whatever_comes_after_a_kill_works(
    root: Path, profile: Path, tmp_path: Path, earlier: list[Act], killed: Act, then: Act
) -> None:
    """Killed before every step: each of the three commands that follow is tried at a third."""
    bare = contents(root)
    for act in earlier:
        act(root, profile)
    (root / "var/lib/palpate/lab/runs").mkdir(parents=True)
    (root / "var/lib/palpate/lab/runs/lab-1.mcap").write_text("data")
    ready = tmp_path / "ready"
    shutil.copytree(root, ready, symlinks=True)
    expected = {}
    for name, chain in {"not killed": [], "done": [killed]}.items():
        shutil.rmtree(root)
        shutil.copytree(ready, root, symlinks=True)
        for act in (*chain, then):
            act(root, profile)
        expected[name] = _installed(root)
    commands: tuple[Act, ...] = (_first, _upgrade, _purge)
    for step in range(commands.index(then), _STEPS_MAX, 3):
        shutil.rmtree(root)
        shutil.copytree(ready, root, symlinks=True)
        if not killed_at(step, root, lambda: killed(root, profile)):
            break
        then(root, profile)
        found = [difference(one, _installed(root)) for one in expected.values()]
        assert [] in found, f"killed before step {step}: {found}"
        assert not [path for path in contents(root) if "palpate-new" in path or ".next" in path]
        _purge(root, profile)
        assert difference(bare, contents(root)) == [], f"killed before step {step}"
    assert 5 < step < _STEPS_MAX - 3


def _installed(root: Path) -> dict[str, str]:
    """What is there, but for records, and for the ledger, which also holds what was before."""
    hidden = ("/etc/palpate/installed/", "/var/lib/palpate")
    return {path: what for path, what in contents(root).items() if not path.startswith(hidden)}


def test_recordings_survive_every_killed_upgrade(root: Path, profile: Path, tmp_path: Path) -> None:
    _first(root, profile)
    record = root / "var/lib/palpate/lab/runs/lab-1.mcap"
    record.parent.mkdir(parents=True)
    record.write_text("data")
    ready = tmp_path / "ready"
    shutil.copytree(root, ready, symlinks=True)
    for step in range(_STEPS_MAX):
        shutil.rmtree(root)
        shutil.copytree(ready, root, symlinks=True)
        killed = killed_at(step, root, lambda: _upgrade(root, profile))
        assert record.read_text() == "data", f"killed before step {step}"
        if not killed:
            break
        _upgrade(root, profile)
        assert record.read_text() == "data", f"upgraded after a kill before step {step}"
    assert 30 < step < _STEPS_MAX - 3


def test_a_second_install_at_once_is_refused(root: Path, install: Install) -> None:
    with Host(root).locked():
        for act in (install, lambda: service.uninstall("lab", root, purge=True)):
            with pytest.raises(InstallError, match="another palpate install"):
                act()
    install()


def test_many_at_once_leave_one_whole_installation(root: Path, profile: Path) -> None:
    before = contents(root)
    children = []
    for number in range(24):
        child = os.fork()
        if child == 0:
            sys.stdout = open(os.devnull, "w")
            status = 3
            try:
                if number % 3:
                    (_first, _upgrade)[number % 2](root, profile)
                else:
                    service.uninstall("lab", root, purge=True)
                status = 0
            except InstallError:  # another one works, or there is nothing to remove
                status = 1
            except BaseException:
                import traceback

                traceback.print_exc()
            os._exit(status)
        children.append(child)
    ended = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    assert set(ended) <= {0, 1}
    assert 0 in ended
    _first(root, profile)
    assert PROGRAM in (root / "etc/systemd/system/palpate@lab.service").read_text("utf-8")
    _purge(root, profile)
    assert difference(before, contents(root)) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a disk")
def test_disk_that_is_mounted_among_the_records_is_not_emptied(
    root: Path, install: Install
) -> None:
    install()
    runs = root / "var/lib/palpate/lab/my runs"
    runs.mkdir(parents=True)
    program = f"""
import os
from pathlib import Path
from palpate_deploy.install import service
from palpate_deploy.install.ledger import InstallError
runs = Path({str(runs)!r})
assert os.system(f"mount -t tmpfs tmpfs '{{runs}}'") == 0
(runs / "lab-1.mcap").touch()
try:
    service.uninstall("lab", Path({str(root)!r}), purge=True)
except InstallError as error:
    assert "would be emptied" in error.problem, error
else:
    raise AssertionError("it was emptied")
assert (runs / "lab-1.mcap").exists()
"""
    _in_a_mount_namespace(program)
    assert (root / "etc/palpate/lab.toml").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")
def test_full_disk_leaves_all_as_it_was(tmp_path: Path, profile: Path) -> None:
    """A disk of 160 kB in a mount namespace, filled but for ever more pages."""
    program = f"""
import os, sys
from pathlib import Path
from palpate_deploy.install import service
from palpate_deploy.install.ledger import InstallError
from palpate_deploy.install.plan import InstallOrder
from tests.install.image import contents, difference
disk = Path({str(tmp_path / "disk")!r})
failed = 0
for pages in range(40):
    os.system(f"mount -t tmpfs -o size=160k,mode=755 tmpfs {{disk}}")
    for folder in ("etc/systemd/system", "var/lib"):
        (disk / folder).mkdir(parents=True)
    if pages % 2:
        service.install(InstallOrder({str(profile)!r}, "", disk, "/old/palpate"))
    block = disk / "block"
    handle = os.open(block, os.O_WRONLY | os.O_CREAT)
    try:
        while True:
            os.write(handle, bytes(4096))
    except OSError:
        os.close(handle)
    os.truncate(block, max(0, block.stat().st_size - 4096 * (pages // 2)))
    before = contents(disk)
    try:
        service.install(InstallOrder({str(profile)!r}, "", disk, {PROGRAM!r}))
    except InstallError as error:
        assert "make room" in error.remedy, error
        failed += 1
        assert difference(before, contents(disk)) == [], (pages, difference(before, contents(disk)))
    os.system(f"umount {{disk}}")
assert 4 < failed < 38, failed
"""
    (tmp_path / "disk").mkdir()
    _in_a_mount_namespace(program)


def _in_a_mount_namespace(program: str) -> None:
    done = subprocess.run(
        ["unshare", "--mount", sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).resolve().parents[2],
    )
    if "unshare failed" in done.stderr:
        pytest.skip("no mount namespace here")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
