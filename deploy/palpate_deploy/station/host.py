"""What a run needs of this host: free ports, room on a disk, a folder for its profile and logs."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import socket
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import tomli_w

from palpate.bus import Session
from palpate.config import Role, endpoint_host_port
from palpate.errors import ConfigError, ErrorCode, LinkError, PalpateError, RecordingError
from palpate.process import state_folder
from palpate_deploy.station.profile import Profile, changed, load_profile, plain_values


class RunDiskError(PalpateError, OSError):
    """A disk has no room for the files of a run; where one is made, the run can be started."""

    code = ErrorCode.DISK


def check_free(endpoints: Iterable[str]) -> None:
    """Check that a router can listen there.

    Raises:
        LinkError: A port is in use, or the address is not this host's.
    """
    for endpoint in endpoints:
        host, port = endpoint_host_port(endpoint)
        if port == 0:
            continue
        try:
            _bind(host, port)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                here, _, _ = endpoint.rpartition(":")
                other = port + 1 if port < 65535 else 7447
                raise LinkError(
                    f"{endpoint.partition('/')[2]} is in use",
                    remedy="another `palpate up`? Look with `palpate status --connect "
                    f"{endpoint}`, or choose another port and name: station and [router] listen in "
                    f"the profile, or PALPATE_ROUTER__LISTEN='[\"{here}:{other}\"]' with "
                    "PALPATE_STATION=NAME",
                ) from error
            raise LinkError(
                f"the router cannot listen at {endpoint}: {error.strerror or error}",
                remedy="set [router] listen to an address of this host",
            ) from error


@contextlib.contextmanager
def names_taken(profile: Profile) -> Iterator[None]:
    """Take the names of a profile's processes on this host, for the time of the block.

    Two of one name would overwrite what each remembers of its models.

    Raises:
        LinkError: A process of that name runs here already, for a station of the same name.
    """
    folder = profile.models.memory_folder / "stations" / profile.station
    with contextlib.ExitStack() as taken:
        for service in profile.processes:
            name = profile.instance(service)
            try:
                folder.mkdir(parents=True, exist_ok=True, mode=0o700)
                file = taken.enter_context(open(folder / f"{name}.running", "ab"))
                # The kernel gives it back when this process ends, however it does.
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise LinkError(
                    f"station {profile.station!r} runs already on this host, or on another that "
                    f"shares {folder}: its {name}",
                    remedy="look with `palpate status`, and stop it; or give this one another "
                    "name: station in the profile, or a spare's replica",
                ) from error
            except OSError:
                pass  # where nothing can be written, nothing is overwritten
        yield


def check_room(out: Path, least: int) -> None:
    """Check that a recorder, which pauses below ``least`` free bytes, can write to a folder.

    Raises:
        RecordingError: It would pause from its first message on.
    """
    from palpate_services.recorder.writer import free_bytes  # slow to import

    folder = out.absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if (free := free_bytes(existing)) < least:
        raise RecordingError(
            f"{out} has {free / 1e6:,.0f} MB free, a record needs {least / 1e6:,.0f} MB",
            remedy="free some space, or record to a folder on another disk: --out",
        )


def free_endpoint() -> str:
    """A loopback endpoint at which nothing listens at present."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def private_profile(name: str, **tables: Mapping[str, Any]) -> Profile:
    """A shipped profile, its router at a free port: independent of any station of this host.

    What its namesake among the user's stations was told to serve does not matter, either.

    Raises:
        ConfigError: A value of ``tables``, which replace keys as in ``changed``, is wrong.
    """
    here = (free_endpoint(),)
    own = {"models": {"state": str(state_folder() / "private")}, **tables}
    link = {"connect": here, **tables.get("link", {})}
    own |= {"link": link}
    return changed(load_profile(name), router={"listen": here}, **own)


def join(profile: Profile, *, wait_s: float, role: Role = Role.SERVICE) -> Session:
    """Join a profile's station; ``wait_s`` is the wait for its router [s], negative = no limit.

    Raises:
        ConfigError: Its folder of certificates has none for the role.
        LinkError: There is no router.
    """
    link = profile.link.as_role(role).model_copy(update={"wait_for_router_s": wait_s})
    return Session.open(link, station=profile.station)


def _bind(host: str, port: int) -> None:
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    with socket.socket(family, kind, protocol) as probe:
        # As the router does: without it a port stays taken for a while after its last use.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(address)
        probe.listen(1)


KEPT_RUNS = 20
"""Older folders are removed; records are never stored there."""


RUN_LOCK = "running"
"""File in the folder of a run that its process holds locked: another one may have its id later."""


_locks: dict[Path, int] = {}
"""Descriptors of the locks that this process holds, by folder."""


def new_run_folder(name: str) -> Path:
    """Make an empty folder for a run, and remove those of the oldest runs.

    The run lasts until ``end_run``, or the end of this process.

    Raises:
        ConfigError: The folder cannot be made.
        RunDiskError: The disk is full.
    """
    runs = state_folder() / "runs"
    stamp = time.strftime("%Y%m%d-%H%M%S")
    folder = runs / f"{stamp}-{name}-{os.getpid()}"
    lock = -1
    try:
        (folder / "logs").mkdir(parents=True, mode=0o700)
        # The kernel gives the lock back when this process ends, however it does.
        lock = os.open(folder / RUN_LOCK, os.O_CREAT | os.O_WRONLY, 0o600)
        fcntl.flock(lock, fcntl.LOCK_EX)
        _locks[folder] = lock
    except OSError as error:
        if lock >= 0:
            os.close(lock)
        # Without a lock it would count as a run for as long as this process runs.
        if not isinstance(error, FileExistsError):  # that one is another run's
            shutil.rmtree(folder, ignore_errors=True)
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise _no_room(folder, error) from error
        raise ConfigError(
            f"run folder {folder} cannot be made: {error.strerror or error}",
            remedy="set XDG_STATE_HOME to a folder you may write in",
        ) from error
    for old in sorted(path for path in runs.iterdir() if path.is_dir())[:-KEPT_RUNS]:
        if not _in_use(old):
            shutil.rmtree(old, ignore_errors=True)
    return folder


def end_run(folder: Path) -> None:
    """Say that a run of this process has ended; may be repeated. Its folder stays."""
    if (lock := _locks.pop(folder, None)) is not None:
        os.close(lock)


def running_folders() -> list[Path]:
    """Folders of the runs that have not ended, oldest first."""
    runs = state_folder() / "runs"
    try:
        return sorted(path for path in runs.iterdir() if path.is_dir() and _in_use(path))
    except OSError:
        return []


def run_pid(folder: Path) -> int:
    """Id at the end of a run folder's name, of who made it; 0 = it was made by something else."""
    pid = folder.name.rpartition("-")[2]
    return int(pid) if pid.isdigit() else 0


def _in_use(folder: Path) -> bool:
    """Whether the run of a folder has not ended, and the process that made it still runs."""
    try:
        with open(folder / RUN_LOCK, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        pass  # of an older palpate, or made by something else
    except OSError:
        return True
    else:
        return False
    pid = run_pid(folder)
    if not pid:
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def write_profile(profile: Profile, folder: Path) -> Path:
    """Write the resolved profile that all processes of a run read.

    Raises:
        RunDiskError: The disk refuses.
    """
    return write_run_file(folder / "profile.toml", tomli_w.dumps(plain_values(profile)))


def write_run_file(path: Path, text: str) -> Path:
    """Write a file into the folder of a run; the path again.

    Raises:
        RunDiskError: The disk refuses.
    """
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise _no_room(path, error) from error
    return path


def _no_room(path: Path, error: OSError) -> RunDiskError:
    return RunDiskError(
        f"{path} cannot be written: {error.strerror or error}",
        remedy="free some space there, or set XDG_STATE_HOME to a folder of another disk",
    )
