"""Writes docs/safety.md and docs/mission.md from the tables in the code: ``python docs/tables.py`` from the root."""

from __future__ import annotations

from pathlib import Path
from typing import get_type_hints

from onboard.core import mission, safety
from onboard.core.safety import BLIND, TABLE, WORDS, Group, debounce
from onboard.core.types import Action, Request

HEADER = "<!-- Written by docs/tables.py from the code; do not edit. -->"

SAFETY = f"""{HEADER}
# Safety

Each tick, `onboard/core/safety.py` looks at facts. A condition becomes active when it has been violated for its time;
each active condition demands an action by phase group, and the most severe demand wins. The event of a condition is a
sentence that says what is the matter and what to do. The values below are the defaults of its parameters.

- **Ground**: PREFLIGHT and STOPPED. **Contact**: phases in which contact is expected. **Free**: all others, ARMED
  included: it stands on the ground, and whatever demands HOLD or more disarms it.
- HOLD hovers in place. RETREAT backs off along the pipe's normal, then hovers. LAND lands. KILL cuts the motors.
- In contact the mission leads HOLD through RETREAT_HOLD and LAND through RETREAT_LAND: the force is taken back first.
- *Blind* conditions mean that position or attitude is lost, and with it position control: LAND is then flown by the
  autopilot itself (`Engage.LAND`), in contact after a short dead-reckoned retreat.
- When the autopilot leaves offboard by itself, it or a pilot has command: the core asks nothing of it but KILL.
- A condition clears once all has been well for {{clear}} s; a latched one only in PREFLIGHT, after a reset. Nothing
  resumes by itself: the mission stays where the action has led it.
- The link: nobody is lost while nobody commands. A commanding station that falls silent holds the vehicle, in contact
  after a retreat, and lands it when it stays silent; a takeoff on the ground is broken off, a landing goes on. On the
  ground it is a warning, and as every warning of preflight it keeps the vehicle from taking off until the station has
  been heard again for a while. Heard again in flight is told, and that is all: the mission stays on hold, or lands.
- A value that is not finite violates every bound it is compared with, and `non_finite` at once; it alone never cuts
  the motors.

| Condition | Violation | For | Ground | Free | Contact | Clears | Blind |
|---|---|---|---|---|---|---|---|
{{rows}}
"""

MISSION = f"""{HEADER}
# Mission

The transition table of `onboard/core/mission.py`. Rows are tried in order, the first that fits wins; a request is tried
before an action of the same or lower rank, and both before facts. Refused requests are left out; the sentence of each
refusal is in the code.

The request to stop has no rows, for it stands for another: to hold in free flight; in contact, to retreat; once the
vehicle holds, or retreats to hold, to land. A retreat that would go on to RETURN is held first. It remembers nothing:
whoever asked for the first stop, the second lands.

| From | On | If | To | Event |
|---|---|---|---|---|
{{rows}}

Every phase but STOPPED has a time limit:

| Phase | Limit | Meaning |
|---|---|---|
{{limits}}
"""


_TO = {mission.INTERRUPTED: "the interrupted phase", mission.NAMED: "the phase that was named"}


def safety_page() -> str:
    """The page on safety."""
    params = safety.Params()
    rows = []
    for condition in TABLE:
        time = debounce(condition, params)
        cells = [
            f"`{condition.code}`",
            WORDS[condition.code][0].format(p=params),
            f"{time:g} s" if time else "at once",
            *(condition.actions.of(group).name for group in Group),
            condition.clears.value,
            "yes" if condition.code in BLIND else "",
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return SAFETY.format(rows="\n".join(rows), clear=f"{params.clear_time:g}")


def mission_page() -> str:
    """The page on the mission."""
    rows = []
    for row in mission.TABLE:
        if row.to is None:
            continue
        causes = ", ".join(_cause(cause) for cause in row.causes)
        condition = (row.condition.__doc__ or "").rstrip(".")
        phases = ", ".join(phase.name for phase in row.phases)
        to = _TO.get(row.to, row.to.upper())
        rows.append(f"| {phases} | {causes} | {condition} | {to} | `{row.code}`: {mission.SENTENCES[row.code][1]} |")
    limits = []
    for field, hint in get_type_hints(mission.Params, include_extras=True).items():
        phase = field.removesuffix("_timeout")
        if phase != field:
            meaning = hint.__metadata__[0].description
            limits.append(f"| {phase.upper()} | {getattr(mission.Params(), field):g} s | {meaning} |")
    return MISSION.format(rows="\n".join(rows), limits="\n".join(limits))


def _cause(cause: mission.Cause) -> str:
    if isinstance(cause, Request):
        return f"request {cause.value}"
    return f"safety {cause.name}" if isinstance(cause, Action) else "facts"


def pages() -> dict[str, str]:
    """File name in docs, and content."""
    return {"safety.md": safety_page(), "mission.md": mission_page()}


if __name__ == "__main__":
    for name, text in pages().items():
        (Path(__file__).parent / name).write_text(text, encoding="utf-8")
