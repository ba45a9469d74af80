"""What a station is told that sees no vehicle: against real sessions, on loopback."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh
from msgspec.structs import replace

from groundstation.refusal import why_refused
from onboard.admission import vehicle_security
from onboard.identity import Identity
from onboard.messages import Role
from tests.zenoh_sessions import Fleet, free_port, opened

LONG_AGO = datetime.now(UTC) - timedelta(days=400)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    folder = tmp_path_factory.mktemp("keys") / "authority"
    return Fleet(folder, falcon=Role.VEHICLE, alice=Role.OPERATOR, bob=Role.VIEWER)


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def vehicle(fleet: Fleet, port: int) -> Iterator[zenoh.Session]:
    with listening(fleet, fleet["falcon"], port) as session:
        yield session


def listening(fleet: Fleet, identity: Identity, port: int, name: str = "falcon") -> zenoh.Session:
    posing = replace(identity, name=name, role=Role.VEHICLE)
    return opened("router", f"tls/127.0.0.1:{port}", vehicle_security(name, posing, fleet.authority.roster))


def mixed(folder: Path, authority_of: Identity, identity: Identity) -> Identity:
    """A certificate, beside which lies the certificate of an authority that did not make it."""
    folder.mkdir()
    (folder / "ca.pem").write_bytes(authority_of.ca.read_bytes())
    for path in (identity.certificate, identity.key):
        (folder / path.name).write_bytes(path.read_bytes())
    return replace(identity, folder=folder)


def expired(fleet: Fleet, name: str, role: Role, out: Path) -> Identity:
    """A certificate that was valid for a day, 400 days ago."""
    fleet.authority.add(name, role, days=1, now=LONG_AGO, out=out)
    return Identity(out, name, role, (), LONG_AGO + timedelta(days=1))


@pytest.mark.usefixtures("vehicle")
def test_who_is_not_on_the_roster_is_told(fleet: Fleet, port: int) -> None:
    told = why_refused(f"tls/127.0.0.1:{port}", "falcon", fleet["alice"])
    assert told.startswith(f"tls/127.0.0.1:{port}: falcon knows the authority of alice, and shows it nothing: ")
    assert "alice is revoked, or not on the roster that falcon has" in told
    assert "copy roster.json to the vehicle and restart its link" in told


@pytest.mark.usefixtures("vehicle")
def test_another_vehicle_is_named(fleet: Fleet, port: int) -> None:
    told = why_refused(f"tls/127.0.0.1:{port}", "eagle", fleet["alice"])
    assert "this is the vehicle falcon, not eagle" in told


@pytest.mark.usefixtures("vehicle")
def test_a_vehicle_of_another_authority(fleet: Fleet, port: int, tmp_path: Path) -> None:
    stranger = Fleet(tmp_path / "other", alice=Role.OPERATOR)["alice"]
    told = why_refused(f"tls/127.0.0.1:{port}", "falcon", stranger)
    assert f"the vehicle's certificate is of another authority than {stranger.ca}" in told


@pytest.mark.usefixtures("vehicle")
def test_a_station_of_another_authority(fleet: Fleet, port: int, tmp_path: Path) -> None:
    stranger = Fleet(tmp_path / "other", alice=Role.OPERATOR)["alice"]
    told = why_refused(f"tls/127.0.0.1:{port}", "falcon", mixed(tmp_path / "mixed", fleet["alice"], stranger))
    assert "the vehicle trusts another authority than that of alice; both need certificates of the same" in told


def test_certificates_that_have_expired(port: int, tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "authority", falcon=Role.VEHICLE, alice=Role.OPERATOR)
    old_eagle = expired(fleet, "eagle", Role.VEHICLE, tmp_path / "eagle")
    old_bob = expired(fleet, "bob", Role.OPERATOR, tmp_path / "bob")
    with listening(fleet, fleet["falcon"], port):
        told = why_refused(f"tls/127.0.0.1:{port}", "falcon", old_bob)
    ended = f"{LONG_AGO + timedelta(days=1):%Y-%m-%d}"
    assert f"takes the certificate of bob for expired; it is valid until {ended}" in told
    assert "Set the vehicle's clock, or on the authority: pipewright keys add bob --role operator --renew" in told
    with listening(fleet, old_eagle, port, "eagle"):
        told = why_refused(f"tls/127.0.0.1:{port}", "eagle", fleet["alice"])
    assert f"the certificate of eagle expired on {ended}" in told
    assert "pipewright keys add eagle --role vehicle --renew" in told


def test_a_certificate_that_is_not_valid_yet(port: int, tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "authority", alice=Role.OPERATOR)
    future = datetime.now(UTC) + timedelta(days=10)
    fleet.authority.add("eagle", Role.VEHICLE, now=future, out=tmp_path / "eagle")
    with listening(fleet, Identity(tmp_path / "eagle", "eagle", Role.VEHICLE, (), future), port, "eagle"):
        told = why_refused(f"tls/127.0.0.1:{port}", "eagle", fleet["alice"])
    assert "the certificate of eagle is valid from " in told
    assert "is the clock of this machine right?" in told


def test_an_address_that_the_certificate_does_not_name(fleet: Fleet, port: int) -> None:
    security = vehicle_security("falcon", fleet["falcon"], fleet.authority.roster)
    with opened("router", f"tls/127.0.0.2:{port}", security):
        told = why_refused(f"tls/127.0.0.2:{port}", "falcon", fleet["alice"])
    assert "is for falcon, falcon.local, localhost, 127.0.0.1, ::1, not 127.0.0.2" in told
    assert told.endswith("pipewright keys add falcon --role vehicle --renew --host 127.0.0.2")


def test_a_station_that_poses_as_a_vehicle(fleet: Fleet, port: int) -> None:
    with listening(fleet, fleet["bob"], port):
        told = why_refused(f"tls/127.0.0.1:{port}", "falcon", fleet["alice"])
    assert "bob is no vehicle, but poses as one: do not trust this network" in told


@pytest.mark.usefixtures("vehicle")
@pytest.mark.parametrize("protocol", ["tls", "tcp"])
def test_a_plain_client_is_told_to_bring_certificates(port: int, protocol: str) -> None:
    told = why_refused(f"{protocol}/127.0.0.1:{port}", "falcon", None)
    assert told.startswith(f"{protocol}/127.0.0.1:{port}: the vehicle wants certificates: connect to tls/127.0.0.1:")


def test_a_plain_vehicle_is_recognised(fleet: Fleet, port: int) -> None:
    with opened("router", f"tcp/127.0.0.1:{port}", {}):
        secured = why_refused(f"tls/127.0.0.1:{port}", "falcon", fleet["alice"], timeout=0.3)
        bare = why_refused(f"tls/127.0.0.1:{port}", "falcon", None, timeout=0.3)
        plain = why_refused(f"tcp/127.0.0.1:{port}", "falcon", None, timeout=0.3)
    assert "it answers nothing, as a vehicle without certificates does" in secured
    assert f"Those are at tcp/127.0.0.1:{port}" in bare
    assert "shows no vehicle of this name" in plain


def test_a_listener_that_is_no_vehicle(fleet: Fleet, port: int) -> None:
    with socket.create_server(("127.0.0.1", port)) as silent:
        told = why_refused(f"tls/127.0.0.1:{port}", "falcon", fleet["alice"], timeout=0.3)
        assert "it answers nothing" in told
        silent.settimeout(5.0)
        silent.accept()[0].close()


def test_nobody_listens(fleet: Fleet, port: int) -> None:
    told = why_refused(f"tls/127.0.0.1:{port}", "falcon", fleet["alice"])
    assert told.endswith("the machine is there, but no vehicle listens; does its service run, and on this port?")


def test_a_host_that_is_not_known(fleet: Fleet) -> None:
    told = why_refused("tls/falcon.invalid:7447", "falcon", fleet["alice"])
    assert "the name falcon.invalid is not known here" in told


@pytest.mark.parametrize("endpoint", ["falcon.local:7447", "udp/falcon.local:7447", "tls/falcon.local", "tls/:7447"])
def test_what_is_no_endpoint(endpoint: str) -> None:
    assert why_refused(endpoint, "falcon", None) == f"{endpoint}: is no endpoint; it is like tls/falcon.local:7447"
