"""A Debian in a folder, as a program inside sees it: own mounts, own network, own processes.

Run in namespaces of its own (``unshare --mount --net --pid --fork``), so that nothing of this
reaches the host, and no packet leaves it.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import socket
import stat
import struct
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

OUTSIDE = ("proc", "dev", "run", "tmp")
"""Folders that hold nothing of the image."""

PLAIN = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "LANG": "C.UTF-8"}


def mount(*words: str) -> None:
    """Mount a file system; a failure is an error."""
    subprocess.run(["mount", *words], check=True)


def enter(root: Path) -> None:
    """Mount what a program inside needs; bring loopback up."""
    mount("--make-rprivate", "/")
    mount("--bind", str(root), str(root))
    mount("-t", "proc", "proc", str(root / "proc"))
    for name in ("dev", "run", "tmp"):
        mount("-t", "tmpfs", "-o", "mode=0755", "tmpfs", str(root / name))
    (root / "tmp").chmod(0o1777)
    for name, minor in {"null": 3, "zero": 5, "full": 7, "random": 8, "urandom": 9}.items():
        os.mknod(root / "dev" / name, 0o666 | stat.S_IFCHR, os.makedev(1, minor))
        (root / "dev" / name).chmod(0o666)
    (root / "dev" / "fd").symlink_to("/proc/self/fd")
    (root / "dev" / "shm").mkdir(mode=0o1777)
    (root / "dev" / "shm").chmod(0o1777)
    _loopback_up()


def _loopback_up() -> None:
    up, get, put = 1, 0x8913, 0x8914  # IFF_UP, SIOCGIFFLAGS, SIOCSIFFLAGS
    with socket.socket() as any_socket:
        asked = struct.pack("16sh14x", b"lo", 0)
        flags = struct.unpack("16sh14x", fcntl.ioctl(any_socket, get, asked))[1]
        fcntl.ioctl(any_socket, put, struct.pack("16sh14x", b"lo", flags | up))


def read_only(root: Path, writable: Sequence[Path]) -> None:
    """Make the image read-only, but for some folders, as ``ProtectSystem=strict`` does."""
    for folder in writable:
        mount("--bind", str(folder), str(folder))
    mount("-o", "remount,bind,ro", str(root))


def writable_again(root: Path, folders: Sequence[Path]) -> None:
    """Undo ``read_only``."""
    mount("-o", "remount,bind,rw", str(root))
    for folder in folders:
        subprocess.run(["umount", str(folder)], check=True)


def inside(
    root: Path,
    command: Sequence[str],
    variables: Mapping[str, str] | None = None,
    *,
    user: int = 0,
    folder: str = "/",
) -> list[str]:
    """The command line that runs a command in the image, as root or as a user without rights."""
    line = ["chroot", str(root)]
    if user:
        line += ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups"]
        line += ["--no-new-privs", "--bounding-set=-all"]
    line += ["env", "-i", f"--chdir={folder}"]
    line += [f"{key}={value}" for key, value in {**PLAIN, **(variables or {})}.items()]
    return [*line, *command]


def contents(root: Path) -> dict[str, str]:
    """Every file, folder and link of the image, with type, rights, owner and content."""
    found = {}
    for folder, folders, files in os.walk(root):
        here = Path(folder)
        if here == root:
            folders[:] = [name for name in folders if name not in OUTSIDE]
        for name in (*folders, *files):
            path = here / name
            status = path.lstat()
            what = f"{stat.filemode(status.st_mode)} {status.st_uid}:{status.st_gid}"
            if stat.S_ISREG(status.st_mode):
                what += " " + hashlib.sha256(path.read_bytes()).hexdigest()
            elif stat.S_ISLNK(status.st_mode):
                what += f" -> {path.readlink()}"
            found["/" + path.relative_to(root).as_posix()] = what
    return found


def difference(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Paths that are new, gone or changed, marked ``+``, ``-``, ``~``."""
    lines = [f"+ {path}" for path in after.keys() - before.keys()]
    lines += [f"- {path}" for path in before.keys() - after.keys()]
    lines += [f"~ {path}" for path in before.keys() & after.keys() if before[path] != after[path]]
    return sorted(lines, key=lambda line: line[2:])


def copy(source: Path, target: Path) -> None:
    """A copy of an image, with owners and rights."""
    shutil.rmtree(target, ignore_errors=True)
    subprocess.run(["cp", "--archive", "--reflink=auto", str(source), str(target)], check=True)
