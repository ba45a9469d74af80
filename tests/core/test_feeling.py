"""The pipe is where it is felt: the way to the touch, what is made of it, and contact that is looked for again."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from onboard.config import Config, load_config
from onboard.core import force_profile, plan
from onboard.core.derived import derive
from onboard.core.types import Phase
from tests.core.following import DT, Follower, Step

CONFIG: Config = load_config(
    "paper", sets=["plan.feel=true", "guidance.seek_time=2.0", "pipe.position=[2.0,0.7,1.8]", "pipe.heading_deg=35.0"]
)
SITE = derive(CONFIG).site
P, G = CONFIG.plan, CONFIG.guidance


def ahead(follower: Follower) -> float:
    """How far the gripper's tip is beyond the believed crack, m."""
    return follower.reach - follower.from_crack


def touching(follower: Follower, along: float) -> Follower:
    """The tip of ``follower`` touches, so far beyond the believed crack."""
    (x, y, z), (nx, ny) = SITE.crack, SITE.normal
    tip = (x + along * nx, y + along * ny, z)
    follower.estimate = replace(follower.estimate, in_contact=True, tip_W=tip)
    return follower


def felt(along: float) -> Follower:
    """In ALIGN, the pipe just felt."""
    follower = Follower(CONFIG)
    for phase in (Phase.PREFLIGHT, Phase.TAKEOFF, Phase.APPROACH):
        follower.finish(phase)
    for _ in range(round(120.0 / DT)):
        if follower.tick(Phase.ALIGN).progress.feeling and ahead(follower) >= along:
            break
    touching(follower, along).tick(Phase.ALIGN)
    follower.estimate = replace(follower.estimate, in_contact=False)
    return follower


@pytest.mark.parametrize("along", [-0.06, 0.0, 0.05])
def test_the_work_goes_where_the_pipe_was_felt(along: float) -> None:
    follower = felt(along)
    assert follower.steps[-1].progress.along == pytest.approx(along)
    follower.finish(Phase.ALIGN)
    assert follower.from_crack == pytest.approx(SITE.needle - along, abs=1e-6)
    follower.finish(Phase.ADHESIVE)
    follower.finish(Phase.TOOL_CHANGE)
    assert follower.from_crack == pytest.approx(SITE.near - along, abs=1e-6)


def test_it_is_tared_before_the_touch_and_not_near_the_pipe() -> None:
    follower = felt(0.0)
    tared = [i for i, step in enumerate(follower.steps) if step.progress.tared]
    assert len(tared) == 1
    taring = [i for i, step in enumerate(follower.steps) if step.progress.taring]
    assert len(taring) * DT == pytest.approx(G.tare_time, abs=0.05)
    assert taring[-1] == tared[0] < next(i for i, step in enumerate(follower.steps) if step.progress.feeling)
    (x, y, _), (nx, ny) = SITE.crack, SITE.normal
    base = follower.steps[tared[0]].reference.p
    gap = (x - base[0]) * nx + (y - base[1]) * ny - (SITE.near - P.gap)
    assert gap == pytest.approx(P.feel_room)


def test_a_pipe_that_is_not_there_is_missed() -> None:
    follower = Follower(CONFIG)
    for phase in (Phase.PREFLIGHT, Phase.TAKEOFF, Phase.APPROACH):
        follower.finish(phase)
    for _ in range(round(120.0 / DT)):
        if follower.tick(Phase.ALIGN).progress.missed:
            break
    assert ahead(follower) == pytest.approx(P.feel_reach, abs=1e-6)


def test_the_next_flight_believes_the_mission_again() -> None:
    follower = felt(0.04)
    follower.tick(Phase.STOPPED)
    assert follower.state.along == 0.0
    assert not follower.state.felt


def pressing() -> Follower:
    """Two seconds into the press."""
    follower = felt(0.02).finish(Phase.ALIGN)
    for phase in (Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE, Phase.ADVANCE):
        follower.finish(phase)
    return touching(follower, 0.02).run(Phase.PRESS, 2.0)


def test_contact_that_is_lost_is_looked_for_softly_and_pressed_anew() -> None:
    follower = pressing()
    before = follower.from_crack
    follower.estimate = replace(follower.estimate, in_contact=False)
    follower.run(Phase.PRESS, 1.0)
    assert not any(step.reference.pressing or step.reference.force for step in follower.steps[-100:])
    assert not any(step.progress.lost for step in follower.steps[-200:])
    speeds = [sum(v * n for v, n in zip(step.reference.v, SITE.normal, strict=False)) for step in follower.steps[-200:]]
    assert 0.0 < max(speeds) <= G.seek_speed * 1.001
    assert 0.0 < before - follower.from_crack < G.seek_speed
    follower.estimate = replace(follower.estimate, in_contact=True, contact_force=0.2)
    reference = follower.tick(Phase.PRESS).reference
    assert reference.pressing
    assert reference.force == pytest.approx(0.2, abs=0.01)


def across(point: tuple[float, ...]) -> float:
    """How far ``point`` is along the pipe, m."""
    return point[1] * SITE.normal[0] - point[0] * SITE.normal[1]


def test_a_tip_blown_along_the_pipe_is_brought_back() -> None:
    """Where contact is looked for and where it is found, what held against being blown aside still holds."""
    follower = pressing()
    before = across(follower.steps[-1].reference.p)
    (nx, ny), (x, y, z) = SITE.normal, follower.estimate.p_WB
    blown = (x - 0.05 * ny, y + 0.05 * nx, z)
    assert across(blown) - before == pytest.approx(0.05, abs=1e-6)
    for found in (False, True):
        follower.estimate = replace(follower.estimate, p_WB=blown, in_contact=found, contact_force=0.2)
        reference = follower.tick(Phase.PRESS).reference
        assert reference.pressing is found
        assert across(reference.p) == pytest.approx(before, abs=1e-4)


def test_contact_that_is_not_found_again_is_lost() -> None:
    follower = pressing()
    follower.estimate = replace(follower.estimate, in_contact=False)
    follower.run(Phase.PRESS, G.seek_time + 0.1)
    assert follower.steps[-1].progress.lost


def at_the_end() -> Follower:
    """Pressing at the bias, the force held before, a moment before the profile ends."""
    follower = pressing()
    r, f = CONFIG.repair, CONFIG.force_profile
    end = force_profile.held_at(r.hold, f) + f.ramp + f.bias_hold
    follower.run(Phase.PRESS, end - follower.state.press_time - 0.1)
    assert not follower.steps[-1].progress.pressed
    return follower


class Off(Follower):
    """Pressing into nothing, which the contact trigger has not told yet."""

    def tick(self, phase: Phase, engaged: bool = True, tare: bool = False) -> Step:
        """One tick in ``phase``."""
        self.estimate = replace(self.estimate, contact_force=0.0)
        return super().tick(phase, engaged, tare)


def off(follower: Follower) -> Follower:
    """From here on nothing is felt."""
    off = Off.__new__(Off)
    off.__dict__ = follower.copy().__dict__
    return off


def test_only_a_pipe_that_is_felt_is_given_the_sleeve() -> None:
    felt, unfelt = at_the_end(), off(at_the_end()).run(Phase.PRESS, 3.0)
    assert not any(step.progress.pressed for step in unfelt.steps)
    assert felt.run(Phase.PRESS, 0.2).steps[-1].progress.pressed
    assert felt.tick(Phase.RELEASE).reference.gripper == G.gripper_open
    lost = off(felt).run(Phase.RELEASE, 0.2)
    assert lost.steps[-1].reference.gripper == G.gripper_closed
    lost.estimate = replace(lost.estimate, payload=False)
    assert lost.run(Phase.RELEASE, G.release_hold + 0.1).steps[-1].reference.gripper == G.gripper_open
    assert lost.steps[-1].progress.released


def test_a_force_that_was_held_is_not_held_again() -> None:
    follower = at_the_end()
    follower.estimate = replace(follower.estimate, in_contact=False)
    follower.run(Phase.PRESS, 0.5)
    assert follower.steps[-1].reference.force == 0.0
    before = len(follower.steps)
    again = touching(follower, 0.02).finish(Phase.PRESS).steps[before:]
    f = CONFIG.force_profile
    assert len(again) * DT == pytest.approx(f.settle + f.bias_hold, abs=0.05)
    assert all(step.reference.pressing and step.reference.force <= f.bias + 1e-9 for step in again)


def test_contact_lost_in_the_release_is_looked_for() -> None:
    follower = at_the_end().run(Phase.PRESS, 0.2)
    follower.estimate = replace(follower.estimate, in_contact=False)
    before = follower.from_crack
    follower.run(Phase.RELEASE, 1.0)
    assert not follower.steps[-1].reference.pressing
    assert 0.0 < before - follower.from_crack < G.seek_speed
    reference = touching(follower, 0.02).tick(Phase.RELEASE).reference
    assert reference.pressing
    assert reference.force == CONFIG.force_profile.bias


def test_found_moves_the_crack_along_the_normal_alone() -> None:
    moved = plan.found(SITE, 0.03)
    assert moved.crack == pytest.approx(
        (SITE.crack[0] + 0.03 * SITE.normal[0], SITE.crack[1] + 0.03 * SITE.normal[1], SITE.crack[2])
    )
    assert plan.found(SITE, 0.0) is SITE
