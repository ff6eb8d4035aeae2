"""A private certificate authority for mutual TLS between the processes: a folder of files for each of them.

    DIR/ca.pem, ca.key                      the authority; its key stays here
    DIR/NAME/ca.pem, cert.pem, key.pem      for the process, or the actors, of that common name
    DIR/NAME/groups.txt                     of those that may listen: the groups of actors to admit

A folder is replaced as a whole. Between the two renames that this takes, the old one is `.NAME.old`; whoever
issues next puts it back.
"""

from __future__ import annotations

import re
import shutil
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from common.errors import UsageError
from common.files import lock, sync, write_atomically

LISTENERS = ("learner", "curriculum", "router")
"""Roles that may listen, so that their certificates name hosts."""
ROLES = (*LISTENERS, "operator")
LOCAL_GROUP = "actor-local"
DAYS = 825
AUTHORITY_DAYS = 3650
CLOCK_SKEW = timedelta(minutes=5)
"""A certificate is valid from so long ago, for hosts whose clock is behind."""
PAIR = ("ca.pem", "cert.pem", "key.pem")


class Authority(NamedTuple):
    """What signs."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


class Entry(NamedTuple):
    """One certificate of a folder, as `navaclq certs show` lists it."""

    name: str
    hosts: tuple[str, ...]
    until: datetime

    @property
    def days_left(self) -> int:
        """Whole days until it ends; negative after that."""
        return (self.until - _now()).days


def create(root: Path, groups: Sequence[str] = (), hosts: Sequence[str] = (), days: int = DAYS) -> None:
    """Makes an authority in `root`, with a certificate for every role and for each group of actors.

    Raises UsageError for a bad name or host, where an authority is already, and when it cannot write; nothing
    is left behind then.
    """
    groups = groups or (LOCAL_GROUP,)
    for group in groups:
        check_name(group)
        if group in ROLES:
            raise UsageError(f"{group} is no group of actors, and gets its certificate anyway")
    alternatives = _alternatives(hosts or default_hosts())
    names = [*dict.fromkeys(groups), *ROLES]  # groups first: the lists of the roles name them
    with _writing(root):
        _check_free(root, names)
        with _made(root), TemporaryDirectory(prefix=".", dir=root) as scratch:
            new = Path(scratch)
            authority = _new_authority()
            _write_key(new / "ca.key", authority.key)
            _write(new / "ca.pem", _pem(authority.certificate))
            for name in names:
                _replace(new / name, authority, alternatives if name in LISTENERS else [], days)
            for name in ("ca.key", "ca.pem", *names):
                (new / name).rename(root / name)
            sync(root)


def issue(root: Path, name: str, hosts: Sequence[str] = (), days: int = DAYS) -> list[Path]:
    """Issues the certificate of `name`, or renews it with a new key, for its old hosts unless told others.

    Returns the groups.txt that a new group of actors was added to. Raises UsageError for a bad name or host,
    an authority that cannot be used, and when it cannot write; an old certificate stays usable then.
    """
    check_name(name)
    if hosts and name not in LISTENERS:
        raise UsageError(f"{name} does not listen; --host goes with {', '.join(LISTENERS)}")
    alternatives = _alternatives(hosts)
    authority = read_authority(root)
    folder = root / name
    with _writing(root), lock(root / ".lock"):
        _recover(folder)
        if name in LISTENERS and not alternatives:
            alternatives = _alternatives(_old_hosts(folder / "cert.pem") or default_hosts())
        _replace(folder, authority, alternatives, days)
        return _admit(root, name) if name not in ROLES else []


def read(root: Path) -> list[Entry]:
    """The authority's certificate, named ca, and those of the folders; UsageError when one is unreadable."""
    files = {"ca": root / "ca.pem"} | {file.parent.name: file for file in sorted(root.glob("[!.]*/cert.pem"))}
    found = {name: _read_certificate(file) for name, file in files.items()}
    return [Entry(name, _hosts(cert), cert.not_valid_after_utc) for name, cert in found.items()]


def read_authority(root: Path) -> Authority:
    """The authority of a folder that `create` made; raises UsageError when it cannot sign, now."""
    certificate, file = _read_certificate(root / "ca.pem"), root / "ca.key"
    try:
        key = load_pem_private_key(_read_file(file), None)
    except (ValueError, TypeError, UnsupportedAlgorithm):  # TypeError: it is encrypted
        raise UsageError(f"{file} is no private key in PEM without a password") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise UsageError(f"{file} does not belong to {root / 'ca.pem'}; copy both from one backup")
    if not certificate.not_valid_before_utc <= _now() < certificate.not_valid_after_utc:
        begin, end = certificate.not_valid_before_utc.date(), certificate.not_valid_after_utc.date()
        raise UsageError(
            f"the authority in {root} is valid from {begin} to {end}, which is not now; check the clock, "
            "or make a new one in another folder with `navaclq certs init`"
        )
    return Authority(certificate, key)


def _check_free(root: Path, names: list[str]) -> None:
    if (root / "ca.pem").exists() or (root / "ca.key").exists():
        raise UsageError(f"{root} has an authority already; `navaclq certs issue {root} NAME` adds to it")
    for folder in (root / name for name in names):
        if folder.exists():
            raise UsageError(f"{folder} is there already, without an authority; name an empty folder")


def check_name(name: str) -> None:
    """Raises UsageError unless `name` is a role or a group of actors, and so a common name and a folder."""
    if name not in ROLES and not (re.fullmatch(r"actor-[A-Za-z0-9_.-]+", name) and len(name) <= 64):
        raise UsageError(
            f"{name!r} can have no certificate; allowed are {', '.join(ROLES)}, and for a group of actors "
            "actor- with letters, digits, _ . - after it, at most 64 characters in all"
        )


def default_hosts() -> list[str]:
    """This host's name, where it is one, and the names of loopback."""
    return [*(name for name in [socket.gethostname()] if _is_hostname(name)), "localhost", "127.0.0.1", "::1"]


def _is_hostname(text: str) -> bool:
    labels = text.split(".")
    fits = all(re.fullmatch(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)", label) for label in labels)
    return fits and len(text) <= 253 and not labels[-1].isdecimal()  # 10.0.0.256 is a mistyped address


def _alternatives(hosts: Sequence[str]) -> list[x509.GeneralName]:
    return [_alternative(host) for host in dict.fromkeys(hosts)]


def _alternative(host: str) -> x509.GeneralName:
    with suppress(ValueError):
        return x509.IPAddress(ip_address(host))
    if _is_hostname(host):
        return x509.DNSName(host)
    raise UsageError(f"--host {host!r} is neither a hostname nor an IP address")


def _now() -> datetime:
    return datetime.now(UTC)


def _new_authority() -> Authority:
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("navaclq certificate authority")
    until = _now() + timedelta(days=AUTHORITY_DAYS)
    return Authority(_builder(name, name, key, until, authority=True).sign(key, SHA256()), key)


def _new_certificate(
    authority: Authority,
    name: str,
    key: ec.EllipticCurvePrivateKey,
    alternatives: list[x509.GeneralName],
    days: int,
) -> x509.Certificate:
    """One that ends with the authority at the latest, and may serve when it has alternative names."""
    until = min(_now() + timedelta(days=days), authority.certificate.not_valid_after_utc)
    builder = _builder(_name(name), authority.certificate.subject, key, until, authority=False)
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
    builder = builder.add_extension(issuer, critical=False)
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if alternatives:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        builder = builder.add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    return builder.sign(authority.key, SHA256())


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, until: datetime, authority: bool
) -> x509.CertificateBuilder:
    """What every certificate has; an authority signs certificates, but none of another authority."""
    constraints = x509.BasicConstraints(ca=authority, path_length=0 if authority else None)
    usage = x509.KeyUsage(
        digital_signature=not authority,
        key_cert_sign=authority,
        crl_sign=authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_now() - CLOCK_SKEW)
        .not_valid_after(until)
        .add_extension(constraints, critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        extension = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in extension.value)


def _old_hosts(file: Path) -> tuple[str, ...]:
    try:
        return _hosts(_read_certificate(file)) if file.exists() else ()
    except UsageError as error:
        raise UsageError(f"{error}; to replace it, name its hosts with --host") from None


def _read_certificate(file: Path) -> x509.Certificate:
    try:
        certificate = x509.load_pem_x509_certificate(_read_file(file))
        _hosts(certificate), certificate.public_key()  # both are parsed only when asked for
    except (ValueError, UnsupportedAlgorithm, x509.DuplicateExtension):
        raise UsageError(f"{file} is no certificate in PEM") from None
    return certificate


def _read_file(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise UsageError(f"{file} does not exist; name a folder that `navaclq certs init` made") from None
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror}") from None


@contextmanager
def _writing(root: Path) -> Iterator[None]:
    try:
        yield
    except BlockingIOError:
        raise UsageError(f"another `navaclq certs` changes {root}; try again when it has ended") from None
    except OSError as error:
        raise UsageError(f"cannot write {root}: {error.strerror or error}") from None


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Makes a folder that may be there already; on failure one that was not goes again."""
    existed = folder.exists()
    folder.mkdir(mode=0o700, exist_ok=True)
    try:
        yield
    except BaseException:
        if not existed:
            with suppress(OSError):
                folder.rmdir()
        raise


def _beside(folder: Path, what: str) -> Path:
    return folder.with_name(f".{folder.name}.{what}")


def _recover(folder: Path) -> None:
    """Removes what a crash left, and undoes half a replacement."""
    old = _beside(folder, "old")
    if old.exists() and not folder.exists():
        old.rename(folder)
    for left in (old, _beside(folder, "new")):
        shutil.rmtree(left, ignore_errors=True)


def _replace(folder: Path, authority: Authority, alternatives: list[x509.GeneralName], days: int) -> None:
    """Puts a new pair in place of a folder, and keeps what else is in it."""
    new, old = _beside(folder, "new"), _beside(folder, "old")
    try:
        if folder.exists():
            shutil.copytree(folder, new, ignore=shutil.ignore_patterns(*PAIR))
        new.mkdir(mode=0o700, exist_ok=True)
        new.chmod(0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        _write_key(new / "key.pem", key)
        _write(new / "cert.pem", _pem(_new_certificate(authority, folder.name, key, alternatives, days)))
        _write(new / "ca.pem", _pem(authority.certificate))
        if folder.name in LISTENERS and not (new / "groups.txt").exists():
            write_atomically(new / "groups.txt", _lines(_known_groups(folder.parent)))
        sync(new)
        if folder.exists():
            folder.rename(old)
        new.rename(folder)
        sync(folder.parent)
    finally:
        _recover(folder)


def _known_groups(root: Path) -> set[bytes]:
    """All groups of actors that have a folder or are in a list."""
    listed = {group for file in root.glob("[!.]*/groups.txt") for group in file.read_bytes().split()}
    return listed | {folder.name.encode() for folder in root.glob("actor-*") if folder.is_dir()}


def _admit(root: Path, group: str) -> list[Path]:
    """Adds a group of actors to every list that lacks it, and returns those."""
    changed = []
    for file in (root / role / "groups.txt" for role in LISTENERS if (root / role).is_dir()):
        groups = set(file.read_bytes().split()) if file.exists() else _known_groups(root)
        if group.encode() not in groups or not file.exists():
            write_atomically(file, _lines(groups | {group.encode()}))
            changed.append(file)
    return changed


def _lines(groups: set[bytes]) -> bytes:
    return b"".join(group + b"\n" for group in sorted(groups))


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(Encoding.PEM)


def _write_key(file: Path, key: ec.EllipticCurvePrivateKey) -> None:
    _write(file, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), mode=0o600)


def _write(file: Path, content: bytes, mode: int = 0o644) -> None:
    """A new file, on the disk when this returns."""
    file.touch(mode, exist_ok=False)
    file.write_bytes(content)
    sync(file)
