"""Errors travel between processes as they are."""

from __future__ import annotations

import pickle
from collections.abc import Iterator

import pytest

from palpate import errors
from palpate.cluster import WorkerLostError
from palpate.errors import ConfigError, DatasetError, MissingExtraError, PalpateError, RemoteError


def kinds(base: type[PalpateError]) -> Iterator[type[PalpateError]]:
    for kind in base.__subclasses__():
        if kind.__module__ == errors.__name__:
            yield kind
        yield from kinds(kind)


@pytest.mark.parametrize("kind", [*kinds(PalpateError), WorkerLostError])
def test_an_error_is_whole_after_a_journey(kind: type[PalpateError]) -> None:
    error = kind.__new__(kind)
    PalpateError.__init__(error, "there is a hole", remedy="fill it")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert (again.problem, again.remedy) == ("there is a hole", "fill it")
    assert str(again) == str(error) == "there is a hole -> fill it"


def test_what_errors_know_beside_their_text_travels_too() -> None:
    missing = pickle.loads(pickle.dumps(MissingExtraError("torch", extra="training")))
    assert missing.extra == "training"
    assert 'pip install "palpate[training]"' in str(missing)
    remote = RemoteError("busy", remedy="wait", code=errors.ErrorCode.UNAVAILABLE)
    assert pickle.loads(pickle.dumps(remote)).code is errors.ErrorCode.UNAVAILABLE
    for kind in (ConfigError, DatasetError):
        with pytest.raises(kind, match="wrong -> right"):
            raise pickle.loads(pickle.dumps(kind("wrong", remedy="right")))
