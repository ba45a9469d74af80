"""``pipewright keys``: what it makes, what it refuses, and that it overwrites nothing."""

from __future__ import annotations

import argparse
import os
import stat
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from groundstation import keys
from groundstation.authority import Authority, KeysError
from onboard.identity import IdentityError, load_identity
from onboard.messages import Member, Role
from onboard.roster import load_roster

NOW = datetime.now(UTC)
MEMBER = b'{"name": "bob", "role": "viewer", "expires": "2030-01-01T00:00:00Z"}'


def keys_command(folder: Path, *arguments: str) -> int:
    parser = argparse.ArgumentParser()
    keys.add_parser(parser.add_subparsers())
    options = parser.parse_args(["keys", *arguments, "--authority", str(folder)])
    code: int = options.run(options)
    return code


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "keys" / "authority"


@pytest.fixture
def authority(folder: Path) -> Authority:
    return Authority.init(folder)


def everything(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_the_five_commands(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert keys_command(folder, "init") == 0
    assert keys_command(folder, "add", "falcon", "--role", "vehicle", "--host", "10.0.0.7", "--host", "pipe.lan") == 0
    assert keys_command(folder, "add", "alice", "--role", "operator", "--days", "20") == 0
    assert keys_command(folder, "add", "bob", "--role", "viewer") == 0
    assert keys_command(folder, "revoke", "bob") == 0
    told = capsys.readouterr().out
    assert f"keep {folder}/ca.key on this machine" in told
    assert f"copy {folder}/roster.json to every vehicle" in told
    assert keys_command(folder, "list") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [row[:2] for row in rows[:4]] == [
        ["NAME", "ROLE"],
        ["falcon", "vehicle"],
        ["alice", "operator"],
        ["bob", "viewer"],
    ]
    assert rows[1][3:] == ["729", "days", "left"]
    assert rows[2][3:] == ["19", "days", "left;", "renew", "it"]
    assert rows[3][3:] == ["revoked", f"{NOW:%Y-%m-%d}"]
    assert rows[4][:2] == ["(the", "authority)"]


def test_private_keys_are_private_and_the_certificates_are_as_meant(folder: Path, authority: Authority) -> None:
    made = authority.add("falcon", Role.VEHICLE, hosts=["10.0.0.7", "pipe.lan"])
    assert [mode(path) for path in (folder, made)] == [0o700, 0o700]
    assert [mode(path) for path in (folder / "ca.key", made / "key.pem")] == [0o600, 0o600]
    assert mode(made / "cert.pem") == 0o644
    falcon = load_identity(made)
    assert (falcon.name, falcon.role) == ("falcon", Role.VEHICLE)
    assert {"falcon", "falcon.local", "10.0.0.7", "pipe.lan", "localhost", "127.0.0.1"} <= set(falcon.hosts)
    assert timedelta(days=729) < falcon.expires - NOW < timedelta(days=731)
    alice = load_identity(authority.add("alice", Role.OPERATOR))
    assert (alice.name, alice.role, alice.hosts) == ("alice", Role.OPERATOR, ())
    ca = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
    for path in (falcon.certificate, alice.certificate):
        x509.load_pem_x509_certificate(path.read_bytes()).verify_directly_issued_by(ca)
    assert isinstance(ca.public_key(), ec.EllipticCurvePublicKey)


def test_private_keys_are_private_whatever_the_umask(folder: Path, authority: Authority) -> None:
    former = os.umask(0)
    try:
        made = authority.add("alice", Role.OPERATOR)
    finally:
        os.umask(former)
    assert (mode(made), mode(made / "key.pem")) == (0o700, 0o600)


def test_the_roster_is_what_vehicles_read(folder: Path, authority: Authority) -> None:
    authority.add("alice", Role.OPERATOR)
    authority.add("bob", Role.VIEWER)
    authority.revoke("alice")
    roster = load_roster(folder / "roster.json")
    assert roster == authority.roster == Authority(folder).roster
    assert (roster.admitted(Role.OPERATOR), roster.admitted(Role.VIEWER)) == ((), ("bob",))


def test_nothing_is_overwritten(folder: Path, authority: Authority, tmp_path: Path) -> None:
    made = authority.add("alice", Role.OPERATOR)
    before = everything(folder)
    with pytest.raises(KeysError, match="is not empty, and nothing is overwritten; give a new folder"):
        Authority.init(folder)
    with pytest.raises(KeysError, match=r"alice: has a certificate \(operator, until .*--renew"):
        authority.add("alice", Role.OPERATOR)
    with pytest.raises(KeysError, match="exists, and nothing is overwritten; move it away, or give another --out"):
        authority.add("alice", Role.OPERATOR, renew=True)
    with pytest.raises(KeysError, match="exists, and nothing is overwritten"):
        authority.add("bob", Role.OPERATOR, out=made)
    assert everything(folder) == before
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(KeysError, match="is a file; give a folder"):
        Authority.init(file)


def test_a_certificate_is_renewed_under_its_name(folder: Path, authority: Authority, tmp_path: Path) -> None:
    former = load_identity(authority.add("alice", Role.OPERATOR, days=1))
    renewed = load_identity(authority.add("alice", Role.OPERATOR, renew=True, out=tmp_path / "alice"))
    assert renewed.expires - former.expires == pytest.approx(timedelta(days=729), abs=timedelta(minutes=1))
    assert former.key.read_bytes() != renewed.key.read_bytes()
    assert [(m.name, m.expires) for m in authority.roster.members] == [("alice", renewed.expires)]
    with pytest.raises(KeysError, match="alice: is operator; for another role choose another name"):
        authority.add("alice", Role.VIEWER, renew=True, out=tmp_path / "viewer")
    with pytest.raises(KeysError, match="bob: has no certificate of this authority; there are: alice"):
        authority.add("bob", Role.VIEWER, renew=True)


def test_a_revoked_name_is_gone_for_good(authority: Authority, tmp_path: Path) -> None:
    authority.add("alice", Role.OPERATOR)
    authority.revoke("alice")
    for renew in (False, True):
        with pytest.raises(KeysError, match=r"alice: was revoked on .*; a revoked name is never given again"):
            authority.add("alice", Role.OPERATOR, renew=renew, out=tmp_path / "again")
    with pytest.raises(KeysError, match=r"alice: was revoked on .* already"):
        authority.revoke("alice")
    with pytest.raises(KeysError, match="bob: has no certificate of this authority; there are: alice"):
        authority.revoke("bob")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    "name", ["", "Alice", "-alice", "al ice", "../alice", "alice/x", "*", "a" * 33, "älice", "a\n"]
)
def test_what_is_no_name(authority: Authority, name: str) -> None:
    with pytest.raises(KeysError, match="is no name; it takes small letters, digits"):
        authority.add(name, Role.OPERATOR)


@pytest.mark.parametrize("host", ["", "tls/falcon", "falcon:7447", "10.0.0", "10.0.0.256", "-a.lan", "a..b", "a" * 64])
def test_what_is_no_host(folder: Path, authority: Authority, host: str) -> None:
    with pytest.raises(KeysError, match="is neither an address nor a host's name"):
        authority.add("falcon", Role.VEHICLE, hosts=[host])
    assert not (folder / "falcon").exists()


def test_what_does_not_fit_is_told(authority: Authority) -> None:
    with pytest.raises(KeysError, match="--host: only a vehicle is connected to; alice is to be operator"):
        authority.add("alice", Role.OPERATOR, hosts=["10.0.0.7"])
    for days in (0, -1, 4000):
        with pytest.raises(KeysError, match=rf"--days {days}: give 1 to 36\d\d; the authority's own certificate"):
            authority.add("alice", Role.OPERATOR, days=days)


def test_a_folder_without_authority_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert keys_command(folder, "list") == 2
    assert f"{folder}: no authority here; make one with: pipewright keys init" in capsys.readouterr().err
    assert not folder.exists()


def test_a_role_that_is_none_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        keys_command(folder, "add", "alice", "--role", "pilot")
    assert ended.value.code == 2
    assert "pilot" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "content", "told"),
    [
        ("ca.pem", b"x", "the authority cannot be read"),
        ("roster.json", b"{", "roster.json: Input data was truncated; copy it again"),
        ("roster.json", b'{"version": 2}', r"roster.json: Invalid enum value 2 - at `\$.version`"),
        (
            "roster.json",
            b'{"members": [%b]}' % MEMBER.replace(b"bob", b"Bob"),
            "'Bob' is no name; it takes small letters",
        ),
        ("roster.json", b'{"members": [%b, %b]}' % (MEMBER, MEMBER), "bob is there twice"),
    ],
)
def test_a_damaged_authority_is_told(folder: Path, authority: Authority, file: str, content: bytes, told: str) -> None:
    (folder / file).write_bytes(content)
    with pytest.raises(KeysError, match=told):
        Authority(folder)


def test_the_authoritys_key_must_be_there_and_private_and_its_own(
    folder: Path, authority: Authority, tmp_path: Path
) -> None:
    key = folder / "ca.key"
    key.chmod(0o640)
    with pytest.raises(KeysError, match="others may read the authority's key; make it private again: chmod 600"):
        authority.add("alice", Role.OPERATOR)
    key.chmod(0o600)
    Authority.init(tmp_path / "other")
    key.write_bytes((tmp_path / "other" / "ca.key").read_bytes())
    with pytest.raises(KeysError, match=r"ca.key: is not the key of .*ca.pem"):
        authority.add("alice", Role.OPERATOR)
    key.write_bytes(b"x")
    with pytest.raises(KeysError, match="the authority's key cannot be read"):
        authority.add("alice", Role.OPERATOR)
    key.unlink()
    with pytest.raises(KeysError, match="the authority's key cannot be read"):
        authority.add("alice", Role.OPERATOR)
    assert authority.roster.members == ()


def test_the_list_shows_what_is_about_to_expire() -> None:
    def member(name: str, days: float) -> Member:
        return Member(name, Role.OPERATOR, NOW + timedelta(days=days))

    members = (member("old", -1), member("soon", 29.5), member("young", 100.5))
    rows = list(keys.listed(members, NOW + timedelta(days=1000.5), NOW))
    assert [row.split("  ")[-1] for row in rows[1:]] == [
        "EXPIRED",
        "29 days left; renew it",
        "100 days left",
        "1000 days left",
    ]


def test_what_is_handed_out_is_checked_before_it_is_used(authority: Authority, tmp_path: Path) -> None:
    alice, bob = (authority.add(name, Role.OPERATOR) for name in ("alice", "bob"))
    other = Authority.init(tmp_path / "other")
    (alice / "key.pem").chmod(0o644)
    with pytest.raises(IdentityError, match=r"alice/key.pem: others may read it; make it private: chmod 600"):
        load_identity(alice)
    (alice / "key.pem").chmod(0o600)
    own = (alice / "key.pem").read_bytes()
    (alice / "key.pem").write_bytes((bob / "key.pem").read_bytes())
    with pytest.raises(IdentityError, match=r"cert\.pem and key\.pem: do not belong together; copy both again"):
        load_identity(alice)
    (alice / "key.pem").write_bytes(b"x")
    with pytest.raises(IdentityError, match="cannot be read as certificate and private key"):
        load_identity(alice)
    (alice / "key.pem").write_bytes(own)
    assert load_identity(alice).name == "alice"
    (alice / "ca.pem").write_bytes((other.folder / "ca.pem").read_bytes())
    with pytest.raises(IdentityError, match="both must come from the same authority"):
        load_identity(alice)
    (alice / "ca.pem").write_bytes(b"x")
    with pytest.raises(IdentityError, match=r"alice/ca.pem: is no certificate; copy it again"):
        load_identity(alice)
    (alice / "ca.pem").unlink()
    with pytest.raises(IdentityError, match=r"alice/ca.pem: is missing; copy the folder"):
        load_identity(alice)


@pytest.mark.parametrize("closed", ["alice", "alice/ca.pem", "alice/key.pem"])
def test_keys_that_belong_to_another_user_are_told(authority: Authority, folder: Path, closed: str) -> None:
    """As after ``sudo cp``: the service has a user of its own. Root may read anything, so a child drops that right."""
    authority.add("alice", Role.OPERATOR)
    (folder / closed).chmod(0)
    ask = f"import onboard.identity as i, pathlib; i.load_identity(pathlib.Path({str(folder / 'alice')!r}))"
    command = [sys.executable, "-c", ask]
    if os.geteuid() == 0:
        command = ["setpriv", "--bounding-set=-dac_override,-dac_read_search", "--", *command]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = folder / (closed if closed.endswith(".pem") else f"{closed}/ca.pem")
    remedy = f"folder and files must be its own: sudo chown -R {os.geteuid()} {folder / 'alice'}"
    assert done.stderr.endswith(f"{told}: this user may not read it; {remedy}\n")


def test_a_certificate_outside_its_dates_is_told(folder: Path) -> None:
    authority = Authority.init(folder, now=NOW - timedelta(days=400))
    old = authority.add("old", Role.OPERATOR, days=1, now=NOW - timedelta(days=400))
    with pytest.raises(IdentityError, match=r"certificate has expired.*pipewright keys add NAME --role ROLE --renew"):
        load_identity(old)
    young = authority.add("young", Role.OPERATOR, now=NOW + timedelta(days=5))
    with pytest.raises(
        IdentityError, match=r"certificate is not yet valid.*is the clock of this machine right\? It says"
    ):
        load_identity(young)


def test_a_certificate_without_a_role_is_told(tmp_path: Path) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "alice")])
    builder = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
    builder = builder.not_valid_before(NOW - timedelta(days=1)).not_valid_after(NOW + timedelta(days=1))
    certificate = builder.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM)
    (tmp_path / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    (tmp_path / "key.pem").chmod(0o600)
    for file in ("ca.pem", "cert.pem"):
        (tmp_path / file).write_bytes(certificate)
    with pytest.raises(IdentityError, match="has no name or role; make one with: pipewright keys add"):
        load_identity(tmp_path)


def test_the_authoritys_own_certificate_is_nobodys(authority: Authority, folder: Path) -> None:
    (folder / "mine").mkdir()
    for name, source in (("ca.pem", "ca.pem"), ("cert.pem", "ca.pem"), ("key.pem", "ca.key")):
        (folder / "mine" / name).write_bytes((folder / source).read_bytes())
    (folder / "mine" / "key.pem").chmod(0o600)
    with pytest.raises(IdentityError, match=r"unsuitable certificate purpose.*make one with: pipewright keys add"):
        load_identity(folder / "mine")
