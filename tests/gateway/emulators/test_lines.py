"""Names of emulated serial lines: whose they are, and what is never replaced or removed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from palpate.errors import ConfigError
from palpate_gateway.emulators.lines import SerialLine


@pytest.fixture
def name(tmp_path: Path) -> Path:
    return tmp_path / "line"


@pytest.fixture
def line(name: Path) -> Iterator[SerialLine]:
    with closing(SerialLine(115200, str(name))) as made:
        made.plug()
        yield made


@pytest.mark.parametrize("unplugged", [False, True])
def test_a_name_is_that_of_one_line(line: SerialLine, name: Path, unplugged: bool) -> None:
    line.keep_plugged(not unplugged)
    with closing(SerialLine(9600, str(name))) as other:
        with pytest.raises(ConfigError, match="another emulator, which runs -> end that one"):
            other.plug()
        line.plug()
        assert name.exists()
        line.close()
        assert not name.is_symlink()
        other.plug()
        assert name.exists()


def test_two_ways_to_a_name_are_one(line: SerialLine, name: Path, tmp_path: Path) -> None:
    (tmp_path / "again").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="another emulator"):
        SerialLine(9600, str(tmp_path / "again" / name.name)).plug()


def test_the_name_that_a_killed_emulator_left_is_used_again(name: Path) -> None:
    # Its terminal may by now be that of another program.
    ours, other = os.openpty()
    try:
        name.symlink_to(os.ttyname(other))
        with closing(SerialLine(9600, str(name))) as line:
            line.plug()
            assert os.readlink(name) != os.ttyname(other)
        assert not name.is_symlink()
    finally:
        os.close(ours)
        os.close(other)


def test_a_link_of_the_users_stays(name: Path, tmp_path: Path) -> None:
    name.symlink_to(tmp_path)
    with closing(SerialLine(9600, str(name))) as line:
        with pytest.raises(ConfigError, match=r"is a link to .* -> choose another"):
            line.plug()
    assert name.readlink() == tmp_path


def test_what_replaced_the_line_is_not_removed_with_it(
    line: SerialLine, name: Path, tmp_path: Path
) -> None:
    name.unlink()
    name.symlink_to(tmp_path)
    line.close()
    assert name.readlink() == tmp_path
