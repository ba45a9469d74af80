"""Dynamixel protocol 2.0 on a serial port: dynamixel-sdk's packets, over a port that sleeps while it waits.

dynamixel-sdk's own port is read without waiting, in a loop that keeps a core and Python's lock busy, and gives an
absent servo 34 ms. ``Port`` stands in its place: it blocks in the kernel until bytes come or the answer is overdue.
"""

from __future__ import annotations

import os
import select
import termios
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

import serial
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from dynamixel_sdk.robotis_def import COMM_RX_TIMEOUT, COMM_SUCCESS
from msgspec import Struct

from drivers.protocols import DeviceError
from drivers.xc330 import SIZE, Item

T = TypeVar("T")

_BITS_PER_BYTE = 10
_MARKS = 3  # different lengths of reads, by which answers are told apart
_PARAMETERS = 8  # where they begin in a packet
_BROADCAST = 254
_ALERT = 0x80
_ERROR_NUMBERS = {
    1: "the instruction failed",
    2: "undefined instruction",
    3: "the servo saw a CRC error",
    4: "value out of range, or goals locked by the bus watchdog",
    5: "wrong data length",
    6: "value beyond a limit",
    7: "not accessible: read only, undefined, or EEPROM while torque is on",
}
_SYSFS = Path("/sys/bus/usb-serial/devices")


class BusError(Exception):
    """One transaction came to nothing; the next may succeed. ``servo`` is its id, or None for several."""

    def __init__(self, servo: int | None, text: str) -> None:
        super().__init__(text)
        self.servo = servo


class NoAnswer(BusError):  # noqa: N818 - what happened, not an error of the program
    """Nothing came within the time."""


class Corrupt(BusError):  # noqa: N818 - as above
    """Something came that is not the packet that was asked for."""


class Refused(BusError):  # noqa: N818 - as above
    """The servo answered with an error number, or does not show what was written to it."""


class Answer(Struct, frozen=True, gc=False):
    """What one servo sent."""

    data: bytes
    alert: bool
    """The hardware-error register is not 0."""


class Port:
    """A serial port with the calls that dynamixel-sdk makes of one. Raises OSError once the adapter is gone.

    ``reply_margin`` is how long an answer may take beyond its time on the wire and in the adapter, s.
    """

    def __init__(self, path: str, baud: int, reply_margin: float) -> None:
        self.is_using = False
        self._baud = baud
        self.margin = reply_margin
        self._deadline = 0.0
        self._sent = 0
        self.unasked = 0
        """How often something lay there before a question was sent."""
        self._serial = _open(path, baud)
        self._latency = latency_timer(path)
        self._fd = self._serial.fileno()

    def close(self) -> None:
        """Let the port go; safe to call twice, and when the adapter is gone."""
        self._serial.close()

    # What dynamixel-sdk calls, by its names.

    def getBaudRate(self) -> int:
        """Bits per second."""
        return self._baud

    def clearPort(self) -> None:
        """Forget what came late; ``unasked`` counts it."""
        try:
            self.unasked += bool(self._serial.in_waiting)
            self._serial.reset_input_buffer()
        except termios.error as error:
            raise OSError(*error.args) from error

    def writePort(self, packet: Sequence[int]) -> int:
        """Bytes that went out."""
        self._sent = len(packet)
        return os.write(self._fd, bytes(packet))

    def readPort(self, length: int) -> bytes:
        """Up to ``length`` bytes, at least one; none once the answer is overdue."""
        # What has come is taken even when this thread woke up too late for it.
        rest = max(0.0, self._deadline - monotonic())
        if not select.select([self._fd], [], [], rest)[0]:
            return b""
        data = os.read(self._fd, length)
        if not data:
            raise OSError("the serial adapter is gone")
        return data

    def setPacketTimeout(self, packet_length: int) -> None:
        """An answer of so many bytes is overdue after its time, and the question's, on the wire and the margin."""
        wire = (self._sent + packet_length) * _BITS_PER_BYTE / self._baud
        self._deadline = monotonic() + wire + self._latency + self.margin

    def setPacketTimeoutMillis(self, milliseconds: float) -> None:
        """The answer is overdue after this."""
        self._deadline = monotonic() + milliseconds * 1e-3

    def isPacketTimeout(self) -> bool:
        """The answer is overdue."""
        return monotonic() >= self._deadline


def _open(path: str, baud: int) -> Any:
    where = f"servo bus: cannot open {path}"
    try:
        return serial.Serial(path, baud, timeout=0, exclusive=True)
    except FileNotFoundError as error:
        raise DeviceError(
            f"{where}: it is not there; is the adapter plugged in, and is the udev rule in place?"
        ) from error
    except serial.SerialException as error:
        if not Path(path).exists():
            hint = "it is not there; is the adapter plugged in, and is the udev rule in place?"
        elif not os.access(path, os.R_OK | os.W_OK):
            hint = "no permission; add the user to the group dialout"
        elif error.errno == 11 or "exclusively lock" in str(error):
            hint = "another process uses it"
        else:
            hint = str(error)
        raise DeviceError(f"{where}: {hint}") from error
    except (ValueError, OSError) as error:
        raise DeviceError(f"{where} at {baud} baud ({error})") from error


def latency_timer(path: str, sysfs: Path = _SYSFS) -> float:
    """How long the FTDI chip behind ``path`` holds bytes back to send them together, s; 0 where there is none."""
    try:
        return int(_timer(path, sysfs).read_text(encoding="ascii")) * 1e-3
    except (OSError, ValueError):
        return 0.0


def latency_hint(path: str, sysfs: Path = _SYSFS) -> str | None:
    """What to do about a latency timer that is too long; None when it is not."""
    value = latency_timer(path, sysfs)
    if value <= 0.001:
        return None
    return (
        f"the adapter's latency timer is {value * 1e3:.0f} ms, so that a bus cycle lasts at least that long: "
        f"echo 1 | sudo tee {_timer(path, sysfs)}, or install the udev rule that sets it to 1 ms"
    )


def _timer(path: str, sysfs: Path) -> Path:
    return sysfs / Path(path).resolve().name / "latency_timer"


class Bus:
    """Transactions with the servos. Not for use by several threads at once.

    Every call raises NoAnswer, Corrupt or Refused when it came to nothing, and OSError when the adapter is gone. The
    alert bit of an answer is no failure; it is told in ``Answer.alert``.

    Answers carry no number. So that one that comes after its time is not taken for the next, each read asks for none,
    one or two bytes more than it wants, in turn: the length tells which question an answer belongs to.
    """

    def __init__(self, port: Port) -> None:
        self._port = port
        self._packets: Any = Protocol2PacketHandler()
        self._attempts = 1
        self._mark = 0
        self._late = 0

    @property
    def late(self) -> int:
        """Answers that came after their time."""
        return self._late + self._port.unasked

    def patient(self, attempts: int, reply_margin: float) -> None:
        """How often a read or write of one servo is tried, and how late an answer may be, s."""
        self._attempts = attempts
        self._port.margin = reply_margin

    def close(self) -> None:
        """Let the port go."""
        self._port.close()

    def read_bytes(self, servo: int, address: int, length: int) -> Answer:
        """``length`` bytes from ``address`` on."""
        return self._tried(lambda: self._read_once(servo, address, length))

    def _read_once(self, servo: int, address: int, length: int) -> Answer:
        asked = self._marked(address, length)
        self._judge(servo, self._packets.readTx(self._port, servo, address, asked))
        return self._answer(servo, asked, length)

    def read(self, servo: int, item: Item) -> int:
        """The value of one item."""
        return item.decode(self.read_bytes(servo, item.address, item.size).data)

    def write_bytes(self, servo: int, address: int, data: bytes) -> None:
        """Write ``data`` from ``address`` on."""
        self._tried(lambda: self._write_once(servo, address, data))

    def _write_once(self, servo: int, address: int, data: bytes) -> None:
        result, error = self._packets.writeTxRx(self._port, servo, address, len(data), list(data))
        self._judge(servo, result, error)

    def write(self, servo: int, item: Item, value: int) -> None:
        """Set one item."""
        self.write_bytes(servo, item.address, item.encode(value))

    def reboot(self, servo: int) -> None:
        """Restart the servo; it is silent for a moment afterwards."""
        result, error = self._packets.reboot(self._port, servo)
        self._judge(servo, result, error)

    def answering(self) -> tuple[int, ...]:
        """Ids of all servos that answer at this baud rate; takes about a second."""
        found, _ = self._packets.broadcastPing(self._port)
        return tuple(sorted(found))

    def sync_write(self, address: int, length: int, data: Mapping[int, bytes]) -> None:
        """Write ``length`` bytes to each servo of ``data``. Servos do not answer this."""
        parameters: list[int] = []
        for servo, content in data.items():
            parameters.append(servo)
            parameters.extend(content)
        result = self._packets.syncWriteTxOnly(self._port, address, length, parameters, len(parameters))
        self._judge(None, result)

    def sync_read(self, address: int, length: int, servos: Sequence[int], fast: bool) -> list[Answer]:
        """``length`` bytes of each servo, in the order of ``servos``; ``fast``: all in one packet."""
        asked = self._marked(address, length)
        self._judge(None, self._packets.syncReadTx(self._port, address, asked, list(servos), len(servos), fast))
        if fast:
            return self._fast_answers(asked, length, servos)
        return [self._answer(servo, asked, length) for servo in servos]

    def _tried(self, what: Callable[[], T]) -> T:
        for _ in range(self._attempts - 1):
            try:
                return what()
            except (NoAnswer, Corrupt):
                continue
        return what()

    def _marked(self, address: int, length: int) -> int:
        """How many bytes to ask for."""
        self._mark = (self._mark + 1) % _MARKS
        return min(length + self._mark, SIZE - address)

    def _receive(self, who: int, length: int) -> bytes:
        """Error, parameters: of the answer of ``who`` with so many parameters, or with an error; others are late."""
        while True:
            packet, result = self._packets.rxPacket(self._port, True)
            self._judge(None if who == _BROADCAST else who, result)
            if packet[4] != _BROADCAST:
                packet = self._packets.removeStuffing(packet)
            # Behind the length come the instruction, the error, the parameters and the CRC.
            content = bytes(packet[_PARAMETERS : _PARAMETERS - 3 + (packet[5] | packet[6] << 8)])
            if packet[4] == who and (len(content) == 1 + length or (who != _BROADCAST and content[0] & ~_ALERT)):
                return content
            self._late += 1

    def _answer(self, servo: int, asked: int, length: int) -> Answer:
        content = self._receive(servo, asked)
        self._judge(servo, COMM_SUCCESS, content[0])
        return Answer(content[1 : 1 + length], bool(content[0] & _ALERT))

    def _fast_answers(self, asked: int, length: int, servos: Sequence[int]) -> list[Answer]:
        # Each servo adds error, id, data and the CRC so far; the last CRC covers the packet.
        each = asked + 4
        content = self._receive(_BROADCAST, each * len(servos) - 3) + b"\0\0"
        answers = []
        for start, servo in zip(range(0, len(content), each), servos, strict=True):
            error, who = content[start], content[start + 1]
            if who != servo:
                raise Corrupt(servo, f"servo {who} answered in the place of {servo}")
            self._judge(servo, COMM_SUCCESS, error)
            answers.append(Answer(content[start + 2 : start + 2 + length], bool(error & _ALERT)))
        return answers

    def _judge(self, servo: int | None, result: int, error: int = 0) -> None:
        if result == COMM_RX_TIMEOUT:
            raise NoAnswer(servo, "no answer")
        if result != COMM_SUCCESS:
            self._port.is_using = False
            raise Corrupt(servo, str(self._packets.getTxRxResult(result)).removeprefix("[TxRxResult] "))
        if number := error & ~_ALERT:
            raise Refused(servo, _ERROR_NUMBERS.get(number, f"error number {number}"))


#: Bytes on the wire: header to CRC of an instruction without parameters, and what a status packet adds to its data.
_INSTRUCTION, _STATUS = 10, 11


def wire_time(baud: int, servos: int, read: int, written: int, fast: bool = True, return_delay: float = 0.0) -> float:
    """Least time, s, of a sync read of ``read`` bytes and a sync write of ``written`` bytes for each servo.

    ``return_delay`` is the servos' own, in s; at ``fast`` it is spent once, else by each servo.
    """
    ask = _INSTRUCTION + 4 + servos
    answer = 8 + servos * (read + 4) if fast else servos * (read + _STATUS)
    write = _INSTRUCTION + 4 + servos * (1 + written) if written else 0
    return (ask + answer + write) * _BITS_PER_BYTE / baud + return_delay * (1 if fast else servos)
