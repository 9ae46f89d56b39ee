"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from palpate.errors import DatasetError
from palpate.files.atomic import written_whole


def test_a_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.txt"
    with written_whole(path) as partial:
        partial.write_text("whole", encoding="utf-8")
        assert not path.exists()
    assert path.read_text(encoding="utf-8") == "whole"
    assert list(path.parent.iterdir()) == [path]


def test_what_fails_half_way_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old", encoding="utf-8")

    def fail() -> None:
        with written_whole(path) as partial:
            partial.write_text("half", encoding="utf-8")
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        fail()
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_appears_whole_too(tmp_path: Path) -> None:
    def write(path: Path, *, fails: bool) -> None:
        with written_whole(path) as partial:
            partial.mkdir()
            (partial / "file.txt").write_text("whole", encoding="utf-8")
            if fails:
                raise KeyError("mine")

    write(tmp_path / "good", fails=False)
    with pytest.raises(KeyError, match="mine"):
        write(tmp_path / "bad", fails=True)
    assert list(tmp_path.iterdir()) == [tmp_path / "good"]
    assert (tmp_path / "good" / "file.txt").read_text(encoding="utf-8") == "whole"


def test_what_gets_its_name_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a power failure leaves an empty file, or undoes the renaming."""
    steps: list[int | str] = []
    monkeypatch.setattr(os, "fsync", lambda number: steps.append(os.fstat(number).st_ino))
    replace = os.replace

    def rename(old: Path, new: Path) -> None:
        steps.append("named")
        replace(old, new)

    monkeypatch.setattr(os, "replace", rename)
    with written_whole(tmp_path / "file") as partial:
        partial.write_text("whole", encoding="utf-8")
    assert steps == [(tmp_path / "file").stat().st_ino, "named", tmp_path.stat().st_ino]
    steps.clear()
    with written_whole(tmp_path / "folder") as partial:
        (partial / "inner").mkdir(parents=True)
        (partial / "inner" / "file.txt").write_text("whole", encoding="utf-8")
    folder = tmp_path / "folder"
    all_of_it = {path.stat().st_ino for path in (folder, *folder.rglob("*"))}
    assert set(steps[:-2]) == all_of_it
    assert steps[-2:] == ["named", tmp_path.stat().st_ino]


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EIO])
def test_a_file_system_that_syncs_no_folder_is_no_trouble(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def sync(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", sync)
    if number == errno.EIO:
        with pytest.raises(DatasetError), written_whole(tmp_path / "file") as partial:
            partial.write_text("whole", encoding="utf-8")
        return
    with written_whole(tmp_path / "file") as partial:
        partial.write_text("whole", encoding="utf-8")
    assert (tmp_path / "file").read_text(encoding="utf-8") == "whole"


def test_a_disk_that_refuses_is_named(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file, no folder", encoding="utf-8")
    with (
        pytest.raises(DatasetError, match=r"cannot write .*taken/file\.txt"),
        written_whole(tmp_path / "taken" / "file.txt"),
    ):
        pass
