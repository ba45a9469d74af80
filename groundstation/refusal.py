"""Why a vehicle is not seen: what Zenoh does not say, found out by connecting once with TLS alone.

A session that is refused sees nobody and is told nothing. The handshake beneath it does tell: the vehicle's certificate
is shown, and what the vehicle thinks of ours comes back as an alert.
"""

from __future__ import annotations

import re
import socket
import ssl
import time

from cryptography import x509
from cryptography.x509.oid import NameOID

from onboard.messages import Identity

# Results of the verification of the vehicle's certificate (X509_V_ERR_...).
_NOT_YET, _EXPIRED, _PURPOSE, _OTHER_NAME = 9, 10, 26, (62, 64)
_RENEW = "pipewright keys add {name} --role {role} --renew"


class _UnreachableError(Exception):
    """The reason."""


def why_refused(endpoint: str, vehicle: str, identity: Identity | None, timeout: float = 3.0) -> str:
    """Why nothing is seen of ``vehicle`` at ``endpoint`` (``tls/HOST:PORT`` or ``tcp/HOST:PORT``), and what to do.

    identity: that of this station, None without certificates. timeout: for each answer of the vehicle, s.
    """
    match = re.fullmatch(r"(tls|tcp)/(?:\[([^]]+)\]|([^:]+)):(\d{1,5})", endpoint)
    if match is None:
        return f"{endpoint}: is no endpoint; it is like tls/falcon.local:7447"
    protocol, host, port = match[1], match[2] or match[3], int(match[4])
    try:
        with _connected(host, port, timeout) as connection:
            if protocol == "tcp" or identity is None:
                return f"{endpoint}: {_plain(connection, host, protocol, port)}"
            return f"{endpoint}: {_secured(connection, (host, port), vehicle, identity, timeout)}"
    except _UnreachableError as found:
        return f"{endpoint}: {found}"


def _connected(host: str, port: int, timeout: float) -> socket.socket:
    try:
        return socket.create_connection((host, port), timeout)
    except socket.gaierror:
        raise _UnreachableError(f"the name {host} is not known here; give the address, or check the network") from None
    except TimeoutError:
        raise _UnreachableError("no answer; is the vehicle on, and this machine in its network?") from None
    except ConnectionRefusedError:
        raise _UnreachableError(
            "the machine is there, but no vehicle listens; does its service run, and on this port?"
        ) from None
    except (OSError, OverflowError) as error:
        raise _UnreachableError(f"cannot be reached: {error}") from None


def _plain(connection: socket.socket, host: str, protocol: str, port: int) -> str:
    """Without certificates, or without TLS, at what may be a vehicle that wants both."""
    context = _context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        context.wrap_socket(connection, server_hostname=host).close()
    except (ssl.SSLError, OSError):
        if protocol == "tls":
            return f"it does not speak TLS; is it a vehicle without certificates? Those are at tcp/127.0.0.1:{port}"
        return "it does not speak TLS, and shows no vehicle of this name; is the name right, and is it a vehicle?"
    return f"the vehicle wants certificates: connect to tls/{host}:{port}, with the folder of `pipewright keys add`"


def _secured(
    connection: socket.socket, address: tuple[str, int], vehicle: str, identity: Identity, timeout: float
) -> str:
    context = _context()
    context.load_verify_locations(identity.ca)
    context.load_cert_chain(identity.certificate, identity.key)
    try:
        secure = context.wrap_socket(connection, server_hostname=address[0])
    except ssl.SSLCertVerificationError as error:
        return _distrusted(error, _shown(address, timeout), address[0], identity)
    except TimeoutError:
        return "it answers nothing, as a vehicle without certificates does; or the network is too slow"
    except ssl.SSLError as error:
        return f"it does not speak TLS ({error.reason}); is it a vehicle, and not without certificates?"
    except OSError:
        return "it hangs up; is it a vehicle, and not without certificates?"
    with secure:
        shown_name = _name(x509.load_der_x509_certificate(secure.getpeercert(binary_form=True) or b""))
        if (judged := _judged(secure, identity, timeout)) is not None:
            return judged
    if shown_name != vehicle:
        return f"this is the vehicle {shown_name}, not {vehicle}; connect to the other, or ask for {shown_name}"
    return (
        f"{vehicle} knows the authority of {identity.name}, and shows it nothing: {identity.name} is revoked, or not "
        f"on the roster that {vehicle} has. See `pipewright keys list`, copy roster.json to the vehicle and restart "
        "its link. If others see nothing either, its link does not run."
    )


def _context() -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    return context


def _shown(address: tuple[str, int], timeout: float) -> x509.Certificate:
    """The certificate of the vehicle, trusted or not."""
    try:
        return x509.load_pem_x509_certificate(ssl.get_server_certificate(address, timeout=timeout).encode())
    except OSError as error:
        raise _UnreachableError(f"its certificate is not trusted, and it showed it once only: {error}") from None


def _distrusted(error: ssl.SSLCertVerificationError, shown: x509.Certificate, host: str, identity: Identity) -> str:
    """What is wrong with the certificate of the vehicle."""
    name, code = _name(shown), error.verify_code
    begins, ends = (f"{date:%Y-%m-%d}" for date in (shown.not_valid_before_utc, shown.not_valid_after_utc))
    renew = _RENEW.format(name=name, role="vehicle")
    if code in _OTHER_NAME:
        names = _hosts(shown)
        return (
            f"the certificate of {name} is for {names}, not {host}; connect to one of these, or: {renew} --host {host}"
        )
    if code == _EXPIRED:
        return f"the certificate of {name} expired on {ends}; on the authority: {renew}"
    if code == _NOT_YET:
        return f"the certificate of {name} is valid from {begins} on; is the clock of this machine right?"
    if code == _PURPOSE:
        return f"{name} is no vehicle, but poses as one: do not trust this network"
    return f"the vehicle's certificate is of another authority than {identity.ca} ({error.verify_message})"


def _judged(secure: ssl.SSLSocket, identity: Identity, timeout: float) -> str | None:
    """What the vehicle thinks of our certificate; None: it is content.

    In TLS 1.3 that comes after the handshake: an alert, or a ticket for the next time.
    """
    until = time.monotonic() + timeout
    secure.settimeout(0.05)
    while time.monotonic() < until and not (secure.session is not None and secure.session.has_ticket):
        try:
            if not secure.recv(1):
                break
        except TimeoutError:
            continue
        except ssl.SSLError as error:
            return _alert(error.reason or "", identity)
        except OSError:
            return f"the vehicle hangs up on the certificate of {identity.name}; its log says why"
    return None


def _alert(reason: str, identity: Identity) -> str:
    if "UNKNOWN_CA" in reason:
        return f"the vehicle trusts another authority than that of {identity.name}; both need certificates of the same"
    if "CERTIFICATE_EXPIRED" in reason:
        return (
            f"the vehicle takes the certificate of {identity.name} for expired; it is valid until "
            f"{identity.expires:%Y-%m-%d}. Set the vehicle's clock, or on the authority: "
            + _RENEW.format(name=identity.name, role=identity.role)
        )
    return f"the vehicle refuses the certificate of {identity.name} ({reason.lower().replace('_', ' ')})"


def _name(certificate: x509.Certificate) -> str:
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else "(nameless)"


def _hosts(certificate: x509.Certificate) -> str:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return "nothing"
    return ", ".join(str(name.value) for name in names)
