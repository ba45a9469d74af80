"""What the camera of a simulated world would tell, faults included: a T265 without librealsense.

Noise, drift and delay are those of the world's sensors; what goes wrong beyond them is declared in ``Faults``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import nan, radians
from random import Random

import msgspec

from drivers.rotation import about_z, heading, multiply, rotate
from drivers.samples import Odometry, Quat, Vec3
from drivers.tracking import CameraPose, Mount
from sim_backend import layout as at
from sim_backend.faults import Fault, Faults, Kind
from sim_backend.world import World

DEVICE = "odometry"
KINDS = (
    Kind.DROP, Kind.DELAY, Kind.FREEZE, Kind.JUMP, Kind.DRIFT, Kind.NAN, Kind.CONFIDENCE, Kind.SILENT, Kind.UNPLUGGED,
    Kind.REBOOT,
)  # fmt: skip
#: Between two poses, s.
PERIOD = 0.005
_PERIOD_NS = round(PERIOD * 1e9)


class Tracker:
    """The camera on a vehicle of ``world``: through the mounting, from where it was when its stream was opened.

    JUMP and DRIFT (m, m/s) lead along the camera's view at the start of its stream. After UNPLUGGED and REBOOT nothing
    comes until the stream is opened again.
    """

    def __init__(self, world: World, mount: Mount | None = None, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        self.world = world
        self.faults = Faults(DEVICE, KINDS, faults)
        self._mount = mount or Mount()
        self._q_BC = self._mount.q_BC()
        self._random = Random(seed)
        self._open = False
        self._dead = False
        self._seen: Odometry | None = None
        self._frozen: CameraPose | None = None
        self._waiting: deque[tuple[int, CameraPose]] = deque()
        self._origin: tuple[Vec3, Quat] | None = None
        self._moved = 0.0

    @property
    def gone(self) -> bool:
        """It is unplugged, or boots, now."""
        t = self.world.time
        return self.faults.find(Kind.UNPLUGGED, t) is not None or self.faults.find(Kind.REBOOT, t) is not None

    def step(self, streaming: bool) -> tuple[CameraPose, ...]:
        """The poses to be told now, in world time: one for each period, none twice, however often this is called.

        ``streaming``: somebody has opened the stream. When that begins, a new V begins with it.
        """
        now = self.world.snapshot
        t = now.t_ns * 1e-9
        self._look_at_stream(streaming)
        sample = self.world.sensors.odometry(now)
        if sample is not None and (self._seen is None or sample.t_ns // _PERIOD_NS != self._seen.t_ns // _PERIOD_NS):
            self._creep(sample, t)
            self._seen = sample
            delay = self.faults.strike(Kind.DELAY, t)
            later = round(delay.value * 1e9) if delay else 0
            self._waiting.append(
                (now.t_ns + later, self._pose(sample, (now.x[at.RATE], now.x[at.RATE + 1], now.x[at.RATE + 2])))
            )
        told = []
        while self._waiting and self._waiting[0][0] <= now.t_ns:
            pose = self._spoilt(self._waiting.popleft()[1], t)
            if pose is not None:
                told.append(pose)
        return tuple(told)

    def _look_at_stream(self, streaming: bool) -> None:
        """A stream that was opened begins a new V; one whose camera went away is dead until it is opened again."""
        if streaming and not self._open:
            self._origin, self._moved, self._dead, self._seen = None, 0.0, False, None
            self._waiting.clear()
        self._open = streaming
        self._dead = self._dead or self.gone

    def _creep(self, sample: Odometry, t: float) -> None:
        self._moved += sum(fault.value for fault in self.faults.begun(Kind.JUMP, t))
        if self._seen is not None:
            creep = sum(fault.value for fault in self.faults.active(t) if fault.kind is Kind.DRIFT)
            self._moved += creep * (sample.t_ns - self._seen.t_ns) * 1e-9

    def _pose(self, sample: Odometry, w_WB_B: Vec3) -> CameraPose:
        """The camera's pose and velocity in V, of the body's in W."""
        q_WB = sample.q_WB
        arm, w = rotate(q_WB, self._mount.offset), rotate(q_WB, w_WB_B)
        p_WC = (sample.p_WB[0] + arm[0], sample.p_WB[1] + arm[1], sample.p_WB[2] + arm[2])
        v_WC = (
            sample.v_WB[0] + w[1] * arm[2] - w[2] * arm[1],
            sample.v_WB[1] + w[2] * arm[0] - w[0] * arm[2],
            sample.v_WB[2] + w[0] * arm[1] - w[1] * arm[0],
        )
        if self._origin is None:
            self._origin = (p_WC, about_z(-heading(q_WB) - radians(self._mount.rotation_deg[2])))
        o, q_VW = self._origin
        p = rotate(q_VW, (p_WC[0] - o[0], p_WC[1] - o[1], p_WC[2] - o[2]))
        return CameraPose(
            t_ns=sample.t_ns,
            p_VC=(p[0] + self._moved, p[1], p[2]),
            q_VC=multiply(q_VW, multiply(q_WB, self._q_BC)),
            v_VC=rotate(q_VW, v_WC),
            w_VC=rotate(q_VW, w),
            confidence=sample.confidence,
        )

    def _spoilt(self, pose: CameraPose, t: float) -> CameraPose | None:
        """What is told in place of this pose; nothing, if a fault keeps it."""
        faults = self.faults
        if self._dead or faults.find(Kind.SILENT, t):
            return None
        if faults.strike(Kind.DROP, t, chance=self._random.random()):
            return None
        if faults.find(Kind.FREEZE, t):
            self._frozen = self._frozen or pose
            pose = msgspec.structs.replace(self._frozen, t_ns=pose.t_ns)
        else:
            self._frozen = None
        if faults.find(Kind.NAN, t):
            pose = msgspec.structs.replace(pose, p_VC=(nan, nan, nan))
        confidence = faults.find(Kind.CONFIDENCE, t)
        if confidence is not None:
            pose = msgspec.structs.replace(pose, confidence=round(confidence.value))
        return pose
