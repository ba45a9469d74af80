"""One commander at a time: what each wish becomes, and what no sequence of wishes can bring about."""

from __future__ import annotations

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from onboard.lease import Lease, Watch, commands, keep, release, take

S = 1_000_000_000
PATIENCE = 10 * S
FREE = Lease()
ALICE = Lease("alice", 100 * S)


def test_the_first_takes_it() -> None:
    ruling = take(FREE, "alice", 100 * S, 99 * S, PATIENCE)
    assert ruling.granted
    assert ruling.lease == Lease("alice", 99 * S)
    assert commands(ruling.lease, "alice") == ""


def test_nobody_commands_without_taking_it() -> None:
    assert commands(FREE, "alice") == "Nobody commands: take the lease first."
    assert commands(ALICE, "bob") == "alice commands, not bob: seize command first, if you must."


def test_another_is_refused_and_told_who_has_it() -> None:
    ruling = take(ALICE, "bob", 102 * S, 102 * S, PATIENCE)
    assert not ruling.granted
    assert ruling.lease == ALICE
    assert ruling.text == "alice commands; it was heard 2.0 s ago. It can release, or be seized."


def test_another_seizes_it() -> None:
    ruling = take(ALICE, "bob", 102 * S, 101 * S, PATIENCE, seize=True)
    assert ruling.lease == Lease("bob", 101 * S)
    assert ruling.text == "bob has seized command from alice."


@pytest.mark.parametrize(("t", "granted"), [(110 * S, False), (110 * S + 1, True)])
def test_a_silent_commander_can_be_replaced(t: int, granted: bool) -> None:
    ruling = take(ALICE, "bob", t, t, PATIENCE)
    assert ruling.granted is granted


def test_silence_alone_takes_nothing_away() -> None:
    assert commands(ALICE, "alice") == ""
    again = take(ALICE, "alice", 1000 * S, 999 * S, PATIENCE)
    assert again.granted
    assert again.lease == Lease("alice", 999 * S)


def test_it_is_released_on_the_ground_only_and_by_its_holder_only() -> None:
    assert release(ALICE, "alice", flying=False).lease == FREE
    flying = release(ALICE, "alice", flying=True)
    assert (flying.granted, flying.lease) == (False, ALICE)
    assert flying.text == "The vehicle flies: land first, or let another station seize command."
    assert release(ALICE, "bob", flying=False).lease == ALICE
    assert not release(FREE, "bob", flying=False).granted


def test_only_its_holder_keeps_it_and_never_backwards() -> None:
    assert keep(ALICE, "alice", 105 * S) == Lease("alice", 105 * S)
    assert keep(ALICE, "alice", 95 * S) is ALICE
    assert keep(ALICE, "bob", 105 * S) is ALICE
    assert keep(FREE, "bob", 105 * S) is FREE


class Stations(RuleBasedStateMachine):
    """Any sequence of wishes of three stations."""

    names = st.sampled_from(["alice", "bob", "carol"])

    def __init__(self) -> None:
        super().__init__()
        self.lease = Lease()
        self.t = 0

    @rule(seconds=st.integers(0, 30))
    def wait(self, seconds: int) -> None:
        self.t += seconds * S

    @rule(name=names, age=st.integers(0, 2), seize=st.booleans())
    def take(self, name: str, age: int, seize: bool) -> None:
        before = self.lease
        silent = self.t - before.heard_ns > PATIENCE
        ruling = take(before, name, self.t, max(0, self.t - age * S), PATIENCE, seize=seize)
        assert ruling.granted is (before.holder in ("", name) or seize or silent)
        assert ruling.lease.holder == (name if ruling.granted else before.holder)
        self.lease = ruling.lease

    @rule(name=names)
    def keep(self, name: str) -> None:
        holder = self.lease.holder
        self.lease = keep(self.lease, name, self.t)
        assert self.lease.holder == holder

    @precondition(lambda self: self.lease.holder)
    @rule(name=names, flying=st.booleans())
    def release(self, name: str, flying: bool) -> None:
        before = self.lease
        self.lease = release(before, name, flying=flying).lease
        left = name == before.holder and not flying
        assert self.lease == (Lease() if left else before)

    @invariant()
    def one_at_most_commands(self) -> None:
        free_to = [name for name in ("alice", "bob", "carol") if not commands(self.lease, name)]
        assert free_to == ([self.lease.holder] if self.lease.holder else [])
        assert self.lease.heard_ns <= self.t


TestStations = Stations.TestCase


def test_watch_tells_loss_and_return_once_each() -> None:
    watch = Watch(S)
    assert watch.look(ALICE, present=True, t_ns=101 * S) == (False, "")
    assert watch.look(ALICE, present=True, t_ns=102 * S) == (
        True,
        "the commanding station alice is silent for 2.0 s.",
    )
    assert watch.look(ALICE, present=True, t_ns=103 * S) == (False, "")
    slow = Lease("alice", 103 * S + S // 2)
    assert watch.look(slow, present=True, t_ns=104 * S) == (False, ""), "told neither back nor lost again"
    back = Lease("alice", 105 * S)
    assert watch.look(back, present=True, t_ns=105 * S) == (
        False,
        "the commanding station alice is back after 5.0 s. Nothing resumes by itself.",
    )
    assert watch.look(back, present=True, t_ns=105 * S) == (False, "")


def test_watch_tells_one_that_is_gone_before_it_was_silent() -> None:
    watch = Watch(S)
    assert watch.look(ALICE, present=False, t_ns=100 * S) == (True, "the commanding station alice is gone.")


def test_watch_says_nothing_of_nobody_nor_of_one_that_was_replaced() -> None:
    watch = Watch(S)
    assert watch.look(FREE, present=False, t_ns=100 * S) == (False, "")
    assert watch.look(ALICE, present=True, t_ns=109 * S)[0]
    assert watch.look(Lease("bob", 110 * S), present=True, t_ns=110 * S) == (False, "")
