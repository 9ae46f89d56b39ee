"""What the fuzzer found interesting stays harmless: the corpus and the seeds, without atheris."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from tests.fuzz.corpus import (
    LIMIT_BYTES,
    TARGETS,
    Target,
    archive,
    load_target,
    read_corpus,
    write_corpus,
)
from tests.fuzz.streams import parts, pieces, sealed


@pytest.mark.parametrize("name", TARGETS)
def test_decoder_keeps_its_promises(name: str) -> None:
    target = load_target(name)
    for number, data in _inputs(target, name):
        try:
            target.check(data)
        except Exception as error:
            error.add_note(f"input {number} of {name}: {data.hex()}")
            raise


def _inputs(target: Target, name: str) -> Iterator[tuple[str, bytes]]:
    yield "nothing", b""
    for number, data in enumerate(target.seeds()):
        yield f"seed {number}", data
    yield from read_corpus(name).items()


@pytest.mark.parametrize("name", TARGETS)
def test_corpus_is_kept_and_small(name: str) -> None:
    assert len(read_corpus(name)) >= len(load_target(name).seeds()) // 2
    assert archive(name).stat().st_size <= LIMIT_BYTES


def test_every_corpus_has_its_target() -> None:
    assert {path.stem for path in archive("kms40").parent.iterdir()} == set(TARGETS)


def test_an_archive_hangs_on_its_inputs_alone(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr("tests.fuzz.corpus.FOLDER", tmp_path)
    assert write_corpus("a", [b"bc", b"a", b"a"]) == 2
    first = archive("a").read_bytes()
    assert sorted(read_corpus("a").values()) == [b"a", b"bc"]
    write_corpus("a", [b"a", b"bc"])
    assert archive("a").read_bytes() == first


def test_pieces_and_parts_hold_all_bytes() -> None:
    stream = bytes(range(256)) * 3
    assert all(b"".join(pieces(stream, how)) == stream for how in range(256))
    assert parts(b"\x02ab\x00\x01c\x09de") == [b"ab", b"", b"c", b"de"]
    assert sealed(b"\x03\x00ab\x02\x01c", lambda kind, part: b"<%d%b>" % (kind, part)) == b"ab<1c>"
