"""Who a machine is on the link: the certificate and key that it was handed."""

from __future__ import annotations

import os
import ssl
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msgspec import Struct

from onboard.roster import Role


class IdentityError(Exception):
    """A certificate or key cannot be used; the text says which, why and what to do."""


class Identity(Struct, frozen=True):
    """What ``pipewright keys add`` hands to a person or machine, found whole and fitting together."""

    folder: Path
    name: str
    role: Role
    hosts: tuple[str, ...]
    """Names and addresses a vehicle may be connected to by; none of a station."""
    expires: datetime
    """When the certificate does (UTC)."""

    @property
    def ca(self) -> Path:
        """Certificate of the authority."""
        return self.folder / "ca.pem"

    @property
    def certificate(self) -> Path:
        """Its own certificate."""
        return self.folder / "cert.pem"

    @property
    def key(self) -> Path:
        """Its private key."""
        return self.folder / "key.pem"


def load_identity(folder: Path) -> Identity:
    """Read and check what is in a folder: files, modes, that key, certificate and authority fit, and the dates.

    Raises IdentityError.
    """
    ca, certificate, key = (folder / name for name in ("ca.pem", "cert.pem", "key.pem"))
    for path in (ca, certificate, key):
        _readable(path)
    if key.stat().st_mode & 0o077:
        raise IdentityError(f"{key}: others may read it; make it private: chmod 600 {key}")
    told = _presented(ca, certificate, key)
    try:
        subject = {name: value for part in told["subject"] for name, value in part}
        expires = datetime.fromtimestamp(ssl.cert_time_to_seconds(told["notAfter"]), UTC)
        hosts = tuple(host for kind, host in told.get("subjectAltName", ()) if kind in ("DNS", "IP Address"))
        return Identity(folder, subject["commonName"], Role(subject["organizationalUnitName"]), hosts, expires)
    except (KeyError, ValueError):
        raise IdentityError(f"{certificate}: has no name or role; make one with: pipewright keys add") from None


def _readable(path: Path) -> None:
    try:
        path.open("rb").close()
    except PermissionError:
        remedy = f"folder and files must be its own: sudo chown -R {os.geteuid()} {path.parent}"
        raise IdentityError(f"{path}: this user may not read it; {remedy}") from None
    except OSError:
        raise IdentityError(f"{path}: is missing; copy the folder that `pipewright keys add` made, whole") from None


def _presented(ca: Path, certificate: Path, key: Path) -> dict[str, Any]:
    """The certificate as a listener would see it, who trusts the same authority.

    A handshake in memory finds every fault that one over the wire would, and needs nothing but the standard library.
    """
    listener = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    listener.verify_mode = ssl.CERT_REQUIRED
    caller = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    caller.check_hostname, caller.verify_mode = False, ssl.CERT_NONE
    try:
        listener.load_verify_locations(ca)
    except (ssl.SSLError, OSError):
        raise IdentityError(f"{ca}: is no certificate; copy it again") from None
    for context in (listener, caller):
        try:
            # An encrypted key would ask on the terminal otherwise.
            context.load_cert_chain(certificate, key, password="")
        except (ssl.SSLError, OSError, ValueError) as error:
            mismatch = getattr(error, "reason", None) == "KEY_VALUES_MISMATCH"
            wrong = "do not belong together" if mismatch else "cannot be read as certificate and private key"
            raise IdentityError(f"{certificate} and {key.name}: {wrong}; copy both again") from None
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    heard = listener.wrap_bio(there, back, server_side=True)
    calling = caller.wrap_bio(back, there)
    try:
        for step in (calling.do_handshake, heard.do_handshake, calling.do_handshake):
            _as_far_as_it_goes(step)
        heard.do_handshake()
    except ssl.SSLCertVerificationError as error:
        raise IdentityError(f"{certificate}: {error.verify_message}, says {ca}{_remedy(error)}") from None
    told = heard.getpeercert()
    assert told, "a verified handshake has a certificate"
    return told


def _as_far_as_it_goes(step: Callable[[], None]) -> None:
    try:
        step()
    except ssl.SSLWantReadError:
        return


def _remedy(error: ssl.SSLCertVerificationError) -> str:
    match error.verify_code:
        case 9:
            return f"; is the clock of this machine right? It says {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
        case 10:
            return "; have a new one made: pipewright keys add NAME --role ROLE --renew"
        case 18 | 19 | 20 | 21:
            return "; both must come from the same authority"
    return "; make one with: pipewright keys add"
