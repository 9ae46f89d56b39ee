"""Certificates of a lab: an authority of its own, and certificates by role that it issues.

A certificate's common name is its role and nothing else, because that is what Zenoh compares
(``palpate.bus.access``); the name of its holder is its organisational unit. A folder that this
module writes appears whole or not at all, and nothing that is there is ever overwritten.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
import stat
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes, PublicKeyTypes
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from palpate.bus.access import ROLE_OF
from palpate.config import TLS_FILES, Role, TlsConfig, check_name, looking_at
from palpate.errors import ConfigError

AUTHORITY_KEY = "ca.key"
AUTHORITY = TLS_FILES["root_ca_certificate"]
_CERTIFICATE, _KEY = TLS_FILES["certificate"], TLS_FILES["private_key"]

AUTHORITY_DAYS = 3650
"""Validity of an authority [days]."""

DAYS = 365
"""Validity of a certificate [days]."""

WARN_DAYS = 30
"""So long before its end a certificate is warned about [days]."""

_HERE = ("localhost", "127.0.0.1", "::1")  # processes of one host link to one another there
_CLOCKS = datetime.timedelta(hours=1)  # another host's clock may be so far behind
_REMEDY = "make one: palpate certs ca FOLDER"
_OTHER_AUTHORITY = (
    "issue as the owner of its files; put back a copy of one that is damaged, or make another "
    "authority (palpate certs ca NEW-FOLDER) and issue all certificates again"
)


@dataclass(frozen=True, slots=True)
class IssuedCertificate:
    """What a certificate says.

    Attributes:
        folder: Where it is.
        role: What its holder may do; None = its common name is no role.
        name: Name of its holder.
        hosts: Names and addresses at which its holder may listen.
        until: When it ends, UTC.
        authority: SHA-256 of the certificate of its authority, 32 bytes.
        authority_until: When its authority ends, UTC.
        problem: Why nobody will accept it, or that others may read its key; empty = all is well.
    """

    folder: Path
    role: Role | None
    name: str
    hosts: tuple[str, ...]
    until: datetime.datetime
    authority: bytes
    authority_until: datetime.datetime
    problem: str = ""

    @property
    def authority_ends(self) -> bool:
        """Whether one that its authority issues now would end soon, too."""
        return self.authority_until - _now() < datetime.timedelta(days=WARN_DAYS)

    @property
    def days_left(self) -> float:
        """Until it ends [days]; negative = it has ended."""
        return (self.until - _now()) / datetime.timedelta(days=1)


@dataclass(frozen=True, slots=True)
class DamagedCertificate:
    """A folder whose certificate cannot be read, and why."""

    folder: Path
    problem: str


def make_authority(folder: Path, name: str = "lab", *, days: int = AUTHORITY_DAYS) -> None:
    """Make an authority in a new folder: ``ca.pem``, and ``ca.key`` that only its owner can read.

    Raises:
        ConfigError: The folder holds something already, or cannot be made.
    """
    check_name(name, "name")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"palpate authority {name}")])
    builder = (
        _builder(subject, subject, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
    )
    certificate = builder.sign(key, hashes.SHA256())
    _write_folder(folder, {AUTHORITY_KEY: _private(key), AUTHORITY: _public(certificate)})


def issue(
    folder: Path, role: Role, name: str = "", hosts: Sequence[str] = (), *, days: int = DAYS
) -> Path:
    """Issue a certificate by the authority in ``folder``; the new folder, as ``--tls`` wants it.

    Args:
        folder: The authority's.
        role: What the holder may do.
        name: Name of the holder, and of the new folder in ``folder``; empty = that of the role.
        hosts: Names and addresses at which the holder listens, beside loopback.
        days: Validity [days]; it ends with the authority's at the latest.

    Raises:
        ConfigError: No authority, it has ended or its key is another's, a name is wrong, or the
            folder exists.
    """
    name = check_name(name or role.value, "name")
    if name in set(Role) and name != role.value:
        raise ConfigError(
            f"the name {name!r} is that of another role than {role.value!r}",
            remedy="choose another --name",
        )
    authority, authority_key = _authority(folder)
    end = authority.not_valid_after_utc
    if end <= _now():
        raise ConfigError(
            f"the authority in {folder} has ended on {end:%Y-%m-%d}",
            remedy="make a new one in another folder, and issue all certificates again",
        )
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name(
        [
            x509.NameAttribute(NameOID.COMMON_NAME, role.common_name),
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, name),
        ]
    )
    both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    names = [_general_name(host) for host in dict.fromkeys((*_HERE, *hosts))]
    signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key())
    builder = (
        _builder(subject, authority.subject, key.public_key(), days, end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(both), critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(signer, critical=False)
    )
    certificate = builder.sign(authority_key, hashes.SHA256())
    target = folder / name
    _write_folder(
        target,
        {
            _KEY: _private(key),
            _CERTIFICATE: _public(certificate),
            AUTHORITY: _public(authority),
        },
    )
    return target


def read_certificate(tls: TlsConfig, *, private: bool = True) -> IssuedCertificate:
    """What a certificate says, and whether it holds.

    Args:
        tls: Its files.
        private: Whether it is a problem, too, that others than its owner may read the key.

    Raises:
        ConfigError: Its files cannot be read, or are no certificate and key.
    """
    certificate = _read_pem(tls.certificate)
    authority = _read_pem(tls.root_ca_certificate)
    common = _first(certificate.subject, NameOID.COMMON_NAME)
    role = ROLE_OF.get(common)
    problem = _problem(certificate, tls)
    if not problem and private and stat.S_IMODE(tls.private_key.stat().st_mode) & 0o077:
        problem = f"others than its owner may read the key: chmod 600 {tls.private_key}"
    if not problem and tls.roles and role is None:
        problem = f"its common name {common!r} is no role"
    return IssuedCertificate(
        tls.certificate.parent,
        role,
        _first(certificate.subject, NameOID.ORGANIZATIONAL_UNIT_NAME) or common,
        _hosts(certificate),
        certificate.not_valid_after_utc,
        authority.fingerprint(hashes.SHA256()),
        authority.not_valid_after_utc,
        problem,
    )


def list_certificates(folder: Path) -> list[IssuedCertificate | DamagedCertificate]:
    """The certificates in the folders of an authority's folder; or the one in the folder itself.

    Raises:
        ConfigError: There is none, or the folder is closed.
    """
    # A folder that has lost one of its two files is a damaged certificate, not none.
    files = (_CERTIFICATE, _KEY)
    with looking_at(folder):
        if any((folder / name).exists() for name in files):
            folders = [folder]
        else:
            folders = sorted({path.parent for name in files for path in folder.glob(f"*/{name}")})
        if not folders and not (folder / AUTHORITY).exists():
            raise ConfigError(f"{folder} holds no certificates", remedy=_REMEDY)
    return [_read_or_tell(one) for one in folders]


def _read_or_tell(folder: Path) -> IssuedCertificate | DamagedCertificate:
    try:
        return read_certificate(TlsConfig.of_folder(folder))
    except ConfigError as error:
        return DamagedCertificate(folder, error.problem)


def _problem(certificate: x509.Certificate, tls: TlsConfig) -> str:
    authority, key = _read_pem(tls.root_ca_certificate), _read_key(tls.private_key)
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return f"{tls.root_ca_certificate.name} is not the authority that issued it"
    if _raw(key.public_key()) != _raw(certificate.public_key()):
        return f"{tls.private_key.name} is not its key"
    now = _now()
    for what, one in (("it", certificate), ("its authority", authority)):
        if one.not_valid_after_utc <= now:
            return f"{what} has ended on {one.not_valid_after_utc:%Y-%m-%d}"
        if one.not_valid_before_utc > now:
            return (
                f"{what} begins on {one.not_valid_before_utc:%Y-%m-%d %H:%M} UTC: check the clock"
            )
    return ""


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    public: ec.EllipticCurvePublicKey,
    days: int,
    latest: datetime.datetime | None = None,
) -> x509.CertificateBuilder:
    now = _now()
    until = now + datetime.timedelta(days=days)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS)
        .not_valid_after(until if latest is None else min(until, latest))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )


def _authority(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    with looking_at(folder):
        if not (folder / AUTHORITY).exists():
            raise ConfigError(f"{folder} holds no authority", remedy=_REMEDY)
    try:
        key, authority = _read_key(folder / AUTHORITY_KEY), _read_pem(folder / AUTHORITY)
    except ConfigError as error:  # whose remedy is to issue it again, as for any other
        raise ConfigError(
            f"the authority in {folder} cannot issue: {error.problem}", remedy=_OTHER_AUTHORITY
        ) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ConfigError(f"{folder / AUTHORITY_KEY} is no key of palpate", remedy=_OTHER_AUTHORITY)
    if _raw(key.public_key()) != _raw(authority.public_key()):
        raise ConfigError(
            f"{folder / AUTHORITY_KEY} is not the key of {folder / AUTHORITY}",
            remedy=_OTHER_AUTHORITY,
        )
    return authority, key


def _read_pem(path: Path) -> x509.Certificate:
    text = _read(path)
    try:
        return x509.load_pem_x509_certificate(text)
    except ValueError as error:
        raise ConfigError(
            f"{path} is no certificate in PEM", remedy="issue it again: palpate certs issue"
        ) from error


def _read_key(path: Path) -> PrivateKeyTypes:
    text = _read(path)
    try:
        return load_pem_private_key(text, password=None)
    except (ValueError, TypeError) as error:  # damaged, or protected by a password
        raise ConfigError(
            f"{path} is no private key in PEM without password",
            remedy="issue it again: palpate certs issue",
        ) from error


_BYTES_MOST = 1 << 20


def _read(path: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(_BYTES_MOST)
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror or error}",
            remedy="read it as its owner, or name another folder",
        ) from error


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        if not host or any(sign in host for sign in " /:*@"):
            raise ValueError(host)
        return x509.DNSName(host)
    except ValueError as error:  # not ASCII
        raise ConfigError(
            f"{host!r} is neither an address nor the name of a host",
            remedy="give --host as others reach it, e.g. 192.168.1.10 or lab-pc.local",
        ) from error


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(one.value) for one in names)


def _first(name: x509.Name, oid: x509.ObjectIdentifier) -> str:
    found = name.get_attributes_for_oid(oid)
    return str(found[0].value) if found else ""


def _public(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(Encoding.PEM)


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _raw(public: PublicKeyTypes) -> bytes:
    return public.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)


def _now() -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC)


def _write_folder(target: Path, files: dict[str, bytes]) -> None:
    """Write a new folder that appears with all its files; keys can be read by their owner only."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".certs.", dir=target.parent) as temporary:
            aside = Path(temporary) / "folder"
            aside.mkdir(mode=0o700)
            for name, content in files.items():
                mode = 0o600 if name.endswith(".key") or name == _KEY else 0o644
                handle = os.open(aside / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
                with open(handle, "wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            os.rename(aside, target)  # refused if something is in it
    except OSError as error:
        there = os.path.exists(target)
        raise ConfigError(
            f"{target} holds something already" if there else f"{target} cannot be made: {error}",
            remedy="nothing is overwritten: choose another folder or --name, or remove it first",
        ) from error
