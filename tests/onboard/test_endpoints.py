"""Endpoints that may be, and the one sentence on each that may not."""

from __future__ import annotations

import re

import pytest

from onboard.endpoints import LinkError, open_session, unfit
from tests.zenoh_sessions import free_port


def one(endpoint: str, *, plain: bool = True, secured: bool = False) -> str:
    return next(unfit([endpoint], plain=plain, secured=secured), "")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "[::1]", "localhost"])
def test_plain_on_loopback_when_it_is_allowed(host: str) -> None:
    assert one(f"tcp/{host}:7447") == ""
    assert one(f"tcp/{host}:7447", plain=False) == (
        f"tcp/{host}:7447: is plain, which is not allowed here; allow it (plain: true), or use tls"
    )


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.10", "[::]", "[fe80::1]", "jetson.local", "localhost.evil"])
def test_plain_is_never_allowed_elsewhere(host: str) -> None:
    assert one(f"tcp/{host}:7447").startswith(f"tcp/{host}:7447: plain TCP is only for loopback; use tls/{host}:7447")


def test_tls_takes_keys() -> None:
    assert one("tls/192.168.1.10:7447", plain=False, secured=True) == ""
    assert "there are no keys for TLS" in one("tls/192.168.1.10:7447")


@pytest.mark.parametrize(
    "endpoint",
    ["", "127.0.0.1:7447", "tcp/127.0.0.1", "tcp/127.0.0.1:0", "tcp/127.0.0.1:65536", "udp/127.0.0.1:7447",
     "tcp/127.0.0.1:7447#iface=lo", "tcp/127.0.0.1:7447?rel=0", "tcp//127.0.0.1:7447", "tcp/127.0.0.1:7447\n"],
)  # fmt: skip
def test_what_is_no_endpoint(endpoint: str) -> None:
    assert one(endpoint).startswith(f"{endpoint}: is no endpoint; like tls/192.168.1.10:7447")


def test_all_errors_at_once_and_nothing_is_opened() -> None:
    with pytest.raises(LinkError) as caught:
        open_session("router", ["tcp/0.0.0.0:1", "tls/0.0.0.0:2", "x"], plain=True, lease=0.6, security={})
    assert len(str(caught.value).splitlines()) == 3


def test_no_endpoint_at_all() -> None:
    with pytest.raises(LinkError, match="the link has no endpoint"):
        open_session("client", [], plain=True, lease=0.6, security={})


def test_what_zenoh_itself_refuses() -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with pytest.raises(LinkError, match=rf"{re.escape(endpoint)}: .*Missing TLS private key\.$"):
        open_session("router", [endpoint], plain=False, lease=0.6, security={"transport/link/tls": {}})
