"""What is read of the servos in flight, and what is done about it: samples, health, and servos that are lost.

A failed read costs its cycle. In the next one each servo is asked by itself; who does not answer is asked once a cycle,
beside the others, until it counts as silent, and is looked for from then on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from drivers import xc330
from drivers.dynamixel_absence import Absences
from drivers.dynamixel_bus import Bus, BusError, Corrupt, NoAnswer, Refused
from drivers.dynamixel_settings import DynamixelSettings
from drivers.dynamixel_setup import HEALTH, MARK, READ, READ_AT, Servo, SetUp
from drivers.mailbox import Level, Teller, Trouble
from drivers.samples import Five, ServoState
from drivers.xc330 import HardwareError

_WAKING = 0.3  # s that a servo needs to restart, generously


class Watch:
    """Reads the servos, ``clock`` in nanoseconds, and takes care of those in trouble.

    ``pressed``: something urgent waits for the bus, so that what takes several answers is left for later.
    """

    def __init__(
        self,
        settings: DynamixelSettings,
        servos: Sequence[Servo],
        set_up: SetUp,
        teller: Teller,
        clock: Callable[[], int],
        pressed: Callable[[], bool],
    ) -> None:
        self._pressed = pressed
        self._settings = settings
        self._servos = servos
        self._set_up = set_up
        self._teller = teller
        self._clock = clock
        self._absences = Absences(servos, teller)
        self._readings = Trouble(teller.tell, "every reading of the servos succeeds again; {count} failed")
        self._failed_ns: list[int] = []
        self._failure = ""
        self._one_by_one = False
        self._health_ns = 0
        self._health_turn = 0
        #: When the servos were last asked, ns.
        self.reading_ns = 0
        #: Failed transactions, by kind, and by servo where one was asked.
        self.errors: Counter[str] = Counter()
        self.blamed: Counter[str] = Counter()

    def read(self, bus: Bus) -> ServoState | None:
        """Ask all that answer; the sample, or None when nobody has told anything. Raises BusError."""
        self.reading_ns = now = self._clock()
        asked = [servo for servo in self._servos if servo.answers]
        if self._one_by_one:
            self._one_by_one = False
            heard = []
            for servo in asked:
                if self._pressed():
                    self._one_by_one = True
                    break
                heard.append(self._read_alone(bus, servo))
        else:
            heard = self._read_together(bus, [servo for servo in asked if not servo.suspect])
            # One of them in a cycle, so that a cycle waits for one missing answer at most.
            suspects = [servo for servo in asked if servo.suspect]
            if suspects:
                heard.append(self._read_alone(bus, min(suspects, key=lambda servo: servo.asked)))
        lost = [servo for servo in asked if servo.suspect and now - servo.heard_ns > self._settings.silent_after * 1e9]
        for servo in lost:
            self.give_up(servo)
        self._absences.lost(lost)
        return self._sample() if any(heard) else None

    def _read_together(self, bus: Bus, servos: Sequence[Servo]) -> list[bool]:
        if not servos:
            return []
        try:
            answers = bus.sync_read(READ_AT, READ.size, [servo.settings.id for servo in servos], self._set_up.fast)
        except BusError as error:
            # Who is at fault shows when each is asked by itself, in the next cycle.
            self._one_by_one = True
            self._failed_ns.append(self.reading_ns)
            self._failure = f"a reading of the servos failed: {error}"
            raise
        return [self._take(servo, answer.data) for servo, answer in zip(servos, answers, strict=True)]

    def _read_alone(self, bus: Bus, servo: Servo) -> bool:
        servo.asked += 1
        try:
            answer = bus.read_bytes(servo.settings.id, READ_AT, READ.size)
        except BusError as error:
            self.count(error)
            return False
        return self._take(servo, answer.data)

    def adapter_lost(self) -> None:
        """Nothing can be read any more, and why was told."""
        for servo in self._servos:
            self.give_up(servo)
            servo.retry_ns = 0
        self._absences.known(self._servos)

    def give_up(self, servo: Servo) -> None:
        """Take a servo for lost, until it is found again."""
        servo.answers = False
        servo.interrupted = servo.interrupted or servo.engaged
        servo.engaged = servo.suspect = False
        servo.velocity = servo.current = 0.0
        servo.error |= HardwareError.SILENT
        servo.torque_on = False
        servo.retry_ns = self._clock() + round(self._settings.retry * 1e9)

    def _take(self, servo: Servo, data: bytes) -> bool:
        """Take what a servo told; False if it has forgotten what it is to tell."""
        mark, error, torque, watchdog, current, velocity, counts = READ.unpack(data)
        if mark != MARK:
            self._teller.tell(Level.ERROR, f"{servo.name} has restarted by itself: is its supply steady?")
            self.give_up(servo)
            self._absences.known([servo])
            servo.retry_ns = 0
            return False
        servo.suspect, servo.heard_ns = False, self.reading_ns
        sign = servo.settings.sign
        servo.position = servo.angle(counts)
        servo.velocity = sign * velocity * xc330.RAD_S_PER_UNIT
        servo.current = sign * current * xc330.AMPERE_PER_UNIT
        servo.torque_on = bool(torque)
        if error != servo.error:
            self._judge(servo, error)
        if servo.engaged and watchdog == xc330.TRIPPED:
            self._teller.once(
                "watchdog", Level.WARNING, "the bus watchdog has stopped the servos; the next command starts them again"
            )
            servo.engaged, servo.interrupted = False, True
        elif servo.engaged and not torque:
            if not error:
                self._teller.once(f"torque {servo.index}", Level.ERROR, f"{servo.name} has lost its torque")
            servo.engaged, servo.interrupted = False, True
        return True

    def _judge(self, servo: Servo, error: int) -> None:
        new = error & ~servo.error
        servo.error = error
        if not new:
            return
        words = f"{servo.name}: {xc330.error_words(new)}"
        if not error & HardwareError.OVERLOAD:
            self._teller.tell(Level.ERROR, words)
        elif servo.reboots < self._settings.reboots:
            servo.reboot_ns = self._clock() + round(self._settings.reboot_delay * 1e9)
            self._teller.tell(
                Level.ERROR, f"{words}; its torque is off, it is rebooted in {self._settings.reboot_delay:g} s"
            )
        else:
            self._teller.tell(Level.ERROR, f"{words}; its torque stays off after {servo.reboots} reboots")

    def _sample(self) -> ServoState:
        servos = self._servos
        return ServoState(
            t_ns=self.reading_ns,
            position=_five(servo.position for servo in servos),
            velocity=_five(servo.velocity for servo in servos),
            current=_five(servo.current for servo in servos),
            voltage=_five(servo.voltage for servo in servos),
            temperature=_five(servo.temperature for servo in servos),
            error=(servos[0].error, servos[1].error, servos[2].error, servos[3].error, servos[4].error),
            torque_on=all(servo.torque_on for servo in servos),
        )

    def tend(self, bus: Bus, now: int) -> None:
        """Tell what there is; and at most one thing beside the cycle: reboot, find or look at the health of a servo."""
        self._tell(now)
        if self._pressed():
            return
        for servo in self._servos:
            try:
                if servo.reboot_ns is not None and servo.answers and now >= servo.reboot_ns:
                    self._reboot(bus, servo, now)
                    return
                if not servo.answers and now >= servo.retry_ns:
                    servo.retry_ns = now + round(self._settings.retry * 1e9)
                    self._revive(bus, servo)
                    return
            except Refused as error:
                self._teller.once(f"set up {servo.index}", Level.ERROR, f"{servo.name}: {error}")
                return
            except BusError:
                return
        if now >= self._health_ns:
            self._health_ns = now + round(self._settings.health * 1e9)
            self._health_turn = (self._health_turn + 1) % len(self._servos)
            servo = self._servos[self._health_turn]
            if servo.answers and not servo.suspect and not self._one_by_one:
                self._look_at_health(bus, servo)

    def _tell(self, now: int) -> None:
        self._absences.check(now)
        self._readings.check(now)
        # A servo that falls silent fails a reading first: that is one trouble, and not two.
        if self._failed_ns and now - self._failed_ns[0] > 2e9 * self._settings.silent_after:
            if not self._absences:
                for failed_ns in self._failed_ns:
                    self._readings.happened(failed_ns, self._failure)
            self._failed_ns.clear()

    def _look_at_health(self, bus: Bus, servo: Servo) -> None:
        try:
            answer = bus.read_bytes(servo.settings.id, xc330.PRESENT_VOLTAGE.address, HEALTH.size)
        except BusError as error:
            self.count(error)
            return
        volts, degrees = HEALTH.unpack(answer.data)
        servo.voltage, servo.temperature = volts * xc330.VOLT_PER_UNIT, float(degrees)

    def _reboot(self, bus: Bus, servo: Servo, now: int) -> None:
        servo.reboot_ns = None
        servo.reboots += 1
        self._teller.tell(Level.WARNING, f"{servo.name}: reboot {servo.reboots} of {self._settings.reboots}")
        bus.reboot(servo.settings.id)
        self.give_up(servo)
        self._absences.known([servo])
        servo.interrupted = True
        servo.retry_ns = now + round(_WAKING * 1e9)

    def _revive(self, bus: Bus, servo: Servo) -> None:
        """Take a lost servo back if it answers; its place is the one nearest to where it was last seen."""
        name = servo.settings.id
        mark = bus.read_bytes(name, READ_AT, 1).data[0]
        if mark != MARK:
            self._set_up.prepare(bus, servo, servo.position)
        servo.answers = True
        servo.heard_ns = self._clock()
        servo.error = 0
        self._absences.back(servo, mark != MARK, servo.heard_ns)

    def count(self, error: BusError) -> None:
        """Count a failed transaction; its servo is asked by itself next."""
        kinds = {NoAnswer: "no answer", Corrupt: "corrupt"}
        self.errors[kinds.get(type(error), "refused")] += 1
        for servo in self._servos:
            if servo.settings.id == error.servo:
                self.blamed[servo.name] += 1
                servo.suspect = True


def _five(values: Iterable[float]) -> Five:
    a, b, c, d, e = values
    return (a, b, c, d, e)
