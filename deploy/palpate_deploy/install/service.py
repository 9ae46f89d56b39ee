"""``palpate install`` and ``palpate uninstall``: a station as a service of a host."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from palpate.config import TLS_FILES, TlsConfig
from palpate.errors import ConfigError, PalpateError
from palpate_deploy.install.ledger import (
    Books,
    Edition,
    Found,
    Host,
    InstallError,
    Ledger,
    is_half_way,
    ledger_of,
    paths_of,
)
from palpate_deploy.install.plan import (
    InstallOrder,
    check_program,
    checked_name,
    make_plan,
    present_version,
    program_of,
)
from palpate_deploy.install.units import (
    CACHES_FOLDER,
    STATES_FOLDER,
    UNITS_FOLDER,
    ServicePlan,
    profile_path,
    roles_of,
)
from palpate_deploy.station import profile as profiles
from palpate_deploy.station.host import check_free


def show_plan(order: InstallOrder) -> None:
    """Print every file that an install would write, and then what would stop it; needs no rights.

    Raises:
        ConfigError: Profile, name or program are wrong.
        InstallError: A file of somebody else is in the way.
        LinkError: On a first install: the router's port is in use.
        MissingExtraError: A process needs a package that is not installed.
    """
    host = Host(order.root)
    with _errors_translated():
        old, unknown = Ledger(), ""
        try:
            old = ledger_of(host, order.station)
            if is_half_way(host, order.station):
                unknown = "an install was killed half-way; the next one undoes it first"
        except PermissionError:
            unknown = "only root may read it"
        order, plan, texts = _planned(order, old)
        for path, text in texts.items():
            print(f"# ---- {path}\n{text}")
        check_program(order)
        if unknown:
            print(f"not compared with what is installed: {unknown}", file=sys.stderr)
        else:
            _check_host(host, old, order, plan, texts)


def install(order: InstallOrder) -> None:
    """Install a station, or bring an installed one up to date, and say what was done.

    Raises:
        ConfigError: Profile, name or program are wrong.
        InstallError: No rights, a file of somebody else is in the way, another install runs.
        LinkError: On a first install: the router's port is in use.
        MissingExtraError: A process needs a package that is not installed.
    """
    _check_rights(order.root)
    check_program(order)
    with _errors_translated(), Host(order.root).locked() as host:
        books = _open(host, order.station)
        old = books.read()
        order, plan, texts = _planned(order, old)
        edition = Edition.of(present_version(), plan.program, order.allowed, texts)
        _check_host(host, old, order, plan, texts)
        if edition == old.now and all(
            host.look(path, {text}) is Found.OURS for path, text in texts.items()
        ):
            print(f"station {order.station!r} is installed as it is: nothing has changed")
        else:
            _change(books, Ledger(now=edition, before=old.now), plan.main_unit)
    _say_what_next(plan, host, upgraded=old.now is not None)


def _planned(order: InstallOrder, old: Ledger) -> tuple[InstallOrder, ServicePlan, dict[str, str]]:
    """The order with what an earlier one allowed, its plan, and the text of each file."""
    if old.now is not None and not order.allowed:
        order = dataclasses.replace(order, allowed=old.now.allowed)
    name = order.station
    plan, profile = make_plan(order, STATES_FOLDER / name, program_of(order))
    return order, plan, {str(profile_path(name)): profile, **plan.files()}


def _check_host(
    host: Host, old: Ledger, order: InstallOrder, plan: ServicePlan, texts: dict[str, str]
) -> None:
    _check_nothing_in_the_way(host, old, texts, profiles.profile_path(order.profile))
    if host.is_this_host:
        _check_this_host(plan.profile, first=old.now is None)


def roll_back(name: str, root: Path) -> None:
    """Restore what was installed before the last change; a second time undoes the first.

    Raises:
        InstallError: There is nothing to go back to, or it cannot run.
    """
    checked_name(name)
    _check_rights(root)
    with _errors_translated(), Host(root).locked() as host:
        books = _open(host, name)
        old = books.read()
        if old.now is None or old.before is None:
            raise InstallError(
                f"there is nothing before what is installed as {name!r}",
                remedy="palpate install with another profile, or by another version's palpate",
            )
        _check_nothing_in_the_way(host, old, old.before.texts, None)
        if host.is_this_host:
            _check_runs(old.before)
        main, *_ = (path for path in old.before.texts if path.endswith(".service"))
        unit = Path(main).name
        # One that was there may have been disabled by a person.
        enable = "" if main in old.now.texts else unit
        _change(books, Ledger(now=old.before, before=old.now), enable)
        print(f"  palpate {old.before.palpate} again, by {old.before.program}")
    print(f"next: systemctl restart {unit}")


def uninstall(name: str, root: Path, *, purge: bool) -> int:
    """Remove what was installed; the exit code.

    The profile, and what a person has changed, stay, as do recordings and models. ``purge``
    removes these, too.

    Raises:
        InstallError: No such station, no rights, another install runs.
    """
    checked_name(name)
    _check_rights(root)
    with _errors_translated(), Host(root).locked() as host:
        books = _open(host, name)
        ledger = books.read()
        data = [path for path in _folders_of(name, STATES_FOLDER) if os.path.lexists(host.at(path))]
        if ledger == Ledger() and not (purge and data):
            raise InstallError(
                f"station {name!r} is not installed",
                remedy=f"installed: {', '.join(host.stations()) or 'none'}"
                + (f"; --purge removes {data[0]}" if data else ""),
            )
        if purge:
            _check_no_mounts(host, data)
        _stop(host, [Path(path).name for path in paths_of(name) if path.endswith(".service")])
        kept = _remove_files(host, name, ledger, purge=purge)
        _remove_folders(host, name, CACHES_FOLDER)
        if purge:
            _remove_folders(host, name, STATES_FOLDER)
            for path in data:
                print(f"removed {path}")
        if kept:
            books.keep(Ledger(kept=kept, folders=ledger.folders))
        else:
            books.close()
            if not host.stations():
                host.remove_empty(ledger.folders)
        _reload(host)
    if not purge:
        for path in data:
            print(f"kept    {path} (recordings, models)")
    if kept or (data and not purge):
        print("  -> --purge removes these, too")
    return 1 if kept and purge else 0


def _open(host: Host, name: str) -> Books:
    books = Books(host, name)
    if books.undone:
        print("undone: an earlier install that was killed half-way")
    return books


def _change(books: Books, ledger: Ledger, enable: str) -> None:
    """Make a change and say which files it wrote; ``enable`` is started with the host."""
    host, old, now = books.host, books.read(), ledger.now
    assert now is not None
    gone = [] if old.now is None else sorted(old.now.texts.keys() - now.texts.keys())

    def tell_systemd() -> None:
        _reload(host)
        if enable and host.is_running:
            _systemctl("enable", "--quiet", enable)
        # Last: the undoing of a change starts nothing again.
        _stop(host, [Path(path).name for path in gone if path.endswith(".service")])

    try:
        books.change(ledger, tell_systemd)
    except BaseException:
        with contextlib.suppress(InstallError):  # the first error tells more
            _reload(host)
        raise
    if gone:
        _reload(host)
    for path in now.texts:
        print(f"wrote   {path}")
    for path in gone:
        print(f"removed {path}")


def _check_rights(root: Path) -> None:
    if root.resolve() == Path("/") and os.geteuid() != 0:
        raise InstallError(
            "only root may write the units of this host",
            remedy="use sudo; or look first with --dry-run",
        )


def _check_this_host(profile: profiles.Profile, *, first: bool) -> None:
    """Check what the units would fail on at once: a port in use, a certificate that is missing."""
    if first and "router" in profile.processes:
        check_free(profile.router.listen)
    if profile.link.certificates is not None:
        for role in roles_of(profile):
            TlsConfig.of_folder(profile.link.certificates / role)
    for key in () if profile.link.tls is None else TLS_FILES:
        path = getattr(profile.link.tls, key)
        if not path.is_file():
            raise ConfigError(f"{path} does not exist", remedy="set [link.tls]")


def _check_nothing_in_the_way(
    host: Host, old: Ledger, texts: dict[str, str], source: Path | None
) -> None:
    """Check that every file to be written, or to go, is absent or as an install has written it."""
    gone = {} if old.now is None else old.now.texts
    for path in dict.fromkeys((*texts, *gone)):
        found = host.look(path, old.written(path))
        if found in (Found.NOTHING, Found.OURS):
            continue
        file = host.at(path)
        if found is Found.CHANGED and source is not None and source.resolve() == file.resolve():
            continue  # the installed profile itself, edited, is what shall be installed
        remedy = "move it away"
        if path.endswith(".service"):
            remedy = f"move it away; changes belong into: systemctl edit {file.name}"
        elif found is Found.CHANGED and path in old.written_paths:
            remedy = f"palpate install {path} takes it as it is; or move it away"
        what = found.value if path in old.written_paths else "there, and no install wrote it"
        raise InstallError(f"{path} is {what}", remedy=remedy)


def _check_runs(edition: Edition) -> None:
    """Check that the command of an earlier edition is still the version that it was."""
    command = [edition.program, "--version"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        found = said.stdout.strip() or said.stderr.strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        found = str(error)
    if found != f"palpate {edition.palpate}":
        raise InstallError(
            f"{edition.program} was palpate {edition.palpate} and is now: {found}",
            remedy=f"install palpate {edition.palpate} there again, then roll back",
        )


def _remove_files(host: Host, name: str, ledger: Ledger, *, purge: bool) -> dict[str, str]:
    """Remove the files of a station; those that stay, as they were written, by path."""
    kept = {}
    for path in paths_of(name):
        file, written = host.at(path), ledger.written(path)
        found = host.look(path, written)
        if path.endswith(".service"):
            host.remove_wish(file.name)
            _remove_changes_of(host, path, purge=purge)
        if not written or found is Found.NOTHING:
            continue
        is_folder = file.is_dir() and not file.is_symlink()
        if not is_folder and (purge or (found is Found.OURS and path != str(profile_path(name)))):
            file.unlink()
            print(f"removed {path}")
        else:
            # What lies there, if an install wrote it: the profile of an older one may.
            ours = (text for text in written if host.look(path, {text}) is Found.OURS)
            kept[path] = next(ours, next(iter(written)))
            print(f"kept    {path}" + ("" if found is Found.OURS else f" ({found.value})"))
    return kept


def _remove_changes_of(host: Host, unit_path: str, *, purge: bool) -> None:
    """What `systemctl edit` has made beside a unit goes only with ``purge``."""
    folder = host.at(f"{unit_path}.d")
    if folder.is_dir() and not folder.is_symlink():
        if purge:
            shutil.rmtree(folder)
        print(f"{'removed' if purge else 'kept   '} {unit_path}.d")


def _folders_of(name: str, base: PurePosixPath) -> tuple[str, str]:
    """A station's folder below ``base``: a link if systemd made it, and what it leads to then."""
    return str(base / name), str(base.parent / "private" / base.name / name)


def _remove_folders(host: Host, name: str, base: PurePosixPath) -> None:
    for path in _folders_of(name, base):
        folder = host.at(path)
        if folder.is_symlink():
            folder.unlink()
        elif folder.is_dir():
            shutil.rmtree(folder)
    host.remove_empty([str(Path(path).parent) for path in _folders_of(name, base)])


def _check_no_mounts(host: Host, folders: Sequence[str]) -> None:
    """Check that nothing is mounted in the folders that are to be removed."""
    try:
        lines = Path("/proc/self/mountinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        # A space is written as \040 there.
        mounted = Path(re.sub(r"\\(\d{3})", lambda found: chr(int(found[1], 8)), line.split()[4]))
        for folder in folders:
            if mounted.is_relative_to(host.at(folder)):
                raise InstallError(
                    f"{mounted} is a file system of its own, and would be emptied",
                    remedy=f"umount {mounted}, then purge",
                )


def _stop(host: Host, units: Sequence[str]) -> None:
    known = [unit for unit in units if host.at(UNITS_FOLDER / unit).exists()]
    if host.is_running and known:
        _systemctl("disable", "--now", "--quiet", *known)


def _reload(host: Host) -> None:
    if host.is_running:
        _systemctl("daemon-reload")
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            subprocess.run(["udevadm", "control", "--reload"], timeout=30, check=False)


def _systemctl(*words: str) -> None:
    done = subprocess.run(["systemctl", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise InstallError(
            f"systemctl {' '.join(words)}: {done.stderr.strip() or done.returncode}",
            remedy="see what it says, then give the same command again",
        )


def _say_what_next(plan: ServicePlan, host: Host, *, upgraded: bool) -> None:
    recorder, name = plan.profile.recorder, plan.name
    if "recorder" in plan.profile.processes:
        limits = [f"{recorder.keep_bytes / 2**30:.3g} GiB"] if recorder.keep_bytes else []
        limits += [f"{recorder.keep_s / 86400:.3g} days"] if recorder.keep_s else []
        much = f"at most {' or '.join(limits)}" if limits else "nothing is ever removed"
        print(f"records {STATES_FOLDER / name / recorder.out}, {much}")
    where = "next" if host.is_running else f"on the system in {host.root}"
    print(f"{where}:")
    if not host.is_running:
        print(f"  systemctl enable {plan.main_unit}")
    elif not upgraded:
        print("  # it starts with this host; now:")
    print(f"  systemctl {'restart' if upgraded else 'start'} {plan.main_unit}")
    if plan.needs.serial:
        print("  udevadm trigger --subsystem-match=tty --subsystem-match=usb-serial --action=add")
    print(f"  {plan.program} status --profile {profile_path(name)}")


@contextlib.contextmanager
def _errors_translated() -> Iterator[None]:
    try:
        yield
    except PalpateError:
        raise
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        raise InstallError(
            f"{error.filename or 'a file'}: {error.strerror or error}",
            remedy="make room on the disk" if full else "check rights and what lies there",
        ) from error
