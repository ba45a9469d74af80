"""Draws the processes and threads of a desk flight, of a vehicle and of a real PX4 with a simulator, and one tick.

Run from the repository's root: python -m docs.figures.processes
Writes docs/images/{desk,vehicle,px4,tick}.svg.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

IMAGES = Path(__file__).parents[1] / "images"
INK, FRAME, WIRE, LINK, PALE = "#1f3b57", "#8fa6ba", "#b03a2e", "#2e7d32", "#eef2f6"
#: Fill, stroke and stroke width of what a box may be.
KINDS = {
    "process": (PALE, FRAME, 1.5),
    "thread": ("#ffffff", INK, 1.2),
    "hardware": ("#f3ece1", "#7a5c2e", 1.5),
    "plain": ("#ffffff", FRAME, 1.0),
}
#: Stroke, width and dashes of what an arrow may be.
WAYS = {"wire": (WIRE, 2.2, ""), "link": (LINK, 1.8, "6 4"), "call": (INK, 1.3, ""), "file": (FRAME, 1.3, "")}
LINE = 16
Point = tuple[float, float]


class Sheet:
    """A picture under way; lengths in pixels from the upper left corner."""

    def __init__(self, width: int, height: int, legend: str) -> None:
        self._size = (width, height)
        heads = "".join(
            f'<marker id="{way}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="9" markerHeight="9" '
            f'markerUnits="userSpaceOnUse" orient="auto-start-reverse"><path d="M0 0L10 5L0 10z" fill="{stroke}"/>'
            "</marker>"
            for way, (stroke, _, _) in WAYS.items()
        )
        self._parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
            f'height="{height}" font-family="Helvetica, Arial, sans-serif" font-size="12" fill="{INK}">',
            f"<defs>{heads}</defs>",
            f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        ]
        self.text(20, height - 14, [legend], colour="#5a6b7b")

    def text(self, x: float, y: float, lines: Sequence[str], *, anchor: str = "start", colour: str = INK) -> None:
        """Lines below each other, the first on the base line ``y``."""
        for number, line in enumerate(lines):
            self._parts.append(
                f'<text x="{x}" y="{y + LINE * number}" text-anchor="{anchor}" fill="{colour}">{escape(line)}</text>'
            )

    def box(
        self, x: float, y: float, w: float, h: float, title: str, lines: Sequence[str] = (), kind: str = "thread"
    ) -> None:
        """A box with a heading and lines below it."""
        fill, stroke, width = KINDS[kind]
        self._parts.append(
            f'<rect x="{x}" y="{y}" width="{w}" height="{h}" rx="6" fill="{fill}" stroke="{stroke}" '
            f'stroke-width="{width}"/><text x="{x + 10}" y="{y + 19}" font-weight="bold">{escape(title)}</text>'
        )
        self.text(x + 10, y + 19 + LINE, lines)

    def arrow(
        self, *points: Point, way: str = "call", both: bool = False, words: Sequence[str] = (), at: Point | None = None
    ) -> None:
        """A line through the points to the last one, and back if ``both``; words stand centred at ``at``."""
        stroke, width, dashes = WAYS[way]
        path = " ".join(f"{x},{y}" for x, y in points)
        start = f' marker-start="url(#{way})"' if both else ""
        dash = f' stroke-dasharray="{dashes}"' if dashes else ""
        self._parts.append(
            f'<polyline points="{path}" fill="none" stroke="{stroke}" stroke-width="{width}"{dash}{start} '
            f'marker-end="url(#{way})"/>'
        )
        if words:
            (x0, y0), (x1, y1) = points[0], points[-1]
            x, y = at or ((x0 + x1) / 2, (y0 + y1) / 2 - 8 - LINE * (len(words) - 1))
            self.text(x, y, words, anchor="middle", colour=stroke)

    def save(self, name: str) -> None:
        """Write docs/images/<name>.svg."""
        (IMAGES / f"{name}.svg").write_text("\n".join([*self._parts, "</svg>\n"]), encoding="utf-8")


#: Where the rows of the three drivers begin, and how high their boxes are.
ROWS, ROW = (110, 220, 330), 84
#: The flight process: left edges of its drivers and its loop, and widths.
DRIVERS, LOOP, WIDE = 560, 860, 190


def flight(sheet: Sheet, tracker: Sequence[str], rest: Sequence[str], rows: Sequence[float] = ROWS) -> None:
    """The flight process: the same in every picture, but for what opens the camera and who attends it."""
    top, bottom = rows[0], rows[2] + ROW
    sheet.box(DRIVERS - 20, top - 36, LOOP - DRIVERS + WIDE + 40, bottom - top + 134, "flight process", (), "process")
    words = (
        ("mavsdk", ("each message into a mailbox,", "answers TIMESYNC")),
        tracker,
        ("dynamixel", ("a command makes a cycle:", "goals out, five servos in")),
    )
    for y, (name, lines) in zip(rows, words, strict=True):
        sheet.box(DRIVERS, y, WIDE, ROW, name, lines)
    for y, back in zip(rows, ("command, relay", "", "command"), strict=True):
        sheet.arrow((DRIVERS + WIDE, y + 26), (LOOP, y + 26), words=["latest"])
        if back:
            sheet.arrow((LOOP, y + 68), (DRIVERS + WIDE, y + 68), words=[back])
    lines = (
        "the loop, 250 Hz:", "latest, step, command,", "relay; then asleep until", "the next tick is due", "",
        "beside it in asyncio,", "20 times a second:", "what PX4 is asked for,", "the tracker's watchdog",
    )  # fmt: skip
    sheet.box(LOOP, top, WIDE, bottom - top, "MainThread", lines)
    below = bottom + 22
    sheet.box(LOOP, below, WIDE, 60, "recorder", ("a queue of 2500 records,", "never waited for"))
    sheet.arrow((LOOP + WIDE / 2, bottom), (LOOP + WIDE / 2, below))
    sheet.arrow((LOOP + WIDE / 2, below + 60), (LOOP + WIDE / 2, below + 92), way="file")
    sheet.text(LOOP + WIDE / 2, below + 108, ["log.mcap"], anchor="middle")
    sheet.box(DRIVERS, below, WIDE + 60, 60, "reload, cpu, attended", rest)


def world(sheet: Sheet, faces: Sequence[tuple[str, Sequence[str]]], rows: Sequence[float]) -> None:
    """The world process, with its faces at these rows; the servo bus comes last and has a thread of its own."""
    top, bottom = rows[0], rows[-1] + ROW
    sheet.box(20, top - 36, 380, bottom - top + 52, "world process", (), "process")
    lines = (
        "pace: moves the",
        "world on the wall",
        "clock, calls its",
        "faces: 4 ms,",
        "camera 5 ms",
        "",
        "physics 10 kHz",
    )
    sheet.box(40, top, 135, bottom - top, "MainThread", lines)
    for y, (name, words) in zip(rows, faces, strict=True):
        sheet.box(200, y, 180, ROW, name, words)
        sheet.arrow((175, y + ROW / 2), (200, y + ROW / 2), both=True)


def wire(sheet: Sheet, y: float, words: Sequence[str], way: str = "wire", start: float = 380) -> None:
    """What joins a row of the left side to a driver; its words stand in the gap between the processes."""
    sheet.arrow((start, y), (DRIVERS, y), way=way, both=True, words=words, at=(470, y - 8 - LINE * (len(words) - 1)))


def above(sheet: Sheet, name: str, words: str, *feet: float, both: bool = False) -> None:
    """What starts the processes, with an arrow down to each."""
    sheet.box(20, 12, 1070, 46, name, (words,), "plain")
    for x in feet:
        sheet.arrow((x, 58), (x, 74), both=both)


WIDTH = 1110
SERVO_BUS = ("servo bus emulator", ("a thread: five XC330, and", "the time of the wire"))
LOOK = ("world link, camera", ("poses, truth, samples", "of mock devices"))
TO_CAMERA = ("world link", ("tells a software camera, in", "which librealsense calls", "the T265 driver"))
BESIDE = ("files; shares of the processor;", "requests on standard input")
DESK = (
    "pipewright desk",
    "starts both, tells the one where the other is, passes signals on, reports when they have ended",
)
LEGEND = "Red: the bytes of the device. Green, dashed: what has no wire of its own. White: threads, faces of the world."


def desk() -> None:
    """``pipewright desk``."""
    sheet = Sheet(WIDTH, 580, LEGEND)
    above(sheet, *DESK, 250, 700)
    faces = (("PX4 stand-in", ("commander, estimator,", "parameters, streams")), LOOK, SERVO_BUS)
    world(sheet, faces, ROWS)
    flight(sheet, TO_CAMERA, BESIDE)
    wire(sheet, ROWS[0] + ROW / 2, ("MAVLink, UDP",))
    wire(sheet, ROWS[1] + ROW / 2, ("MessagePack, UDP",), "link")
    wire(sheet, ROWS[2] + ROW / 2, ("protocol 2.0, pty",))
    sheet.save("desk")


def vehicle() -> None:
    """``pipewright onboard --config jetson``."""
    sheet = Sheet(WIDTH, 580, "Red: wires. Brown: hardware. White: threads.")
    words = "hears READY after the first tick and WATCHDOG from ticks alone; SIGTERM lands first, SIGHUP reloads"
    above(sheet, "systemd, or a person", words, 700)
    hardware = (
        ("Pixhawk 6C with PX4", ("lands by itself when", "set-points stay away")),
        ("RealSense T265", ("poses at 200 Hz",)),
        ("five XC330 on a U2D2", ("stop by themselves when", "the bus is silent")),
    )
    for y, (name, lines) in zip(ROWS, hardware, strict=True):
        sheet.box(200, y, 180, ROW, name, lines, "hardware")
    tracker = ("realsense", ("librealsense calls back;", "opened and closed in", "threads that may hang"))
    flight(sheet, tracker, BESIDE)
    wire(sheet, ROWS[0] + ROW / 2, ("serial,", "921600 baud"))
    wire(sheet, ROWS[1] + ROW / 2, ("USB 3",))
    wire(sheet, ROWS[2] + ROW / 2, ("USB to TTL,", "4 Mbaud"))
    sheet.save("vehicle")


def px4() -> None:
    """``pipewright desk --config sitl`` and ``--config hitl``."""
    rows = (110, 300, 410, 520)
    sheet = Sheet(WIDTH, 770, LEGEND + " Brown: PX4, in software or on its board.")
    above(sheet, *DESK, 700)
    sheet.arrow((100, 58), (100, rows[1] - 36))
    words = ("its position comes from", "our poses alone; SITL:", "the world starts it")
    sheet.box(200, rows[0], 180, ROW, "a real PX4", words, "hardware")
    faces = (("simulator link", ("IMU, magnetometer,", "barometer; four motors")), LOOK, SERVO_BUS)
    world(sheet, faces, rows[1:])
    flight(sheet, TO_CAMERA, BESIDE, rows=(rows[0], *rows[2:]))
    sheet.arrow((290, rows[0] + ROW), (290, rows[1]), way="wire", both=True)
    sheet.text(302, 222, ["SITL: TCP 4560, in lockstep", "HITL: serial, on PX4's own time"], colour=WIRE)
    wire(sheet, rows[0] + ROW / 2, ("SITL: UDP 14540", "HITL: serial"))
    wire(sheet, rows[2] + ROW / 2, ("MessagePack, UDP",), "link")
    wire(sheet, rows[3] + ROW / 2, ("protocol 2.0, pty",))
    sheet.save("px4")


def tick() -> None:
    """What goes into one tick, and what comes out, in this order."""
    words = "Numbers: the order within a tick. Until 11 nothing waits: newest samples are read, commands handed over."
    sheet = Sheet(WIDTH, 490, words)
    sources = (
        ("1  odometry.latest()", ("pose in W, confidence,", "how often it was reset")),
        ("2  autopilot.latest()", ("attitude, IMU, armed,", "mode, battery")),
        ("3  servos.latest()", ("angles, rates, currents,", "errors of five servos")),
        ("4  request", ("of a person; one a tick,", "in order")),
        ("5  obstacles()", ("why it must not arm:", "sentences for a person")),
    )
    for number, (name, lines) in enumerate(sources):
        y = 30 + 84 * number
        sheet.box(20, y, 190, 66, name, lines)
        sheet.arrow((210, y + 33), (260, y + 33))
    sheet.box(260, 30, 100, 402, "Inputs", ("time of the", "tick, and the", "measured dt", "since the last"), "plain")
    sheet.arrow((360, 231), (400, 231))
    sheet.box(400, 30, 340, 402, "6  step(state, inputs, params, dt)", (), "process")
    stages = (
        ("estimate", "body, joints, tip, contact force, ages"),
        ("safety", "facts, obstacles too: the most severe action"),
        ("mission", "the phase, by one table"),
        ("guidance", "reference, desired force, compliant offset"),
        ("control", "the laws"),
        ("actuation", "what the autopilot accepts"),
        ("limits", "the last gate: finite, permitted, bounded"),
    )
    for number, (name, what) in enumerate(stages):
        y = 64 + 52 * number
        sheet.box(415, y, 310, 42, name)
        sheet.text(425, y + 35, [what])
        if number:
            sheet.arrow((570, y - 10), (570, y))
    results = (
        ("7  autopilot.command", ("one set-point, sent at once", "and never again")),
        ("8  servos.command", ("goals for one cycle; wakes", "the bus thread")),
        ("9  relay()", ("the newest pose, to PX4's own", "estimator as ODOMETRY")),
        ("10  recorder", ("Tick and timing; once a second", "the state, as a keyframe")),
        ("11  sleep until due", ("by the schedule, not from now;", "here drivers' tasks run")),
    )
    sheet.arrow((740, 231), (775, 231), (775, 63), (810, 63), words=["Outputs"], at=(775, 248))
    for number, (name, lines) in enumerate(results):
        y = 30 + 84 * number
        sheet.box(810, y, 250, 66, name, lines)
        if number:
            sheet.arrow((935, y - 18), (935, y))
    sheet.save("tick")


def main() -> None:
    """Draw all."""
    for draw in (desk, vehicle, px4, tick):
        draw()


if __name__ == "__main__":
    main()
