"""A certificate authority in a folder: one certificate per person or machine, each with a role.

    authority/ca.pem        its certificate: every vehicle and station knows it
    authority/ca.key        its private key: never leaves this machine
    authority/roster.json   who was given a certificate, and who is revoked: every vehicle has a copy
    authority/NAME/         what NAME is handed: ca.pem, cert.pem, key.pem

Nothing is ever overwritten but the roster, which is replaced as a whole. Private keys are for their owner's eyes alone.
"""

from __future__ import annotations

import os
import re
import secrets
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from onboard.messages import NAME_RULE, Member, Role, Roster, RosterError, is_name, load_roster

CA_DAYS = 3650
#: How long a certificate is valid, days.
DAYS = 730
#: A station's clock may be behind this machine's by this much.
_CLOCKS_DIFFER = timedelta(hours=1)
#: A vehicle is also reached on its own machine, and through an ssh tunnel.
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


class KeysError(Exception):
    """Keys cannot be made or read; the text says what is wrong and what would be right."""


class Authority:
    """The authority in a folder that ``init`` made."""

    def __init__(self, folder: Path) -> None:
        """Open it. Raises KeysError when the folder holds none, or a damaged one."""
        self.folder = folder
        if not (folder / "ca.pem").is_file():
            raise KeysError(f"{folder}: no authority here; make one with: pipewright keys init --authority {folder}")
        try:
            self._certificate = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
            self.roster = load_roster(folder / "roster.json")
        except (OSError, ValueError, RosterError) as error:
            raise KeysError(f"{folder}: the authority cannot be read: {error}") from None

    @classmethod
    def init(cls, folder: Path, now: datetime | None = None) -> Authority:
        """Make a new authority in a folder that is new or empty."""
        now = now or datetime.now(UTC)
        if folder.exists() and not folder.is_dir():
            raise KeysError(f"{folder}: is a file; give a folder")
        if folder.is_dir() and any(folder.iterdir()):
            raise KeysError(f"{folder}: is not empty, and nothing is overwritten; give a new folder")
        key = ec.generate_private_key(ec.SECP256R1())
        # Two authorities of one name would be told apart by a broken signature only.
        title = f"Pipewright authority {secrets.token_hex(4)}"
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, title)])
        usage = _key_usage(authority=True)
        builder = _builder(name, name, key.public_key(), now, CA_DAYS)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(usage, critical=True)
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _create(folder / "ca.key", _private(key), 0o600)
            _create(folder / "ca.pem", _public(builder.sign(key, hashes.SHA256())), 0o644)
            _replace(folder / "roster.json", _encoded(Roster()))
        except OSError as error:
            raise KeysError(f"{folder}: cannot be written: {error.strerror}") from None
        return cls(folder)

    @property
    def not_after(self) -> datetime:
        """When the authority's own certificate expires (UTC)."""
        return self._certificate.not_valid_after_utc

    def add(
        self,
        name: str,
        role: Role,
        *,
        hosts: Sequence[str] = (),
        days: int = DAYS,
        renew: bool = False,
        out: Path | None = None,
        now: datetime | None = None,
    ) -> Path:
        """Make a key and a certificate; gives the folder that holds them.

        hosts: names and addresses a vehicle is reached by. renew: a new key and certificate for a name that has one.
        """
        now = now or datetime.now(UTC)
        folder = out or self.folder / name
        self._check(name, role, hosts, days, renew, now)
        if folder.exists():
            raise KeysError(f"{folder}: exists, and nothing is overwritten; move it away, or give another --out")
        issuer = self._key()
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name(
            [
                x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role.value),
                x509.NameAttribute(NameOID.COMMON_NAME, name),
            ]
        )
        builder = _builder(subject, self._certificate.subject, key.public_key(), now, days)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(_key_usage(authority=False), critical=True)
        # A station's certificate cannot be used to pose as a vehicle.
        may = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if role is Role.VEHICLE else [])]
        builder = builder.add_extension(x509.ExtendedKeyUsage(may), critical=False)
        builder = builder.add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer.public_key()), critical=False
        )
        if role is Role.VEHICLE:
            names = dict.fromkeys((name, f"{name}.local", *hosts, *_LOOPBACK))
            builder = builder.add_extension(
                x509.SubjectAlternativeName([_general_name(host) for host in names]), critical=False
            )
        certificate = builder.sign(issuer, hashes.SHA256())
        member = Member(name=name, role=role, expires=certificate.not_valid_after_utc)
        try:
            folder.mkdir(mode=0o700, parents=True)
            _create(folder / "key.pem", _private(key), 0o600)
            _create(folder / "cert.pem", _public(certificate), 0o644)
            _create(folder / "ca.pem", _public(self._certificate), 0o644)
            self._write(Roster(members=(*(m for m in self.roster.members if m.name != name), member)))
        except OSError as error:
            raise KeysError(f"{folder}: cannot be written: {error.strerror}") from None
        return folder

    def revoke(self, name: str, now: datetime | None = None) -> Member:
        """Take a name off the list of those who are admitted, for good."""
        member = self._known(name)
        if member.revoked is not None:
            raise KeysError(f"{name}: was revoked on {member.revoked:%Y-%m-%d} already")
        revoked = msgspec.structs.replace(member, revoked=(now or datetime.now(UTC)).replace(microsecond=0))
        self._write(Roster(members=tuple(revoked if m is member else m for m in self.roster.members)))
        return revoked

    def _known(self, name: str) -> Member:
        member = self.roster.member(name)
        if member is None:
            known = ", ".join(m.name for m in self.roster.members) or "nobody yet"
            raise KeysError(f"{name}: has no certificate of this authority; there are: {known}")
        return member

    def _check(self, name: str, role: Role, hosts: Sequence[str], days: int, renew: bool, now: datetime) -> None:
        if not is_name(name):
            raise KeysError(f"{name!r}: is no name; {NAME_RULE}")
        member = self._known(name) if renew else self.roster.member(name)
        if member is not None and member.revoked is not None:
            # Vehicles tell people apart by name alone: with the name, the revoked certificate would be admitted again.
            raise KeysError(f"{name}: was revoked on {member.revoked:%Y-%m-%d}; a revoked name is never given again")
        if member is not None and not renew:
            raise KeysError(
                f"{name}: has a certificate ({member.role.value}, until {member.expires:%Y-%m-%d}); "
                "choose another name, or make a new certificate for the same with --renew"
            )
        if member is not None and member.role is not role:
            raise KeysError(f"{name}: is {member.role.value}; for another role choose another name")
        if hosts and role is not Role.VEHICLE:
            raise KeysError(f"--host: only a vehicle is connected to; {name} is to be {role.value}")
        for host in hosts:
            _general_name(host)
        left = (self.not_after - now).days
        if not 1 <= days <= left:
            raise KeysError(f"--days {days}: give 1 to {left}; the authority's own certificate lasts no longer")

    def _key(self) -> ec.EllipticCurvePrivateKey:
        path = self.folder / "ca.key"
        try:
            if path.stat().st_mode & 0o077:
                raise KeysError(f"{path}: others may read the authority's key; make it private again: chmod 600 {path}")
            key = serialization.load_pem_private_key(path.read_bytes(), password=None)
        except (OSError, ValueError, TypeError) as error:
            raise KeysError(f"{path}: the authority's key cannot be read: {error}") from None
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != self._certificate.public_key():
            raise KeysError(f"{path}: is not the key of {self.folder / 'ca.pem'}")
        return key

    def _write(self, roster: Roster) -> None:
        try:
            _replace(self.folder / "roster.json", _encoded(roster))
        except OSError as error:
            raise KeysError(f"{self.folder / 'roster.json'}: cannot be written: {error.strerror}") from None
        self.roster = roster


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS_DIFFER)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _key_usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
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


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        pass
    labels = host.split(".")
    if len(host) > 253 or not all(_is_label(label) for label in labels) or labels[-1].isdigit():
        raise KeysError(f"--host {host}: is neither an address nor a host's name (no port, no tls/)")
    return x509.DNSName(host.lower())


def _is_label(label: str) -> bool:
    return re.fullmatch(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?", label) is not None


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _public(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _encoded(roster: Roster) -> bytes:
    return msgspec.json.format(msgspec.json.encode(roster), indent=2) + b"\n"


def _create(path: Path, data: bytes, mode: int) -> None:
    """Write a file that must not exist, with its mode from the first byte on."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with open(descriptor, "wb") as file:
        os.fchmod(descriptor, mode)
        file.write(data)


def _replace(path: Path, data: bytes) -> None:
    """Replace a file as a whole: whoever reads it meanwhile has the old or the new."""
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
        file.write(data)
        file.flush()
        os.fchmod(file.fileno(), 0o644)
        os.fsync(file.fileno())
    Path(file.name).replace(path)
