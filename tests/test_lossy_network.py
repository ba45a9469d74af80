"""The lossy network itself: what TCP makes of it, and how much is lost."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.lossy_network import ADDRESSES, LossyNetwork, UnavailableError

_SERVER = """
import socket
with socket.create_server(("", 7000)) as listener:
    print("listening", flush=True)
    peer, _ = listener.accept()
    with peer:
        while data := peer.recv(4096):
            peer.sendall(data)
"""
_CLIENT = """
import socket, sys, time
with socket.create_connection((sys.argv[1], 7000)) as peer:
    peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    trips = []
    for _ in range(30):
        began = time.monotonic()
        peer.sendall(b"x")
        assert peer.recv(1) == b"x"
        trips.append(time.monotonic() - began)
print(min(trips), sum(trips) / len(trips))
"""


@pytest.mark.parametrize(("loss", "delay"), [(0.0, 0.05), (0.2, 0.02)])
def test_tcp_over_it(loss: float, delay: float) -> None:
    with LossyNetwork(loss, delay) as network:
        try:
            server = network.start([sys.executable, "-c", _SERVER], stdout=subprocess.PIPE)
        except UnavailableError as error:
            pytest.skip(str(error))
        with server:
            assert server.stdout is not None
            assert server.stdout.readline() == "listening\n"
            client = network.start([sys.executable, "-c", _CLIENT, ADDRESSES[0]], stdout=subprocess.PIPE)
            told, _ = client.communicate(timeout=120.0)
            server.wait(60.0)
        least, mean = map(float, told.split())
        share = network.lost / (network.lost + network.carried)
    assert 2.0 * delay <= least < 2.0 * delay + 0.05
    if loss:
        assert mean > 1.5 * least
        assert share == pytest.approx(loss, abs=0.12)
    else:
        assert share == 0.0
