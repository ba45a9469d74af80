"""Who hears and asks what: real sessions with certificates, on loopback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

import pytest
import zenoh
from msgspec.structs import replace

from onboard.admission import Security, not_for, station_security, vehicle_security
from onboard.identity import Identity, IdentityError
from onboard.roster import Role, Roster
from tests.zenoh_sessions import Fleet, free_port, opened, wait_until

ROOT = "pipewright/falcon"
WAYS = ("safety", "view", "command")
PUBLISHED = ("pulse", "telemetry", "event")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    people = {"alice": Role.OPERATOR, "anna": Role.OPERATOR, "victor": Role.VIEWER}
    folder = tmp_path_factory.mktemp("keys") / "authority"
    return Fleet(folder, falcon=Role.VEHICLE, eagle=Role.VEHICLE, **people)


class VehicleEnd(AbstractContextManager["VehicleEnd"]):
    """Publishes, listens and answers as the link does."""

    def __init__(self, endpoint: str, security: Security) -> None:
        self.asked: list[str] = []
        self.pulses: list[str] = []
        self.session = opened("router", endpoint, security)
        self._declared = (
            self.session.liveliness().declare_token(f"{ROOT}/alive"),
            self.session.declare_subscriber(f"{ROOT}/station/*/*/pulse", self._pulse),
            *(self.session.declare_queryable(f"{ROOT}/station/*/*/{way}", self._answer) for way in WAYS),
        )

    def __exit__(self, *error: object) -> None:
        self.session.close()

    def publish(self, *more: str) -> None:
        for what in (*PUBLISHED, *more):
            self.session.put(f"{ROOT}/{what}", what.encode())

    def stations(self) -> set[str]:
        replies = self.session.liveliness().get(f"{ROOT}/station/*/*/alive")
        return {str(reply.ok.key_expr).split("/")[3] for reply in replies if reply.ok}

    def connected(self) -> set[str | None]:
        return {link.auth_identifier for link in self.session.info.links()}

    def _pulse(self, sample: zenoh.Sample) -> None:
        self.pulses.append(str(sample.key_expr))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            self.asked.append(str(query.key_expr))
            query.reply(query.key_expr, b"done")


class StationEnd(AbstractContextManager["StationEnd"]):
    """Listens to everything that a station may want to, and asks under any name."""

    def __init__(self, endpoint: str, security: Security, name: str, mode: str = "client") -> None:
        self.name = name
        self.heard: set[str] = set()
        self.session = opened(mode, endpoint, security)
        keys = [f"{ROOT}/{what}" for what in (*PUBLISHED, "ack/alice", "ack/victor", "secret")]
        others = zenoh.Locality.REMOTE
        self._declared = (
            *(
                self.session.declare_subscriber(key, self._hear, allowed_origin=others)
                for key in (*keys, "pipewright/**")
            ),
            self.session.liveliness().declare_token(f"{ROOT}/station/{name}/1/alive"),
        )

    def __exit__(self, *error: object) -> None:
        self.session.close()

    def sees_vehicle(self) -> bool:
        """A round trip: what the vehicle has sent before has then come."""
        return any(reply.ok for reply in self.session.liveliness().get(f"{ROOT}/alive"))

    def asks(self, way: str, name: str | None = None) -> bool:
        """Whether it is answered."""
        return any(reply.ok for reply in self.session.get(f"{ROOT}/station/{name or self.name}/1/{way}"))

    def _hear(self, sample: zenoh.Sample) -> None:
        self.heard.add(str(sample.key_expr).removeprefix(f"{ROOT}/"))


@pytest.fixture
def endpoint() -> str:
    return f"tls/127.0.0.1:{free_port()}"


@pytest.fixture
def vehicle(fleet: Fleet, endpoint: str) -> Iterator[VehicleEnd]:
    with VehicleEnd(endpoint, vehicle_security("falcon", fleet["falcon"], fleet.authority.roster)) as end:
        yield end


def station(fleet: Fleet, name: str, endpoint: str, vehicle: str = "falcon") -> StationEnd:
    return StationEnd(endpoint, station_security(vehicle, fleet[name]), name)


def gets_nothing(vehicle: VehicleEnd, end: StationEnd) -> None:
    """It neither hears, nor is heard, nor is answered, under any name."""
    vehicle.publish("ack/alice", "ack/victor", "secret")
    assert not end.sees_vehicle()
    assert not any(end.asks(way, name) for way in WAYS for name in ("alice", "victor", end.name))
    end.session.put(f"{ROOT}/station/{end.name}/1/pulse", b"")
    end.session.put(f"{ROOT}/telemetry", b"made up")
    assert not end.sees_vehicle()
    assert (end.heard, vehicle.asked, vehicle.pulses, vehicle.stations()) == (set(), [], [], set())


def test_an_operator_hears_and_asks_everything_under_the_own_name(
    fleet: Fleet, vehicle: VehicleEnd, endpoint: str
) -> None:
    with station(fleet, "alice", endpoint) as alice:
        assert alice.sees_vehicle()
        assert all(alice.asks(way) and not not_for(fleet["alice"], way) for way in WAYS)
        alice.session.put(f"{ROOT}/station/alice/1/pulse", b"")
        wait_until(lambda: vehicle.pulses == [f"{ROOT}/station/alice/1/pulse"], "the pulse")
        wait_until(lambda: vehicle.stations() == {"alice"}, "the token")
        vehicle.publish("ack/alice")
        wait_until(lambda: alice.heard == {*PUBLISHED, "ack/alice"}, "what is published")
        assert vehicle.asked == [f"{ROOT}/station/alice/1/{way}" for way in WAYS]


def test_a_viewer_hears_everything_and_asks_for_stop_retreat_and_kill(
    fleet: Fleet, vehicle: VehicleEnd, endpoint: str
) -> None:
    with station(fleet, "victor", endpoint) as victor:
        assert victor.sees_vehicle()
        assert [way for way in WAYS if victor.asks(way)] == ["safety", "view"]
        assert [way for way in WAYS if not not_for(fleet["victor"], way)] == ["safety", "view"]
        needed = "victor is a viewer: for this an operator's certificate is needed"
        assert not_for(fleet["victor"], "command") == needed
        vehicle.publish("ack/victor")
        wait_until(lambda: victor.heard == {*PUBLISHED, "ack/victor"}, "what is published")
        assert vehicle.asked == [f"{ROOT}/station/victor/1/{way}" for way in ("safety", "view")]


def test_nobody_uses_the_name_of_another(fleet: Fleet, vehicle: VehicleEnd, endpoint: str) -> None:
    with station(fleet, "victor", endpoint) as victor, station(fleet, "alice", endpoint) as alice:
        assert not any(victor.asks(way, "alice") for way in WAYS)
        victor.session.put(f"{ROOT}/station/alice/1/pulse", b"")
        victor.session.liveliness().declare_token(f"{ROOT}/station/anna/1/alive")
        vehicle.publish("ack/alice")
        assert victor.sees_vehicle()
        wait_until(lambda: "ack/alice" in alice.heard, "the answer to alice")
        wait_until(lambda: vehicle.stations() == {"alice", "victor"}, "both tokens")
        assert victor.sees_vehicle()
        assert "ack/alice" not in victor.heard
        assert (vehicle.asked, vehicle.pulses) == ([], [])


def test_nobody_but_the_vehicle_publishes_in_its_place(fleet: Fleet, vehicle: VehicleEnd, endpoint: str) -> None:
    with station(fleet, "alice", endpoint) as alice, station(fleet, "victor", endpoint) as victor:
        alice.session.put(f"{ROOT}/event", b"made up")
        alice.session.put(f"{ROOT}/secret", b"made up")
        assert alice.asks("view")
        assert victor.sees_vehicle()
        vehicle.session.put(f"{ROOT}/pulse", b"true")
        wait_until(lambda: victor.heard, "something")
        assert victor.heard == {"pulse"}


def test_another_vehicle_is_no_station(fleet: Fleet, vehicle: VehicleEnd, endpoint: str) -> None:
    posing = station_security("falcon", replace(fleet["eagle"], role=Role.OPERATOR))
    with StationEnd(endpoint, posing, "eagle") as eagle:
        gets_nothing(vehicle, eagle)


def test_who_is_not_on_the_roster_gets_nothing(fleet: Fleet, endpoint: str) -> None:
    everyone = fleet.authority.roster.members
    security = vehicle_security(
        "falcon", fleet["falcon"], Roster(members=tuple(m for m in everyone if m.name != "alice"))
    )
    with VehicleEnd(endpoint, security) as vehicle, station(fleet, "alice", endpoint) as alice:
        gets_nothing(vehicle, alice)


def test_an_empty_roster_admits_nobody(fleet: Fleet, endpoint: str) -> None:
    security = vehicle_security("falcon", fleet["falcon"], Roster())
    with VehicleEnd(endpoint, security) as vehicle, station(fleet, "alice", endpoint) as alice:
        gets_nothing(vehicle, alice)


def test_the_revoked_is_out_and_the_others_come_back(tmp_path: Path, endpoint: str) -> None:
    fleet = Fleet(tmp_path / "authority", falcon=Role.VEHICLE, alice=Role.OPERATOR, carol=Role.OPERATOR)
    with ExitStack() as stack:
        before = VehicleEnd(endpoint, vehicle_security("falcon", fleet["falcon"], fleet.authority.roster))
        with before:
            alice = stack.enter_context(station(fleet, "alice", endpoint))
            carol = stack.enter_context(station(fleet, "carol", endpoint))
            assert alice.asks("command")
            assert carol.asks("command")
        fleet.authority.revoke("carol")
        after = stack.enter_context(
            VehicleEnd(endpoint, vehicle_security("falcon", fleet["falcon"], fleet.authority.roster))
        )
        wait_until(lambda: after.connected() == {"alice", "carol"}, "both have connected again")
        wait_until(alice.sees_vehicle, "alice sees the vehicle again")
        assert alice.asks("command")
        carol.heard.clear()
        after.publish()
        wait_until(lambda: alice.heard >= set(PUBLISHED), "what is published")
        assert not carol.sees_vehicle()
        assert not any(carol.asks(way) for way in WAYS)
        assert carol.heard == set()
        assert after.stations() == {"alice"}


def test_a_certificate_of_another_authority_is_refused(
    fleet: Fleet, vehicle: VehicleEnd, endpoint: str, tmp_path: Path
) -> None:
    stranger = Fleet(tmp_path / "other", alice=Role.OPERATOR)["alice"]
    with pytest.raises(zenoh.ZError):
        opened("client", endpoint, station_security("falcon", stranger))
    mixed = station_security("falcon", fleet["alice"])
    mixed["transport/link/tls"] |= {
        "connect_certificate": str(stranger.certificate),
        "connect_private_key": str(stranger.key),
    }
    with pytest.raises(zenoh.ZError):
        opened("client", endpoint, mixed)
    assert vehicle.connected() == set()


def test_without_a_certificate_one_is_refused(fleet: Fleet, vehicle: VehicleEnd, endpoint: str) -> None:
    with pytest.raises(zenoh.ZError):
        opened("client", endpoint, {"transport/link/tls": {"root_ca_certificate": str(fleet["alice"].ca)}})
    assert vehicle.connected() == set()


def test_a_plain_client_sees_nothing(vehicle: VehicleEnd, endpoint: str) -> None:
    plain = endpoint.replace("tls/", "tcp/")
    with pytest.raises(zenoh.ZError):
        opened("client", plain, {})
    # A peer is opened whether or not it finds anybody.
    with StationEnd(plain, {"connect/timeout_ms": 0}, "alice", mode="peer") as peer:
        gets_nothing(vehicle, peer)
    assert vehicle.connected() == set()


def test_a_station_hears_no_other_vehicle_that_poses_as_the_one_it_means(fleet: Fleet, endpoint: str) -> None:
    posing = vehicle_security("falcon", replace(fleet["eagle"], name="falcon"), fleet.authority.roster)
    with VehicleEnd(endpoint, posing) as eagle, station(fleet, "alice", endpoint) as alice:
        assert eagle.connected() == {"alice"}
        gets_nothing(eagle, alice)


def test_a_station_cannot_listen_as_a_vehicle(fleet: Fleet, endpoint: str) -> None:
    posing = vehicle_security(
        "falcon", replace(fleet["victor"], name="falcon", role=Role.VEHICLE), fleet.authority.roster
    )
    with opened("router", endpoint, posing), pytest.raises(zenoh.ZError):
        opened("client", endpoint, station_security("falcon", fleet["alice"]))


def test_a_vehicle_is_connected_to_by_its_names_only(fleet: Fleet) -> None:
    endpoint = f"tls/127.0.0.2:{free_port()}"
    security = vehicle_security("falcon", fleet["falcon"], fleet.authority.roster)
    with opened("router", endpoint, security), pytest.raises(zenoh.ZError):
        opened("client", endpoint, station_security("falcon", fleet["alice"]))


def test_a_station_that_means_another_vehicle_sees_nothing(fleet: Fleet, vehicle: VehicleEnd, endpoint: str) -> None:
    with station(fleet, "alice", endpoint, vehicle="eagle") as alice:
        gets_nothing(vehicle, alice)


@pytest.mark.parametrize("name", ["alice", "victor"])
def test_a_vehicle_takes_no_certificate_of_a_station(fleet: Fleet, name: str) -> None:
    with pytest.raises(IdentityError, match=rf"{name}/cert.pem: is of {name}, \w+; give a vehicle's folder"):
        vehicle_security(name, fleet[name], fleet.authority.roster)


def test_a_station_takes_no_certificate_of_a_vehicle(fleet: Fleet) -> None:
    falcon: Identity = fleet["falcon"]
    with pytest.raises(IdentityError, match=r"is a vehicle's; give the folder of an operator or a viewer"):
        station_security("falcon", falcon)


def test_a_vehicle_has_the_name_of_its_certificate(fleet: Fleet) -> None:
    with pytest.raises(IdentityError, match=r"eagle/cert.pem: is of eagle, but this is falcon; make both the same"):
        vehicle_security("falcon", fleet["eagle"], fleet.authority.roster)
