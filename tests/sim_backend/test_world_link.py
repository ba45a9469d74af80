"""What is insisted on reaches the mock devices of a world elsewhere, and holds against commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from threading import Event, Thread

import pytest
from msgspec.structs import replace

from drivers.samples import AutopilotCommand, Engage, Interface, JointMode, ServoCommand
from drivers.vehicle import Vehicle
from sim_backend.world import World
from sim_backend.world_client import LinkedAutopilot, LinkedServos, WorldClient
from sim_backend.world_link import WorldServer
from tests.drivers.px4_rig import VEHICLE
from tests.waiting import LONG, seconds_until

OFFBOARD = AutopilotCommand(Engage.OFFBOARD, Interface.ATTITUDE, 3.0, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3)
HELD = ServoCommand(JointMode.POSITION, (0.0,) * 3, (0.0,) * 5, 1.0)


class Rig:
    """A world that moves in a thread, one client with its mock devices, and one that only looks."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.world = World(vehicle)
        self._server = WorldServer(self.world, lambda t_ns: t_ns)
        self.client = WorldClient(self._server.address, ("autopilot", "servos"))
        self.viewer = WorldClient(self._server.address)
        self.autopilot, self.servos = LinkedAutopilot(self.client), LinkedServos(self.client)
        self._over = Event()
        self._thread = Thread(target=self._run)
        self._thread.start()
        self.client.start(LONG)
        self.viewer.start(LONG)

    def _run(self) -> None:
        while not self._over.wait(0.004):
            self._server.receive()
            self.world.advance(0.004)
            self._server.publish()

    def close(self) -> None:
        self.client.stop()
        self.viewer.stop()
        self._over.set()
        self._thread.join()
        self._server.close()

    def commanded(self, condition: Callable[[], bool]) -> None:
        """Command flight and held joints until it comes true."""

        def tick() -> bool:
            self.autopilot.command(OFFBOARD)
            self.servos.command(HELD)
            return condition()

        seconds_until(tick)

    def armed(self) -> bool:
        state = self.autopilot.latest()
        return state is not None and state.armed

    def torque(self) -> bool:
        state = self.servos.latest()
        return state is not None and state.torque_on


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig(VEHICLE)
    yield rig
    rig.close()


def test_a_kill_and_its_end(rig: Rig) -> None:
    rig.commanded(lambda: rig.armed() and rig.torque())
    rig.autopilot.insist(Engage.KILL)
    rig.servos.insist(True)
    rig.commanded(lambda: not rig.armed() and not rig.torque())
    began = rig.world.time
    ever: list[bool] = []

    def a_second() -> bool:
        ever.append(rig.armed() or rig.torque())
        return rig.world.time > began + 1.0

    rig.commanded(a_second)
    assert not any(ever)
    rig.servos.insist(False)
    rig.commanded(rig.torque)
    rig.autopilot.insist(None)
    rig.autopilot.command(replace(OFFBOARD, engage=Engage.IDLE))
    rig.commanded(rig.armed)
