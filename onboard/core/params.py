"""The whole parameter set of the core: one frozen tree, swapped as a whole between two ticks."""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from drivers.samples import Interface, JointMode
from drivers.vehicle import Vehicle
from onboard.core import (
    admittance,
    backstepping,
    compensation,
    contact_trigger,
    control,
    estimate,
    estimators,
    force_profile,
    fuzzy,
    guidance,
    limits,
    mission,
    observer,
    plan,
    safety,
    sliding_mode,
    tilt,
)
from onboard.core.repair import Pipe, Repair
from onboard.core.spec import note, spec


class Params(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything the core may be told; defaults are the ``tuned`` set for the ``wrench`` interface."""

    vehicle: Vehicle
    pipe: Pipe = Pipe()
    repair: Repair = Repair()
    interface: Annotated[Interface, note("what the autopilot is sent", in_flight=False)] = Interface.WRENCH
    joints: Annotated[JointMode, note("how the arm's joints are driven", in_flight=False)] = JointMode.TORQUE
    joint_current: Annotated[float, spec("A", 0.05, 1.8, "current limit of the joints in position mode")] = 1.6
    dt_min: Annotated[float, spec("s", 1e-4, 0.1, "measured dt is taken to be at least this")] = 0.001
    dt_max: Annotated[float, spec("s", 1e-4, 0.1, "measured dt is taken to be at most this")] = 0.020

    mission: mission.Params = mission.Params()
    plan: plan.Params = plan.Params()
    guidance: guidance.Params = guidance.Params()
    estimate: estimate.Params = estimate.Params()
    observer: observer.Params = observer.Params()
    estimators: estimators.Params = estimators.Params()
    contact: contact_trigger.Params = contact_trigger.Params()
    force_profile: force_profile.Params = force_profile.Params()
    fuzzy: fuzzy.Params = fuzzy.Params()
    admittance: admittance.Params = admittance.Params()
    backstepping: backstepping.Params = backstepping.Params()
    tilt: tilt.Params = tilt.Params()
    sliding_mode: sliding_mode.Params = sliding_mode.Params()
    compensation: compensation.Params = compensation.Params()
    control: control.Params = control.Params()
    safety: safety.Params = safety.Params()
    limits: limits.Params = limits.Params()
