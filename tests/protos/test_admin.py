"""Commands about models pass only if they are proven, meant for this process, fresh and new."""

from __future__ import annotations

import dataclasses
import os
import re
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from palpate import admin
from palpate.admin import CommandGuard, make_token, new_nonce, read_token, signed
from palpate.codec import MODEL_COMMAND
from palpate.errors import ConfigError, ErrorCode, RemoteError, WireError
from palpate.messages import ModelAction, ModelCommand, ModelRequest

TOKEN = bytes(range(32))


def command(**changes: Any) -> ModelCommand:
    values: dict[str, Any] = {
        "action": ModelAction.LOAD,
        "station": "lab",
        "service": "features",
        "nonce": new_nonce(),
        "wall_ns": time.time_ns(),
        "bundle": "x:1",
        **changes,
    }
    return ModelCommand(**values)


@pytest.fixture
def guard() -> CommandGuard:
    return CommandGuard(TOKEN, station="lab", service="features", instance="features")


def denied(guard: CommandGuard, request: ModelRequest) -> str:
    with pytest.raises(RemoteError) as caught:
        guard.admit(request)
    assert caught.value.code is ErrorCode.PERMISSION_DENIED
    assert TOKEN.hex() not in str(caught.value)
    return caught.value.problem


def test_a_proven_command_passes_once(guard: CommandGuard) -> None:
    request = signed(command(), TOKEN)
    assert guard.admit(request).bundle == "x:1"
    assert "already obeyed" in denied(guard, request)


def test_without_a_token_nothing_passes() -> None:
    guard = CommandGuard(None, station="lab", service="features", instance="features")
    assert "no commands" in denied(guard, signed(command(), TOKEN))
    assert "no commands" in denied(guard, signed(command(), b""))


def test_another_token_or_a_changed_byte_is_no_proof(guard: CommandGuard) -> None:
    good = signed(command(), TOKEN)
    assert "not signed" in denied(guard, signed(command(), bytes(32)))
    for at in range(len(good.command)):
        changed = bytearray(good.command)
        changed[at] ^= 1
        assert "not signed" in denied(guard, dataclasses.replace(good, command=bytes(changed)))
    assert "not signed" in denied(guard, dataclasses.replace(good, mac=bytes(32)))
    guard.admit(good)  # none of the attempts has used its number


@pytest.mark.parametrize("meant", [{"station": "b"}, {"service": "field"}, {"instance": "other"}])
def test_a_command_for_another_process(guard: CommandGuard, meant: dict[str, str]) -> None:
    assert "not for this process" in denied(guard, signed(command(**meant), TOKEN))


def test_a_command_may_name_the_instance(guard: CommandGuard) -> None:
    guard.admit(signed(command(instance="features"), TOKEN))


@pytest.mark.parametrize("age_s", [3600, -3600, 31, -31])
def test_an_old_command_or_one_of_the_future(guard: CommandGuard, age_s: int) -> None:
    wall_ns = time.time_ns() - age_s * 10**9
    assert "by this host's clock" in denied(guard, signed(command(wall_ns=wall_ns), TOKEN))


def test_a_command_from_before_the_start_cannot_be_repeated() -> None:
    """The numbers that were used are forgotten with the process."""
    request = signed(command(), TOKEN)
    time.sleep(0.001)
    after = CommandGuard(TOKEN, station="lab", service="features", instance="features")
    assert "before this process started" in denied(after, request)


def test_a_clock_that_is_set_back_after_the_start_refuses_no_new_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A host whose clock is in local time until NTP sets it: commands were refused for hours."""
    true_ns = time.time_ns
    with monkeypatch.context() as ahead:
        ahead.setattr(time, "time_ns", lambda: true_ns() + 3600 * 10**9)
        guard = CommandGuard(TOKEN, station="lab", service="features", instance="features")
        time.sleep(0.001)
    request = signed(command(), TOKEN)
    assert guard.admit(request).bundle == "x:1"
    assert "already obeyed" in denied(guard, request)
    before = signed(command(wall_ns=time.time_ns() - 20 * 10**9), TOKEN)
    assert "before this process started" in denied(guard, before)


def test_a_clock_that_is_set_back_a_little_after_a_start_makes_no_old_command_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    true_ns = time.time_ns

    def set_back(step_s: float) -> None:
        monkeypatch.setattr(time, "time_ns", lambda: true_ns() - round(step_s * 1e9))

    first = CommandGuard(TOKEN, station="lab", service="features", instance="features")
    time.sleep(0.001)
    request = signed(command(), TOKEN)
    assert first.admit(request).bundle == "x:1"
    time.sleep(0.001)
    again = CommandGuard(TOKEN, station="lab", service="features", instance="features")
    for step_s in (0.0, 2.0, 20.0):
        set_back(step_s)
        assert "before this process started" in denied(again, request)
    new = signed(command(), TOKEN)
    with pytest.raises(RemoteError, match="perhaps was set back") as caught:
        again.admit(new)
    told = re.fullmatch(r"give it again in (\d+) s", caught.value.remedy)
    assert told is not None
    wait_s = int(told[1])
    assert 0 < wait_s <= 20
    set_back(20.0 - wait_s)  # so long after
    assert again.admit(signed(command(), TOKEN)).bundle == "x:1"


def test_a_clock_that_is_set_forward_and_back_makes_no_obeyed_command_new(
    guard: CommandGuard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another command meanwhile made it forget the number of the first."""
    true_ns = time.time_ns
    request = signed(command(), TOKEN)
    guard.admit(request)
    with monkeypatch.context() as ahead:
        ahead.setattr(time, "time_ns", lambda: true_ns() + 120 * 10**9)
        guard.admit(signed(command(), TOKEN))
    assert "already obeyed" in denied(guard, request)


def test_numbers_are_kept_while_they_could_pass_and_no_more(
    guard: CommandGuard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admin, "_NONCES_MOST", 10)
    for _ in range(10):
        guard.admit(signed(command(), TOKEN))
    with pytest.raises(RemoteError) as caught:
        guard.admit(signed(command(), TOKEN))
    assert caught.value.code is ErrorCode.RESOURCE_EXHAUSTED
    assert caught.value.retry_after_s > 0
    later_ns, steady_ns = (now() + 61 * 10**9 for now in (time.time_ns, time.monotonic_ns))
    monkeypatch.setattr(time, "time_ns", lambda: later_ns)
    monkeypatch.setattr(time, "monotonic_ns", lambda: steady_ns)
    guard.admit(signed(command(wall_ns=later_ns), TOKEN))
    assert len(guard._used) == 1


def test_a_proven_command_still_keeps_the_contract(guard: CommandGuard) -> None:
    payload = MODEL_COMMAND.encode(command())[:-3]
    with pytest.raises(WireError):
        guard.admit(ModelRequest(payload, admin._mac(payload, TOKEN)))


def test_one_token_for_all_that_start_at_once(tmp_path: Path) -> None:
    path = admin.token_file(tmp_path, "lab")
    found: list[bytes] = []
    starting = [threading.Thread(target=lambda: found.append(make_token(path))) for _ in range(8)]
    for thread in starting:
        thread.start()
    for thread in starting:
        thread.join(20)
    assert len(found) == 8
    assert len(set(found)) == 1
    assert read_token(path) == found[0]
    assert path.stat().st_mode & 0o777 == 0o600
    assert [file.name for file in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("mode", [0o644, 0o660, 0o606])
def test_a_token_that_others_can_read_is_none(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "admin.token"
    make_token(path)
    path.chmod(mode)
    with pytest.raises(ConfigError, match="chmod 600"):
        read_token(path)


def test_files_that_are_no_token(tmp_path: Path) -> None:
    path = tmp_path / "admin.token"
    with pytest.raises(ConfigError, match="cannot be read"):
        read_token(path)
    os.mkfifo(path, 0o600)
    with pytest.raises(ConfigError, match="no admin token"):
        read_token(path)
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_token(path)
    path.unlink()
    path.touch(0o600)
    path.write_text("ab" * 31)
    with pytest.raises(ConfigError, match="no admin token of 32 bytes"):
        read_token(path)
