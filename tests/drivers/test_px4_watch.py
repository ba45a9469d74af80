"""The link to PX4 and what comes over it: each trouble is told once, and its end."""

from __future__ import annotations

from drivers.mailbox import Level
from drivers.px4_watch import LinkWatch

MS = 1_000_000


class Bench:
    """A watch in a time of its own, ms."""

    def __init__(self) -> None:
        self.told: list[tuple[Level, str]] = []
        self.watch = LinkWatch(lambda level, text: self.told.append((level, text)), 250.0)
        self.watch.begin(0)
        self.rates = {"A": 250.0, "B": 250.0}
        self.now = 0
        self.back = 0
        self.asked_again = 0

    def run(self, seconds: float, heard: bool = True, same: bool | None = None, trip: int | None = None) -> None:
        """Look every 50 ms; ``same``: attitudes that repeat or not; ``trip`` of each question, ms."""
        for _ in range(round(seconds / 0.05)):
            self.now += 50
            now = self.now * MS
            if heard:
                self.watch.heard(now)
            if same is not None:
                for _ in range(12):
                    self.watch.moves(now, same)
            if trip is not None:
                self.watch.answered(now, now - trip * MS)
            self.back += self.watch.check(now)
            self.asked_again += self.watch.judge_rates(now, lambda: self.rates)

    def texts(self) -> list[str]:
        return [text for _, text in self.told]


def test_nothing_is_told_of_a_link_that_works() -> None:
    bench = Bench()
    bench.run(30.0, same=False, trip=4)
    assert bench.told == []
    assert bench.watch.lateness == 0


def test_silence_is_told_once_and_so_is_its_end() -> None:
    bench = Bench()
    bench.run(1.0)
    bench.run(4.95, heard=False)
    assert bench.back == 0
    bench.run(5.0)
    assert bench.watch.linked
    assert bench.back == 1
    assert bench.texts() == [
        "the link to PX4 is lost: nothing comes any more; check its cable and power",
        "the link to PX4 is back after 5.0 s",
    ]


def test_a_short_pause_is_no_loss() -> None:
    bench = Bench()
    bench.run(0.5, heard=False)
    bench.run(2.0)
    assert bench.told == []


def test_the_same_attitude_over_and_over() -> None:
    bench = Bench()
    bench.run(1.0, same=False)
    bench.run(2.0, same=True)
    assert bench.texts() == ["PX4 tells the same attitude over and over: its estimator hangs; land"]
    bench.run(2.0, same=False)
    assert bench.texts()[1:] == ["PX4's attitude moves again"]


def test_a_few_equal_attitudes_are_chance() -> None:
    bench = Bench()
    for _ in range(100):
        for same in (True,) * 9 + (False,):
            bench.watch.moves(0, same)
    assert bench.told == []


def test_numbers_that_are_not_finite() -> None:
    bench = Bench()
    for _ in range(500):
        bench.watch.unusable(0, "ATTITUDE_QUATERNION")
    bench.run(3.0)
    assert bench.texts() == [
        "ATTITUDE_QUATERNION holds numbers that are not finite and is not used: land, restart PX4",
        "what PX4 measures is usable again; 500 messages were not",
    ]


def test_slow_streams_are_told_together_and_asked_for_again() -> None:
    bench = Bench()
    bench.rates = {"A": 150.0, "B": 160.0}
    bench.now += 7  # looks come a little late
    bench.run(4.5)
    assert bench.texts() == ["A comes at 150 Hz and B comes at 160 Hz, asked for 250 Hz; asking again"]
    assert bench.asked_again == 3
    bench.rates = {"A": 240.0, "B": 240.0}
    bench.run(3.0)
    assert bench.texts()[1:] == ["PX4's messages come at the rates asked for again"]


def test_the_second_after_a_silence_is_no_slow_stream() -> None:
    bench = Bench()
    bench.run(2.0)
    bench.run(2.0, heard=False)
    bench.rates = {"A": 90.0, "B": 90.0}
    bench.run(1.0)
    bench.rates = {"A": 250.0, "B": 250.0}
    bench.run(3.0)
    assert not any("asked for" in text for text in bench.texts())


def test_late_messages_are_as_old_as_the_round_trip() -> None:
    bench = Bench()
    bench.run(1.0, trip=3)
    bench.run(2.0, trip=200)
    assert bench.watch.lateness == 200 * MS
    bench.run(2.0, trip=3)
    assert bench.watch.lateness == 0
    first, second = bench.texts()
    assert first.startswith("PX4's answers take 200 ms: the link is congested")
    assert second == "PX4 answers in time again"


def test_single_late_answers_are_jitter() -> None:
    bench = Bench()
    for _ in range(20):
        bench.run(0.1, trip=3)
        bench.run(0.1, trip=120)
    assert bench.told == []
    assert bench.watch.lateness == 0
