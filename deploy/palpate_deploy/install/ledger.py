"""What was installed on a host, and changes of it that are made wholly or not at all.

Each station has a ledger beside its profile: the texts that were written now and before, so that
an uninstall removes exactly these and a rollback restores exactly those. A change is written down
before it begins (``NAME.json.next``), so that the next command undoes what a killed one has left.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import stat
from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from pathlib import Path, PurePosixPath
from typing import Literal, Self

from pydantic import ConfigDict, Field, ValidationError

from palpate.config import StrictConfig
from palpate.errors import PalpateError
from palpate.files.atomic import sync_folder
from palpate_deploy.install.units import (
    PROFILES_FOLDER,
    UNITS_FOLDER,
    profile_path,
    rules_path,
    unit_name,
)

LEDGERS_FOLDER = PROFILES_FOLDER / "installed"
_STAGED = ".palpate-new"


class InstallError(PalpateError, RuntimeError):
    """A station cannot be installed or removed on this host."""


class Edition(StrictConfig):
    """What one run of `palpate install` wrote.

    Attributes:
        palpate: Its version.
        program: The `palpate` command that its units run.
        allowed: Networks that were allowed beside those of the profile.
        texts: What was written, by absolute path.
        sha256: The same as digests, to be compared with `sha256sum`.
    """

    # Texts end in a line feed.
    model_config = ConfigDict(str_strip_whitespace=False)

    palpate: str
    program: str
    allowed: tuple[str, ...] = ()
    texts: dict[str, str]
    sha256: dict[str, str]

    @classmethod
    def of(
        cls, palpate: str, program: str, allowed: tuple[str, ...], texts: dict[str, str]
    ) -> Edition:
        """An edition with the digests of its texts."""
        digests = {path: hashlib.sha256(text.encode()).hexdigest() for path, text in texts.items()}
        return cls(palpate=palpate, program=program, allowed=allowed, texts=texts, sha256=digests)


class Ledger(StrictConfig):
    """What is installed of a station.

    Attributes:
        format: Of this file.
        now: What is in force; None = nothing, but changed files were kept.
        before: What was in force before; None = there was nothing.
        kept: What a person had changed when the rest was removed, as it was written, by path.
        folders: Folders that were made for it, and go with the last station.
    """

    model_config = ConfigDict(str_strip_whitespace=False)

    format: Literal[1] = 1
    now: Edition | None = None
    before: Edition | None = None
    kept: dict[str, str] = Field(default_factory=dict)
    folders: tuple[str, ...] = ()

    def written(self, path: str) -> set[str]:
        """Every text that an install has written there."""
        return {texts[path] for texts in self._all_texts if path in texts}

    @property
    def written_paths(self) -> set[str]:
        """Every path at which an install has written."""
        return {path for texts in self._all_texts for path in texts}

    @property
    def _all_texts(self) -> list[dict[str, str]]:
        return [self.kept, *(one.texts for one in (self.now, self.before) if one is not None)]


class Found(Enum):
    """What lies at the path of an installed file."""

    NOTHING = "nothing"
    OURS = "as it was written"
    CHANGED = "changed since it was written"
    STRANGE = "not the file that was written, but a link, a folder or a device"


def paths_of(name: str) -> tuple[str, ...]:
    """Every path at which something of a station can be installed."""
    units = [UNITS_FOLDER / unit_name(name, solver=solver) for solver in (False, True)]
    return tuple(str(path) for path in (profile_path(name), *units, rules_path(name)))


class Host:
    """The files of a host below a root, ``/`` or the folder of an image.

    Raises:
        InstallError: The root is not there.
    """

    def __init__(self, root: Path) -> None:
        if not root.is_dir():
            raise InstallError(f"{root} is not a folder", remedy="name the root of a system")
        self.root = root.resolve()
        self.made: list[str] = []
        """Folders that were made to lock it; they go again if nothing is put into them."""

    @property
    def is_this_host(self) -> bool:
        """Whether it is the host itself, and not an image."""
        return self.root == Path("/")

    @property
    def is_running(self) -> bool:
        """Whether it is the host itself, and systemd runs it (sd_booted(3))."""
        return self.is_this_host and Path("/run/systemd/system").is_dir()

    def at(self, path: str | PurePosixPath) -> Path:
        """Where a path of the host lies; its last part may be a link, which is not followed.

        Raises:
            InstallError: A link on the way leads out of the root.
        """
        inside = self.root / str(path).lstrip("/")
        if inside != self.root and not inside.parent.resolve().is_relative_to(self.root):
            raise InstallError(
                f"{inside.parent} leads out of {self.root}", remedy="make links in it relative"
            )
        return inside

    def look(self, path: str, written: set[str]) -> Found:
        """What lies at a path where one of these texts was written."""
        file = self.at(path)
        try:
            mode = file.lstat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            return Found.NOTHING
        if not stat.S_ISREG(mode):
            return Found.STRANGE
        return Found.OURS if file.read_bytes() in {t.encode() for t in written} else Found.CHANGED

    def missing_folders(self, folder: PurePosixPath) -> list[PurePosixPath]:
        """Those of a folder and the ones above it that are not there, outermost first."""
        return [o for o in (*reversed(folder.parents), folder) if not self.at(o).is_dir()]

    def make_folders(self, folder: PurePosixPath) -> list[str]:
        """Make a folder and those above it; the ones that were made."""
        missing = self.missing_folders(folder)
        for one in missing:
            self.at(one).mkdir(mode=0o755, exist_ok=True)
        return [str(one) for one in missing]

    def remove_empty(self, folders: Iterable[str]) -> None:
        """Remove those of the folders that are empty, innermost first."""
        for folder in sorted(folders, key=len, reverse=True):
            with contextlib.suppress(OSError):
                self.at(folder).rmdir()

    def stations(self) -> list[str]:
        """Names of the stations that have a ledger."""
        return sorted(file.stem for file in self.at(LEDGERS_FOLDER).glob("*.json"))

    def folders_of_stations(self) -> list[str]:
        """Folders that were made for any of them: the last one takes them away."""
        ledgers = (Books(self, name).read() for name in self.stations())
        return [folder for ledger in ledgers for folder in ledger.folders]

    def remove_wish(self, unit: str) -> None:
        """Remove the link by which `systemctl enable` starts a unit with the host."""
        link = self.at(UNITS_FOLDER / "multi-user.target.wants" / unit)
        if link.is_symlink():
            link.unlink()

    @contextlib.contextmanager
    def locked(self) -> Iterator[Self]:
        """Keep other installs and uninstalls away.

        Raises:
            InstallError: Another one runs.
        """
        folder = self.at(LEDGERS_FOLDER)
        try:
            self.made = self.make_folders(LEDGERS_FOLDER)
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError as error:  # another one removes the folder at this moment
            raise self._busy() from error
        try:
            self._lock(handle, folder)
            try:
                folder.chmod(0o700)
                yield self
            finally:
                self.remove_empty([*self.made, str(LEDGERS_FOLDER), str(PROFILES_FOLDER)])
        finally:
            os.close(handle)

    def _lock(self, handle: int, folder: Path) -> None:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The one before may have removed the folder just now.
            if os.path.samestat(folder.stat(), os.fstat(handle)):
                return
        except (BlockingIOError, FileNotFoundError):
            pass
        raise self._busy()

    def _busy(self) -> InstallError:
        return InstallError(
            f"another palpate install or uninstall works on {self.root}",
            remedy="wait until it has ended",
        )


class Journal(StrictConfig):
    """A change that has begun.

    Attributes:
        ledger: What is installed when it has ended.
        found: What lay at its paths when it began.
    """

    model_config = ConfigDict(str_strip_whitespace=False)

    ledger: Ledger
    found: dict[str, str]


def ledger_of(host: Host, name: str) -> Ledger:
    """What is installed of a station; an empty ledger if nothing is.

    Raises:
        InstallError: The ledger is damaged.
        PermissionError: It is read by somebody else than root.
    """
    file = _ledger_file(host, name)
    try:
        ledger = Ledger.model_validate_json(file.read_bytes())
    except FileNotFoundError:
        return Ledger()
    except ValidationError as error:
        raise InstallError(
            f"{file} is damaged",
            remedy=f"look at {', '.join(paths_of(name))}; remove what is not wanted, and {file}",
        ) from error
    if strange := sorted(ledger.written_paths - set(paths_of(name))):
        raise InstallError(
            f"{file} names {strange[0]}, which no install writes",
            remedy="somebody has changed it: restore it from a backup",
        )
    return ledger


def is_half_way(host: Host, name: str) -> bool:
    """Whether a change was begun and not ended; `Books` undo it."""
    return _journal_file(host, name).exists()


def _ledger_file(host: Host, name: str) -> Path:
    return host.at(LEDGERS_FOLDER / f"{name}.json")


def _journal_file(host: Host, name: str) -> Path:
    return host.at(LEDGERS_FOLDER / f"{name}.json.next")


class Books:
    """The ledger of one station on a host. Use it while the host is ``locked``.

    A change that was begun and not ended, because its command was killed, is undone first.
    """

    def __init__(self, host: Host, name: str) -> None:
        self.host = host
        self.name = name
        self._file = _ledger_file(host, name)
        self._journal = _journal_file(host, name)
        self.undone = self._undo()
        """Whether a change was undone."""

    def read(self) -> Ledger:
        """What is installed: see `ledger_of`."""
        return ledger_of(self.host, self.name)

    def change(self, ledger: Ledger, then: Callable[[], None]) -> None:
        """Write everything of ``ledger.now``; remove what was installed and is not in it.

        Nothing is asked: what a person has changed is overwritten. ``then`` is called before the
        change counts as made, while what shall go is still there. After an error, also one of
        ``then``, all files are as they were.

        Raises:
            OSError: The disk is full, or something cannot be written.
        """
        old = self.read()
        texts = {} if ledger.now is None else ledger.now.texts
        gone = set() if old.now is None else old.now.texts.keys() - texts.keys()
        found = {}
        made = list(self.host.made)
        for path in (*texts, *gone):
            with contextlib.suppress(FileNotFoundError):
                found[path] = self.host.at(path).read_text(encoding="utf-8")
            made += (str(one) for one in self.host.missing_folders(PurePosixPath(path).parent))
        folders = tuple(dict.fromkeys((*old.folders, *self.host.folders_of_stations(), *made)))
        ledger = ledger.model_copy(update={"folders": folders})
        journal = Journal(ledger=ledger, found=found)
        try:
            _write(self._journal, journal.model_dump_json(), mode=0o600)
            for path in texts:
                self.host.make_folders(PurePosixPath(path).parent)
            staged = {path: _stage(self.host.at(path), text) for path, text in texts.items()}
            for path, temporary in staged.items():
                temporary.replace(self.host.at(path))
            then()
            for path in gone:
                self.host.at(path).unlink(missing_ok=True)
            self.keep(ledger)
            self._journal.unlink()
        except BaseException:
            self._undo()
            raise

    def _undo(self) -> bool:
        for path in paths_of(self.name):
            _staged_name(self.host.at(path)).unlink(missing_ok=True)
        for file in (self._file, self._journal):
            _staged_name(file).unlink(missing_ok=True)
        try:
            journal = Journal.model_validate_json(self._journal.read_bytes())
        except FileNotFoundError:
            return False
        if self.read() == journal.ledger:  # all that was left to do is to remove the journal
            self._journal.unlink()
            return False
        texts = {} if journal.ledger.now is None else journal.ledger.now.texts
        for path in paths_of(self.name):
            file = self.host.at(path)
            new = {texts[path]} if path in texts else set()
            look = self.host.look(path, new)
            if path not in journal.found:
                if look is Found.OURS:
                    file.unlink()
                    self.host.remove_wish(file.name)
            elif look is Found.NOTHING or (look is Found.OURS and journal.found[path] not in new):
                _write(file, journal.found[path])
        self.host.remove_empty(set(journal.ledger.folders) - set(self.read().folders))
        self._journal.unlink()
        return True

    def keep(self, ledger: Ledger) -> None:
        """Write down what is installed."""
        _write(self._file, ledger.model_dump_json(indent=1), mode=0o600)

    def close(self) -> None:
        """Forget the station."""
        self._file.unlink(missing_ok=True)


def _staged_name(file: Path) -> Path:
    return file.with_name(f".{file.name}{_STAGED}")


def _stage(file: Path, text: str, *, mode: int = 0o644) -> Path:
    temporary = _staged_name(file)
    # A new file, whatever somebody has put there meanwhile.
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, mode)
    try:
        with open(handle, "wb") as stream:
            os.fchmod(handle, mode)
            stream.write(text.encode())
            stream.flush()
            os.fsync(handle)
    except BaseException:
        temporary.unlink()
        raise
    return temporary


def _write(file: Path, text: str, *, mode: int = 0o644) -> None:
    _stage(file, text, mode=mode).replace(file)
    # What is renamed after this must not reach the disk before it.
    sync_folder(file.parent)
