"""Signatures of bundles: who made one, proven by a key that is not on the station.

What is signed is the digest of the manifest, which holds the digests of all other files; so one
signature of 64 bytes covers the bundle. It is Ed25519 of the library ``cryptography``, kept in a
text file beside the manifest (docs/adr/0030-security.md).
"""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.errors import BundleError, ConfigError
from palpate.files.bundle import SIGNATURE, Bundle, read_file
from palpate.process import require

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

_PURPOSE = b"palpate bundle v1\0"
_HEAD = "ed25519"
_KEY_BYTES_MOST = 4096
_REMEDY = "ask its maker to sign it: palpate model sign FOLDER --key KEY"


def make_signing_key(path: Path) -> Path:
    """Make a new key in a file that only its owner can read; the file of its public half.

    Raises:
        ConfigError: One of the two files exists, or cannot be written.
    """
    require("cryptography", extra="security")
    from cryptography.hazmat.primitives import serialization as as_bytes
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key = Ed25519PrivateKey.generate()
    private = key.private_bytes(
        as_bytes.Encoding.PEM, as_bytes.PrivateFormat.PKCS8, as_bytes.NoEncryption()
    )
    public = key.public_key().public_bytes(
        as_bytes.Encoding.PEM, as_bytes.PublicFormat.SubjectPublicKeyInfo
    )
    shown = path.with_name(f"{path.name}.pub")
    for file, content, mode in ((path, private, 0o600), (shown, public, 0o644)):
        try:
            if os.path.lexists(shown) and file == path:
                raise FileExistsError(errno.EEXIST, f"{shown} exists")
            with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as written:
                written.write(content)
        except OSError as error:
            raise ConfigError(
                f"{file} cannot be made: {error.strerror or error}",
                remedy="nothing is overwritten: choose another name, or remove it first",
            ) from error
    return shown


def sign_bundle(bundle: Bundle, key: Path) -> Path:
    """Sign a bundle that was read and checked; the file with the signature, in its folder.

    Raises:
        ConfigError: The key cannot be read, or the folder cannot be written.
    """
    require("cryptography", extra="security")
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    text = _read_key(key)
    try:
        loaded = load_pem_private_key(text, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        loaded = None
    if not isinstance(loaded, Ed25519PrivateKey):
        raise ConfigError(
            f"{key} is no Ed25519 key in PEM without password",
            remedy="make one: palpate model key FILE",
        )
    target = bundle.folder / SIGNATURE
    aside = target.with_name(f".{SIGNATURE}.{os.getpid()}")
    try:
        aside.write_text(f"{_HEAD} {loaded.sign(_PURPOSE + bundle.sha256).hex()}\n", "ascii")
        os.replace(aside, target)
    except OSError as error:
        raise ConfigError(
            f"{target} cannot be written: {error.strerror or error}",
            remedy="sign the bundle where it was made, before it is imported",
        ) from error
    return target


class TrustedKeys:
    """The keys whose holders may make bundles for a station; none = anybody may.

    Raises:
        ConfigError: A file is no public key.
    """

    def __init__(self, paths: Sequence[Path] = ()) -> None:
        self._keys = [_public_key(path) for path in paths]

    def check(self, bundle: Bundle) -> None:
        """Check that one of the keys has signed a bundle.

        Raises:
            BundleError: None has, or the bundle was altered afterwards.
        """
        if not self._keys:
            return
        from cryptography.exceptions import InvalidSignature

        label = f"bundle {bundle.manifest.name}:{bundle.manifest.version} in {bundle.folder}"
        if not os.path.lexists(bundle.folder / SIGNATURE):
            raise BundleError(f"{label} is not signed", remedy=_REMEDY)
        head, _, text = (
            read_file(bundle.folder, SIGNATURE).decode("ascii", "replace").partition(" ")
        )
        try:
            signature = bytes.fromhex(text) if head == _HEAD else b""
        except ValueError:
            signature = b""
        for key in self._keys:
            try:
                key.verify(signature, _PURPOSE + bundle.sha256)
            except InvalidSignature:
                continue
            return
        raise BundleError(
            f"{label}: its signature is by none of the station's trusted keys, or the bundle was "
            "altered after it was signed",
            remedy=_REMEDY,
        )


def _public_key(path: Path) -> Ed25519PublicKey:
    require("cryptography", extra="security")
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    text = _read_key(path)
    try:
        key = load_pem_public_key(text)
    except (ValueError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PublicKey):
        raise ConfigError(
            f"{path} is no public Ed25519 key in PEM",
            remedy="name the .pub file that palpate model key made: [models] trusted_keys",
        )
    return key


def _read_key(path: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(_KEY_BYTES_MOST)
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror or error}", remedy="check the path"
        ) from error
