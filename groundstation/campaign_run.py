"""One run of a campaign, in whatever process: flown without a log, and told as one row of figures."""

from __future__ import annotations

import platform
import threading
import time
import traceback
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import Struct

from groundstation import metrics
from groundstation.campaign_file import Job
from groundstation.estimators import LABELS
from groundstation.run import ESTIMATORS, FELT, Gathering, Run
from onboard.headless import ConfigError, InfeasibleError, Mission
from onboard.messages import PARAMS, Phase

#: One process flies one mission at a time, however many threads it has.
_ALONE: Final = threading.Lock()
_AIRBORNE: Final = tuple(phase for phase in Phase if phase not in (Phase.PREFLIGHT, Phase.ARMED, Phase.STOPPED))


class Figure(Struct, frozen=True):
    """One figure of merit of a run."""

    name: str
    unit: str
    words: str
    charted: bool = True
    """The report shows its distribution."""


#: What is kept of each force estimator: key in ``metrics.json``, unit, words.
OF_ESTIMATORS: Final = (
    ("rmse", "N", "RMSE in contact"),
    ("bias", "N", "bias in contact"),
    ("delay", "s", "delay in contact"),
    ("watched_rms", "N", "RMS with the trigger watched and nothing touching"),
    ("pulls", "", "times it alone would then have pulled the trigger"),
)
FIGURES: Final = (
    Figure("meas_des", "N", "measured less desired force in contact, RMSE"),
    Figure("est_des", "N", "estimated less desired force in contact, RMSE"),
    Figure("est_meas", "N", "estimated less measured force in contact, RMSE"),
    Figure("touchdown_peak", "N", "largest force of the touchdown"),
    Figure("peak", "N", "largest force of all"),
    Figure("hold_mean", "N", "mean force of the hold"),
    Figure("hold_std", "N", "standard deviation of the force in the hold"),
    Figure("no_contact", "", "share of the press without contact"),
    Figure("longest_gap", "s", "longest loss of contact since the first touch"),
    Figure("press_gap", "s", "longest loss of contact from trigger to release"),
    Figure("presses", "", "times that the press was begun"),
    Figure("tip_slip", "m", "sliding of the tip along the pipe"),
    Figure("thrust_max", "N", "largest thrust of a rotor"),
    Figure("torque_max", "N m", "largest torque of a joint"),
    Figure("path_error_rms", "m", "needle off its path, RMS"),
    Figure("estimator_gain", "", "the paper's estimator's RMSE by that of the selected one"),
    Figure("false_contacts", "", "contacts that the trigger saw and were none"),
    Figure("alarms", "", "contacts that it would have seen in free flight, had the tip been at the crack"),
    Figure("watched_s", "s", "time that the trigger was watched, nothing touching"),
    *(
        Figure(f"{name}_{key}", unit, f"{LABELS[name]}: {words}", charted=False)
        for name in (*ESTIMATORS, FELT)
        for key, unit, words in OF_ESTIMATORS
    ),
    Figure("sim_s", "s", "simulated time"),
    Figure("wall_s", "s", "time it took"),
    Figure("speed", "", "times real time"),
)
NAMES: Final = tuple(figure.name for figure in FIGURES)

#: How a run can end, from well to worse.
ENDS: Final = {
    "completed": "sleeve installed and landed, without a retreat",
    "resumed": "sleeve installed and landed, after a retreat",
    "landed": "landed early, under its own control",
    "autolanded": "landed early by the autopilot itself",
    "grounded": "never left the ground",
    "holding": "in the air, holding, when the time was up",
    "unfinished": "broken off in the middle",
    "lost": "vehicle lost",
    "error": "the run failed",
}
SUCCESS: Final = ("completed", "resumed")
#: Ends in which nothing is harmed, when a cell does not say which it may have.
SAFE: Final = ("completed", "resumed", "landed", "autolanded", "grounded", "holding")


def flown(job: Job) -> dict[str, Any]:
    """Fly it, and tell it as a row; what goes wrong with it is told in the row as well."""
    row = _blank(job)
    begun = time.perf_counter()
    try:
        with _ALONE:
            begun = time.perf_counter()
            mission = Mission(job.scenario, job.law, job.sets, job.seed)
            row["version"] = mission.info.version
            run = _flight(mission, job)
        row |= _told(run, metrics.compute(run))
        row["end"] = end_of(run, row["outcome"])
    except (ConfigError, InfeasibleError) as error:
        row["error"] = str(error)
    except Exception:
        row["error"] = traceback.format_exc()
    row["wall_s"] = time.perf_counter() - begun
    if row["sim_s"] is not None:
        row["speed"] = row["sim_s"] / row["wall_s"]
    row["ok"] = row["end"] in (job.ends or SAFE)
    return row


def failed(job: Job, why: str) -> dict[str, Any]:
    """The row of a run whose process was lost."""
    return _blank(job) | {"error": why}


def _blank(job: Job) -> dict[str, Any]:
    return {
        "run": job.run,
        "seed": job.seed,
        "fault": job.fault,
        "moment": job.moment,
        "command": job.command(),
        "values": msgspec.to_builtins(job.values),
        **dict.fromkeys(NAMES),
        **dict.fromkeys(("outcome", "ended_in", "crash", "error", "version"), ""),
        "end": "error",
        "ok": False,
        "host": platform.node(),
    }


def _flight(mission: Mission, job: Job) -> Run:
    gathering = Gathering(Path(f"run {job.run}"), mission)

    def hear(topic: str, t_ns: int, message: Any) -> None:
        if topic == PARAMS:
            gathering.take_config(message.config)
        else:
            gathering.take(topic, t_ns, message)

    mission.fly(hear, job.longest, job.wall_s)
    return gathering.end()


def _told(run: Run, figures: dict[str, Any]) -> dict[str, Any]:
    contact, limits, estimators = figures["contact"], figures["limits"], figures.get("estimators") or {}
    pressing = run.where(Phase.PRESS)
    force = run.truth.force if run.truth is not None else run.force_est
    return {
        "outcome": figures["outcome"],
        "ended_in": str(run.phase[-1]),
        "crash": run.truth.crashed if run.truth is not None else "",
        **figures["force_rmse"],
        **{
            name: contact[name]
            for name in ("touchdown_peak", "peak", "hold_mean", "hold_std", "longest_gap", "press_gap", "tip_slip")
        },
        "no_contact": float(np.mean(force[pressing] <= 0.0)) if pressing.any() else None,
        "presses": float(sum(phase["name"] == Phase.PRESS for phase in figures["phases"])),
        "thrust_max": limits["thrust_max"],
        "torque_max": limits["torque_max"],
        "path_error_rms": figures["adhesive"]["path_error_rms"],
        "estimator_gain": estimators.get("ratio"),
        **{name: estimators.get(name) for name in ("false_contacts", "alarms", "watched_s")},
        **{
            f"{name}_{key}": row[key]
            for name, row in estimators.get("table", {}).items()
            for key, _, _ in OF_ESTIMATORS
        },
        "sim_s": figures["sim_s"],
    }


def end_of(run: Run, outcome: str) -> str:
    """Which of ``ENDS`` the run came to."""
    if outcome in ("lost", "completed"):
        return outcome
    truth = run.truth
    grounded = truth.on_ground if truth is not None else run.landed == "on_ground"
    if not grounded:
        return "holding" if outcome == "safe" else "unfinished"
    if not run.where(*_AIRBORNE).any() or (
        truth is not None and float(np.nanmax(truth.p[:, 2] - truth.p[0, 2])) < 0.02
    ):
        return "grounded"
    if outcome == "unfinished":
        return outcome
    if truth is not None and truth.sleeve_on_pipe and run.where(Phase.RETURN).any():
        return "resumed"
    codes = {event.code for event in run.events}
    silent = run.phase[-1] == Phase.LAND
    return "autolanded" if silent or any(code.startswith("autoland") for code in codes) else "landed"
