"""What keys and buttons mean: the way a person presses them, and the way a keyboard repeats them."""

from __future__ import annotations

import pytest

from groundstation.estop_keys import Action, DeadMan, Keys, Pushed

STOP, KILL, LEAVE = Action.STOP, Action.KILL, Action.LEAVE


def pressed(*times: float, key: str) -> list[Action]:
    """What comes of a key at these times, looked at every 50 ms in between and for a while afterwards."""
    keys, done = Keys(), []
    left = sorted(times)
    for t in sorted({*times, *(i * 0.05 for i in range(int(20 * times[-1]) + 20))}):
        if left and t == left[0]:
            done.append(keys.press(key, left.pop(0)))
        done.append(keys.due(t))
    return [action for action in done if action is not None]


def repeated(delay: float, rate: float, length: float, start: float = 10.0) -> list[float]:
    """When a key comes that is held."""
    times, t = [start], start + delay
    while t < start + length:
        times.append(t)
        t += 1.0 / rate
    return times


@pytest.mark.parametrize("delay", [0.25, 0.5, 0.66])
@pytest.mark.parametrize("rate", [10.0, 25.0, 40.0])
def test_held_keys(delay: float, rate: float) -> None:
    """One stop, and no kill, however keyboards repeat."""
    for length in (0.3, delay + 1.5 / rate, 1.0, 5.0):
        times = repeated(delay, rate, length)
        assert pressed(*times, key=" ") == [STOP]
        if len(times) != 2:  # two alone are as two presses are
            assert pressed(*times, key="k") == []


@pytest.mark.parametrize(
    ("times", "done"),
    [
        ((1.0,), [STOP]),
        ((1.0, 1.1, 1.2, 1.35), [STOP]),  # hit in panic
        ((1.0, 2.0), [STOP, STOP]),
        ((1.0, 1.8, 2.6), [STOP, STOP, STOP]),
    ],
)
def test_space(times: tuple[float, ...], done: list[Action]) -> None:
    assert pressed(*times, key=" ") == done


@pytest.mark.parametrize(
    ("times", "kills"),
    [
        ((1.0,), False),
        ((1.0, 1.1), True),
        ((1.0, 1.15, 1.3), True),
        ((1.0, 1.5), True),
        ((1.0, 2.9), True),
        ((1.0, 3.1), False),
        ((1.0, 3.1, 3.3), True),
        ((1.0, 1.5, 1.53, 1.56, 1.59, 2.5, 3.0), True),  # held by mistake, then meant
    ],
)
def test_k(times: tuple[float, ...], kills: bool) -> None:
    assert bool(pressed(*times, key="k")) is kills


def test_a_fast_double_k_kills_with_the_second() -> None:
    keys = Keys()
    assert keys.press("k", 1.0) is None
    assert keys.waits(1.1)
    assert keys.press("K", 1.15) is KILL


def test_other_keys() -> None:
    keys = Keys()
    assert keys.press("q", 1.0) is LEAVE
    assert [keys.press(key, 2.0) for key in "xyz\r\x1b"] == [None] * 5


def test_a_dead_man_counts_once_it_was_pressed() -> None:
    man = DeadMan()
    assert (man.armed, man.changed(False), man.gone()) == (False, None, None)
    assert (man.changed(True), man.armed) == (None, True)
    assert man.changed(False) is STOP
    assert man.changed(False) is None
    man.changed(True)
    assert man.gone() is STOP
    man.changed(True)
    assert man.left() is STOP
    assert man.left() is None


def test_a_button_that_is_pushed() -> None:
    button = Pushed()
    assert [button.changed(True), button.changed(False), button.gone(), button.left()] == [STOP, None, STOP, None]
