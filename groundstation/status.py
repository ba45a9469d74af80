"""``pipewright status``: one look at a vehicle, on one screen."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from drivers.samples import SERVO_NAMES
from groundstation import codes, station
from onboard.messages import Tick

if TYPE_CHECKING:
    from groundstation.client import Client, Contact

_EPILOG = """\
examples:
  pipewright status
  pipewright status --vehicle falcon --keys ~/alice
  pipewright status --json | jq .phase
"""
#: A loop that has made no tick for so long stands still, s.
_STANDS: Final = 1.0


class Status(Struct, frozen=True):
    """The keys of ``status --json``. What is not known is None; SI units, angles in rad, temperatures in degC."""

    vehicle: str
    station: str
    commander: str
    """Name of the station that commands; empty: nobody does."""
    commanding: bool
    """This station does."""
    contact_age: float
    """What was last heard of the vehicle was certainly sent at most so long ago, s."""
    round_trip: float
    clock_offset: float
    """The vehicle's UTC clock minus ours, s."""
    events_missed: int
    tick_age: float | None
    """Of the newest tick, when the vehicle last gave a sign of life, s; None: there was no tick yet."""
    tick: int | None = None
    revision: int | None = None
    phase: str | None = None
    phase_time: float | None = None
    action: str | None = None
    """What safety demands: none, warn, hold, retreat, land, kill."""
    reasons: tuple[str, ...] = ()
    """Codes of the conditions that demand it."""
    obstacles: tuple[str, ...] = ()
    """Why it must not arm, as sentences."""
    force_desired: float | None = None
    force_estimated: float | None = None
    in_contact: bool | None = None
    position: tuple[float, float, float] | None = None
    rpy: tuple[float, float, float] | None = None
    armed: bool | None = None
    mode: str | None = None
    landed: str | None = None
    battery_voltage: float | None = None
    battery_remaining: float | None = None
    servo_temperatures: dict[str, float] = {}
    servo_errors: dict[str, int] = {}
    """Hardware-error bits of those that have any."""
    servo_torque: bool | None = None
    age_odometry: float | None = None
    age_autopilot: float | None = None
    age_servos: float | None = None


def add_parser(commands: Any) -> None:
    """Add ``status`` to the commands of an argparse parser."""
    words = "show where the vehicle stands: phase, verdict, who commands, link, force, battery, servos"
    status = commands.add_parser(
        "status",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    station.add_options(status)
    status.set_defaults(run=run)


@station.guarded
def run(options: argparse.Namespace) -> int:
    """Run ``status``; gives the exit code."""
    with station.open_client(options) as client:
        found = look(client, options.timeout)
    station.tell_data(options, found, list(lines(found)))
    return codes.DONE


def look(client: Client, timeout: float) -> Status:
    """The status, as soon as a tick has come.

    A vehicle that has made no tick yet has a status without. Raises NoAnswerError when its loop stands still.
    """
    from groundstation.client import NoAnswerError

    def told(contact: Contact) -> bool:
        return client.telemetry() is not None or (contact.pulse is not None and contact.pulse.tick_ns == 0)

    if not client.wait(told, timeout):
        age = status_of(client).tick_age
        raise NoAnswerError(
            f"{client.vehicle} is there, but nothing is told of its flight: its last tick is {age:.1f} s old. "
            "Does its loop stand still?"
        )
    return status_of(client)


def status_of(client: Client) -> Status:
    """The status by what has come up to now."""
    contact, telemetry = client.contact(), client.telemetry()
    pulse = contact.pulse
    tick_ns = pulse.tick_ns if pulse is not None else 0
    commander = pulse.commander if pulse is not None else ""
    return Status(
        client.vehicle,
        client.station,
        commander,
        commander == client.station,
        contact.age,
        contact.round_trip,
        contact.clock_offset,
        contact.missed,
        max(0, pulse.sent_ns - tick_ns) * 1e-9 if pulse is not None and tick_ns else None,
        **({} if telemetry is None else _of_tick(telemetry.tick)),
    )


def _of_tick(tick: Tick) -> dict[str, Any]:
    inputs, outputs = tick.inputs, tick.outputs
    autopilot, servos, estimate = inputs.autopilot, inputs.servos, outputs.estimate
    found: dict[str, Any] = {
        "tick": tick.index,
        "revision": tick.revision,
        "phase": outputs.phase.value,
        "phase_time": outputs.phase_time,
        "action": outputs.verdict.action.name.lower(),
        "reasons": outputs.verdict.reasons,
        "obstacles": inputs.obstacles,
        "force_desired": outputs.reference.force,
        "force_estimated": estimate.contact_force,
        "in_contact": estimate.in_contact,
        "age_odometry": estimate.age_odometry,
        "age_autopilot": estimate.age_autopilot,
        "age_servos": estimate.age_servos,
    }
    if estimate.valid:
        found |= {"position": estimate.p_WB, "rpy": estimate.rpy}
    if autopilot is not None:
        found |= {"armed": autopilot.armed, "mode": autopilot.mode.value, "landed": autopilot.landed.value}
        found |= {"battery_voltage": autopilot.battery_voltage, "battery_remaining": autopilot.battery_remaining}
    if servos is not None:
        errors = {name: error for name, error in zip(SERVO_NAMES, servos.error, strict=True) if error}
        temperatures = dict(zip(SERVO_NAMES, servos.temperature, strict=True))
        found |= {"servo_temperatures": temperatures, "servo_errors": errors, "servo_torque": servos.torque_on}
    return found


def lines(status: Status) -> Iterator[str]:
    """The screen."""
    rows = [
        ("verdict", _verdict(status)),
        ("command", commander(status)),
        ("link", _link(status)),
        ("loop", _loop(status)),
        ("force", _force(status)),
        ("body", _body(status)),
        ("autopilot", _autopilot(status)),
        ("battery", _battery(status)),
        ("servos", _servos(status)),
        ("devices", _devices(status)),
    ]
    yield f"{status.vehicle}: {_phase(status)}"
    for name, text in rows:
        if text:
            yield f"  {name:9}  {text}"
    for obstacle in status.obstacles:
        yield f"  not ready  {obstacle}"


def brief(status: Status) -> str:
    """The same in one line."""
    battery = "" if status.battery_remaining is None else f"battery {100 * status.battery_remaining:.0f} %"
    heard = f"heard {status.contact_age:.2f} s ago"
    parts = (_phase(status), _verdict(status), _force(status), battery, heard, commander(status))
    return " | ".join(filter(None, parts))


def commander(status: Status) -> str:
    """Who commands, in words."""
    if not status.commander:
        return "nobody commands"
    return f"{status.commander} commands" + (" (this station)" if status.commanding else "")


def _phase(status: Status) -> str:
    if status.phase is None:
        return "it makes no ticks yet"
    return f"{status.phase.upper()} for {status.phase_time:.1f} s"


def _verdict(status: Status) -> str:
    if status.action is None:
        return ""
    if status.action == "none":
        return "all well"
    return f"{status.action.upper()}: {', '.join(status.reasons)}"


def _link(status: Status) -> str:
    parts = [f"heard {status.contact_age:.2f} s ago", f"round trip {1e3 * status.round_trip:.1f} ms"]
    if abs(status.clock_offset) > 1.0:
        parts.append(
            f"its clock is {abs(status.clock_offset):.0f} s {'ahead' if status.clock_offset > 0 else 'behind'}"
        )
    if status.events_missed:
        parts.append(f"{status.events_missed} events missed")
    return ", ".join(parts)


def _loop(status: Status) -> str:
    if status.tick is None or status.tick_age is None:
        return ""
    stands = "; IT STANDS STILL" if status.tick_age > _STANDS else ""
    return f"tick {status.tick}, {status.tick_age:.2f} s old{stands}; parameters of revision {status.revision}"


def _force(status: Status) -> str:
    if status.force_desired is None:
        return ""
    touching = ", in contact" if status.in_contact else ""
    return f"{status.force_desired:.2f} N wanted, {status.force_estimated:.2f} N estimated{touching}"


def _body(status: Status) -> str:
    if status.position is None or status.rpy is None:
        return ""
    place = ", ".join(f"{value:.2f}" for value in status.position)
    attitude = ", ".join(f"{math.degrees(value):.1f}" for value in status.rpy)
    return f"at {place} m; roll, pitch, yaw {attitude} deg"


def _autopilot(status: Status) -> str:
    if status.armed is None:
        return "nothing heard of it"
    return f"{'armed' if status.armed else 'disarmed'}, mode {status.mode}, {(status.landed or '').replace('_', ' ')}"


def _battery(status: Status) -> str:
    if status.battery_voltage is None or status.battery_remaining is None:
        return ""
    return f"{status.battery_voltage:.1f} V, {100 * status.battery_remaining:.0f} %"


def _servos(status: Status) -> str:
    if not status.servo_temperatures:
        return "nothing heard of them"
    name, warmest = max(status.servo_temperatures.items(), key=lambda item: item[1])
    errors = "".join(f"; {name} HAS AN ERROR (0x{bits:02x})" for name, bits in status.servo_errors.items())
    return f"torque {'on' if status.servo_torque else 'off'}; warmest {name}, {warmest:.0f} degC{errors}"


def _devices(status: Status) -> str:
    ages = {"odometry": status.age_odometry, "autopilot": status.age_autopilot, "servos": status.age_servos}
    told = (f"{name} {_milliseconds(age)}" for name, age in ages.items() if age is not None)
    return ", ".join(told)


def _milliseconds(age: float) -> str:
    return f"{1e3 * age:.0f} ms old" if math.isfinite(age) else "not heard"
