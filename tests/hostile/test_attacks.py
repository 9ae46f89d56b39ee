"""A station with certificates is attacked: nothing has an effect, and it goes on."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

from tests.hostile.attacks import ATTACKS
from tests.hostile.lab import Lab

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with Lab(tmp_path_factory.mktemp("lab")) as lab:
        yield lab


@pytest.fixture(scope="module")
def processes(lab: Lab) -> dict[str, int]:
    return lab.processes()


def test_nobody_is_refused_before_an_attack(lab: Lab) -> None:
    assert lab.status("features") is not None  # the operator asks
    for service, length in lab.lengths().items():
        assert length
        assert "refused" not in lab.log(service), service


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_has_no_effect_and_is_told(
    name: str, lab: Lab, processes: dict[str, int]
) -> None:
    outcome = ATTACKS[name](lab)
    assert outcome.refused, outcome
    assert outcome.logged, outcome
    assert lab.processes() == processes, "a process was started again"


def test_what_the_issue_names_is_among_the_attacks() -> None:
    for words in (
        "no certificate",
        "another authority",
        "robot loads",
        "robot tares",
        "oversize",
        "flood",
        "replayed command",
        "hostile model",
        "path traversal",
        "crafted recording",
    ):
        assert any(words in name for name in ATTACKS), words


def test_secrets_are_in_no_log(lab: Lab) -> None:
    secrets = [lab.token.hex()]
    secrets += [path.read_text().splitlines()[1] for path in lab.certificates.rglob("key.pem")]
    for service in ("router", "gateway", "features", "supervisord"):
        log = lab.log(service)
        assert log
        assert not [one for one in secrets if one in log], service
