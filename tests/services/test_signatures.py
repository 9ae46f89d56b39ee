"""Signed bundles: what a station with trusted keys imports, serves and refuses."""

from __future__ import annotations

import base64
import json
import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("cryptography")

from palpate.errors import BundleError, ConfigError, PalpateError
from palpate.files.bundle import MANIFEST, SIGNATURE, read_bundle
from palpate.files.signature import TrustedKeys, make_signing_key, sign_bundle
from palpate.messages import ModelAction, ModelCommand
from palpate_services.config import FeaturesServiceConfig, ModelsConfig
from palpate_services.inference.repository import PACKAGED, Repository, resolve
from palpate_services.inference.served import ServedModels


@pytest.fixture
def key(tmp_path: Path) -> Path:
    make_signing_key(tmp_path / "lab.key")
    return tmp_path / "lab.key"


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A bundle as its maker has it: one that ships, under another name."""
    folder = tmp_path / "made"
    shutil.copytree(resolve("features-virtual"), folder)
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps(manifest | {"name": "mine", "version": 1}))
    return folder


@pytest.fixture
def kept(tmp_path: Path, key: Path) -> ModelsConfig:
    return ModelsConfig(
        folder=tmp_path / "models",
        state=tmp_path / "state",
        trusted_keys=(key.with_name("lab.key.pub"),),
    )


def _add(kept: ModelsConfig, source: Path) -> Path:
    repository = Repository.of_config(kept)
    return repository.add(source, repository.read)[1]


def test_a_key_is_read_by_its_owner_only_and_never_replaced(key: Path) -> None:
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    before = key.read_bytes()
    with pytest.raises(ConfigError, match="cannot be made"):
        make_signing_key(key)
    assert key.read_bytes() == before


def test_a_key_of_openssl_serves_as_well(tmp_path: Path, foreign: Path) -> None:
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("openssl is not installed")
    make = [openssl, "genpkey", "-algorithm", "ed25519", "-out", "o.key"]
    show = [openssl, "pkey", "-in", "o.key", "-pubout", "-out", "o.pub"]
    for words in (make, show):
        subprocess.run(words, cwd=tmp_path, check=True, capture_output=True, timeout=60)
    sign_bundle(read_bundle(foreign), tmp_path / "o.key")
    TrustedKeys([tmp_path / "o.pub"]).check(read_bundle(foreign))


def test_a_signed_bundle_is_imported_with_its_signature(
    kept: ModelsConfig, foreign: Path, key: Path
) -> None:
    with pytest.raises(BundleError, match="is not signed"):
        _add(kept, foreign)
    sign_bundle(read_bundle(foreign), key)
    where = _add(kept, foreign)
    assert (where / SIGNATURE).read_bytes() == (foreign / SIGNATURE).read_bytes()
    assert Repository.of_config(kept).read(where).manifest.name == "mine"


def test_a_bundle_that_was_signed_after_its_import_gets_the_signature(
    kept: ModelsConfig, foreign: Path, key: Path
) -> None:
    where = _add(kept.model_copy(update={"trusted_keys": ()}), foreign)
    sign_bundle(read_bundle(foreign), key)
    assert _add(kept, foreign) == where
    Repository.of_config(kept).read(where)


def _edit_manifest(folder: Path) -> None:
    values = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps(values | {"contact_threshold_n": 0.9}))


def _edit_model(folder: Path) -> None:
    data = bytearray((folder / "model.onnx").read_bytes())
    data[-1] ^= 1
    (folder / "model.onnx").write_bytes(bytes(data))


def _write(text: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / SIGNATURE).write_text(text)

    return write


def _link(folder: Path) -> None:
    (folder / SIGNATURE).rename(folder.with_name("elsewhere"))
    (folder / SIGNATURE).symlink_to(folder.with_name("elsewhere"))


def _fifo(folder: Path) -> None:
    (folder / SIGNATURE).unlink()
    os.mkfifo(folder / SIGNATURE)


def _by_another_key(folder: Path) -> None:
    make_signing_key(folder.with_name("other.key"))
    sign_bundle(read_bundle(folder), folder.with_name("other.key"))


ALTERATIONS: dict[str, tuple[Callable[[Path], None], str]] = {
    "manifest edited": (_edit_manifest, "altered after it was signed"),
    "model edited": (_edit_model, "digest differs"),
    "signature removed": (lambda folder: (folder / SIGNATURE).unlink(), "is not signed"),
    "signature of zeros": (_write("ed25519 " + "00" * 64 + "\n"), "none of the station's"),
    "signature empty": (_write(""), "none of the station's"),
    "signature no hex": (_write("ed25519 zz\n"), "none of the station's"),
    "signature of another kind": (_write("none \n"), "none of the station's"),
    "signature of 2 MB": (_write("0" * (2 << 20)), "cannot be read"),
    "signature is a link": (_link, "symbolic link"),
    "signature is a FIFO": (_fifo, "cannot be read"),
    "signed by another key": (_by_another_key, "none of the station's trusted keys"),
}


@pytest.mark.parametrize("what", ALTERATIONS)
def test_what_is_not_as_it_was_signed_is_refused(
    what: str, kept: ModelsConfig, foreign: Path, key: Path
) -> None:
    sign_bundle(read_bundle(foreign), key)
    alter, says = ALTERATIONS[what]
    alter(foreign)
    with pytest.raises(BundleError, match=says) as caught:
        _add(kept, foreign)
    assert caught.value.remedy
    assert not list((kept.repository_folder).glob("*/*"))


def _order(models: ServedModels, action: ModelAction, bundle: str = "") -> None:
    command = ModelCommand(action, "lab", "features", b"0" * 16, 1, bundle=bundle)
    models.obey(command, "features")


def test_a_service_refuses_an_unsigned_bundle_and_the_old_one_serves_on(
    kept: ModelsConfig, foreign: Path, key: Path
) -> None:
    pytest.importorskip("onnxruntime")
    _add(kept.model_copy(update={"trusted_keys": ()}), foreign)
    models = ServedModels("features", FeaturesServiceConfig(), Repository.of_config(kept))
    before = models.of("finger")
    with pytest.raises(BundleError, match="is not signed"):
        _order(models, ModelAction.LOAD, "mine")
    assert before is not None
    assert models.of("finger") is before
    sign_bundle(read_bundle(foreign), key)
    _add(kept, foreign)
    _order(models, ModelAction.LOAD, "mine")
    assert "mine:1" in models.describe()
    _edit_manifest(kept.repository_folder / "mine" / "1")
    _order(models, ModelAction.UNLOAD)
    with pytest.raises(PalpateError, match="altered"):
        _order(models, ModelAction.LOAD, "mine")


def test_what_ships_needs_no_signature(kept: ModelsConfig) -> None:
    repository = Repository.of_config(kept)
    folder = repository.resolve("features-virtual")
    assert folder.is_relative_to(PACKAGED)
    repository.read(folder)


@pytest.mark.parametrize("content", ["", "no key", "-----BEGIN PUBLIC KEY-----\n"])
def test_what_is_no_public_key_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "k.pub").write_text(content)
    with pytest.raises(ConfigError, match="is no public Ed25519 key"):
        TrustedKeys([tmp_path / "k.pub"])
    with pytest.raises(ConfigError, match="cannot be read"):
        TrustedKeys([tmp_path / "none.pub"])


def of_an_unknown_kind(what: str, content: bytes) -> str:
    """A key in PEM whose algorithm, 1.2.3.4, nobody knows."""
    code = base64.b64encode(bytes((0x30, len(content))) + content).decode()
    return f"-----BEGIN {what} KEY-----\n{code}\n-----END {what} KEY-----\n"


def test_a_key_of_an_unknown_kind_is_refused(foreign: Path, tmp_path: Path) -> None:
    algorithm, public, private = bytes.fromhex("300506032a0304"), tmp_path / "k.pub", tmp_path / "k"
    public.write_text(of_an_unknown_kind("PUBLIC", algorithm + b"\x03\x21\0" + bytes(32)))
    private.write_text(
        of_an_unknown_kind("PRIVATE", b"\x02\x01\0" + algorithm + b"\x04\x20" + bytes(32))
    )
    with pytest.raises(ConfigError, match="is no public Ed25519 key"):
        TrustedKeys([public])
    with pytest.raises(ConfigError, match="is no Ed25519 key"):
        sign_bundle(read_bundle(foreign), private)
