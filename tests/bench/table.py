"""The figures as one table in plain text, at most 100 columns wide."""

from __future__ import annotations

from tests.bench.core import Part
from tests.bench.desk import Desk
from tests.bench.emergency.measure import Emergency
from tests.bench.emergency.stations import PATIENCE
from tests.bench.flight import Flight
from tests.bench.measure import Stat
from tests.bench.report import TARGET_US, Report
from tests.bench.throughput import TARGET, Throughput
from tests.bench.worlds import Worlds

WIDTH = 100
_NAME, _BAR = 32, 30
_EIGHTHS = " ▏▎▍▌▋▊▉"


def table(report: Report) -> str:
    """All of a report, section by section."""
    parts = (_conditions, _core, _mission, _other_world, _comparisons, _real_time)
    lines = [line for part in parts for line in part(report)]
    lines += _worlds(report.worlds)
    if report.throughput is not None:
        lines += _throughput(report.throughput)
    if report.emergency is not None:
        lines += emergency_rows(report.emergency)
    return "\n".join(lines if report.desk is None else [*lines, *desk_rows(report.desk)])


def _head(title: str, *columns: str) -> list[str]:
    return ["", f"{title:<{_NAME}}" + "".join(f"{column:>11}" for column in columns), "─" * WIDTH]


def _line(name: str, time: Stat, more: str = "") -> str:
    return f"{name:<{_NAME}}{time.median:>11.2f}{time.p99:>11.2f}{more}".rstrip()


def _bar(share: float) -> str:
    eighths = round(share * _BAR * 8)
    return "█" * (eighths // 8) + _EIGHTHS[eighths % 8]


def _conditions(report: Report) -> list[str]:
    return [f"{name + ':':<13}{value}" for name, value in report.conditions.items()]


def _core(report: Report) -> list[str]:
    core = report.core
    verdict = "met" if core.step.median <= TARGET_US else "MISSED"
    lines = _head(f"Core step, {core.step.count} recorded ticks", "median us", "p99 us", "share")
    lines.append(_line("whole step", core.step, f"{'100 %':>11}   target {TARGET_US} us: {verdict}"))

    def show(part: Part, indent: int) -> None:
        name = "  " * indent + part.name
        bar = _bar(part.share) if indent == 1 else ""
        lines.append(_line(name, part.time, f"{100.0 * part.share:>9.1f} %   {bar}"))
        for inside in part.inside:
            show(inside, indent + 1)

    for part in core.parts:
        show(part, 1)
    rest = 1.0 - sum(part.share for part in core.parts)
    lines.append(f"{'  the step itself':<{_NAME}}{'':>22}{100.0 * rest:>9.1f} %   {_bar(max(0.0, rest))}".rstrip())
    return lines


def _mission(report: Report) -> list[str]:
    return _flight(report.flight, "Mission")


def _flight(f: Flight, name: str) -> list[str]:
    lines = _head(f"{name}, {f.sim_s:.1f} s to {f.ended_in}", "median us", "p99 us", "of wall")

    def share(seconds: float) -> str:
        return f"{100.0 * seconds / f.wall_s:>9.1f} %   "

    lines.append(_line("core step, in the loop", f.core, share(f.core_s)))
    lines.append(
        _line(
            f"world, a tick of {f.steps_per_tick} steps",
            f.world,
            share(f.world_s) + f"{f.steps_per_s / 1e3:.0f} k steps/s, {f.speed:.3g} x real time",
        )
    )
    lines.append(
        _line(
            "recorder, a tick",
            f.recorder,
            share(f.recorder_s) + f"{f.log_bytes / f.sim_s / 1000.0:.1f} kB a second",
        )
    )
    rest = f.wall_s - f.core_s - f.world_s - f.recorder_s
    lines.append(f"{'loop, devices, clock':<{_NAME}}{'':>22}" + share(rest).rstrip())
    whole = f"{f.wall_s:.2f} s of wall time for {f.sim_s:.1f} s simulated"
    lines.append(f"{'whole mission':<{_NAME}}{whole}: {f.sim_s / f.wall_s:.1f} times real time")
    return lines


def _other_world(report: Report) -> list[str]:
    if report.bullet is None:
        return [*_head("In PyBullet"), "skipped: pybullet is not installed"]
    return _flight(report.bullet, "In PyBullet")


def _comparisons(report: Report) -> list[str]:
    lines = _head("Beside other packages", "median us", "p99 us", "ratio")
    for row in report.comparisons:
        if row.ours is None or row.theirs is None:
            lines.append(f"{row.name:<{_NAME}}{row.package}")
            continue
        if not any(line.startswith(f"{row.name}, ours") for line in lines):
            lines.append(_line(f"{row.name}, ours", row.ours, f"{1.0:>11.1f}"))
        lines.append(_line(f"  {row.package}", row.theirs, f"{row.ratio:>11.1f}   results {row.difference:.1g} apart"))
        lines.append(f"    ({row.note})")
    return lines


def _real_time(report: Report) -> list[str]:
    lines = _head("In real time", "median us", "p99 us", "ratio")
    for row in report.servos:
        lines.append(
            f"{f'servo cycle, wire at {row.baud / 1e6:g} Mbit/s':<{_NAME}}{row.wire:>11.2f}{'':>11}{1.0:>11.2f}"
        )
        for name, stat, cpu in (("ours", row.ours, row.ours_cpu), ("dynamixel-sdk's port", row.sdk, row.sdk_cpu)):
            more = f"{stat.median / row.wire:>11.2f}   {cpu:.0f} us of processor"
            lines.append(_line(f"  {name}", stat, more))
        if row.failed:
            lines.append(f"    ({row.failed} cycles had no answer)")
    points, late = report.setpoints, report.lateness
    lines.append(_line("bare UDP, sent to arrived", points.bare, f"{1.0:>11.1f}"))
    lines.append(_line("  set-point, call to arrived", points.ours, f"{points.ratio:>11.1f}"))
    lines.append(_line("  the call alone", points.call, f"{points.call.median / points.bare.median:>11.1f}"))
    lines.append(_line("bare timer, lateness", late.bare, f"{1.0:>11.1f}"))
    lines.append(_line("  the loop with the core", late.loop, f"{late.ratio:>11.1f}"))
    return lines


def _worlds(worlds: Worlds) -> list[str]:
    lines = _head("Physics of one core", "steps/s", "step us", "ratio")
    lines.append(f"{'rigid-body world, ours':<{_NAME}}{worlds.ours:>11,.0f}{1e6 * worlds.step:>11.0f}{1.0:>11.1f}")
    if worlds.theirs_same is None or worlds.theirs_own is None:
        return [*lines, f"  {worlds.package}"]
    for rate, step in ((worlds.theirs_same, worlds.step), (worlds.theirs_own, 0.010)):
        ratio = worlds.ours / rate
        lines.append(f"{f'  {worlds.package}':<{_NAME}}{rate:>11,.0f}{1e6 * step:>11.0f}{ratio:>11.1f}")
    return [*lines, "    (its multirotor alone; ours has arm, contact, motors, servos and the autopilot's loops)"]


def _throughput(told: Throughput) -> list[str]:
    lines = _head(f"Campaign, {told.runs} runs of {told.sim_s:g} s", "wall s", "x real", "ratio")
    whole = told.runs * told.sim_s
    verdict = "met" if told.ratio >= TARGET else "MISSED"
    lines.append(f"{'one worker':<{_NAME}}{told.one:>11.2f}{whole / told.one:>11.1f}{1.0:>11.2f}")
    row = f"{'two workers':<{_NAME}}{told.two:>11.2f}{told.speed:>11.1f}{told.ratio:>11.2f}"
    return [*lines, f"{row}   target {TARGET:g}: {verdict}"]


def emergency_rows(emergency: Emergency) -> list[str]:
    """The section of the emergency stop, ms."""
    lines = _head("Emergency stop", "median ms", "p99 ms", "worst ms", "trials")
    for condition in emergency.conditions:
        lines.append(f"{condition.name}")
        for name, spread, target in (
            ("  kill, to the autopilot", condition.kill, condition.kill_target),
            ("  kill, to the servo bus", condition.limp, condition.kill_target),
            ("  stop, to the autopilot", condition.stop, condition.stop_target),
            ("  both, to the answer", condition.answer, None),
            ("  raw put, one way", condition.put, None),
            ("  raw get, there and back", condition.get, None),
        ):
            line = f"{name:<{_NAME}}{spread.median:>11.2f}{spread.p99:>11.2f}{spread.worst:>11.2f}{spread.count:>11}"
            if target is not None:
                line += f"   target {target:g}: {'met' if spread.p99 <= target else 'MISSED'}"
            lines.append(line)
            if spread.missing:
                lines.append(f"    ({spread.missing} of them had no answer within {PATIENCE:g} s)")
    if emergency.skipped:
        lines.append(f"no lossy network here: {emergency.skipped}")
    return lines


def desk_rows(desk: Desk) -> list[str]:
    """The section of the flight in real time."""
    lines = _head(f"Flight process, {desk.flown_s:.0f} s on the desk", "median us", "p99 us", "of a core")
    lines.append(f"{'lateness of the ticks':<{_NAME}}{desk.late_median:>11.2f}{desk.late_p99:>11.2f}")
    if desk.setpoint_age is not None:
        lines.append(f"{'age of a set-point as it left':<{_NAME}}{desk.setpoint_age:>11.2f}")
    lines.append(f"{'missed ticks':<{_NAME}}{100.0 * desk.missed:.3f} %")
    for part, share in sorted(desk.cpu.items(), key=lambda item: -item[1]):
        lines.append(
            f"{f'processor: {part}':<{_NAME}}{'':>22}{100.0 * share:>9.1f} %   {_bar(min(1.0, share))}".rstrip()
        )
    if desk.cpu:
        lines.append(f"{'processor: all parts':<{_NAME}}{'':>22}{100.0 * sum(desk.cpu.values()):>9.1f} %")
    return lines
