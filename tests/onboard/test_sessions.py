"""What the vehicle keeps in mind about its stations, and that none can make it more than it should be."""

from __future__ import annotations

from onboard.sessions import ANSWERS, MOST, MOST_OF_ONE, Answers, Sessions
from onboard.wire import Ack, Heard, Outcome

S = 1_000_000_000


def ack(identity: str, outcome: Outcome = Outcome.DONE) -> Ack:
    return Ack(identity, outcome)


def test_the_newest_stamp_of_a_session_and_how_long_it_was_held() -> None:
    sessions = Sessions()
    sessions.come("alice", "s1", S)
    sessions.pulse("alice", "s1", 500, 2 * S)
    sessions.pulse("alice", "s1", 400, 3 * S)
    assert sessions.heard(4 * S) == (Heard("alice", "s1", 500, 2 * S, True),)


def test_a_station_is_present_while_one_of_its_sessions_is() -> None:
    sessions = Sessions()
    sessions.come("alice", "s1", 0)
    sessions.come("alice", "s2", 0)
    sessions.gone("alice", "s1")
    assert sessions.present("alice")
    sessions.gone("alice", "s2")
    sessions.gone("alice", "s2")
    assert not sessions.present("alice")
    assert not sessions.present("")


def test_pulses_alone_make_nobody_present_and_are_forgotten() -> None:
    sessions = Sessions()
    sessions.pulse("alice", "s1", 1, 0)
    assert not sessions.present("alice")
    assert len(sessions.heard(10 * S)) == 1
    assert sessions.heard(11 * S) == ()


def test_one_station_cannot_take_the_room_of_the_others() -> None:
    sessions = Sessions()
    assert [sessions.come("mallory", f"s{i}", 0) for i in range(MOST_OF_ONE + 1)] == [True] * MOST_OF_ONE + [False]
    assert sessions.come("alice", "s1", 0)


def test_there_is_an_end_to_all_sessions() -> None:
    sessions = Sessions()
    assert all(sessions.pulse(f"x{i}", "s", 1, 0) for i in range(MOST))
    assert not sessions.pulse("alice", "s1", 1, 0)
    assert len(sessions.heard(0)) == MOST
    sessions.gone("x0", "s")
    assert sessions.pulse("alice", "s1", 1, 0)


def test_answers_are_found_again_and_replaced() -> None:
    answers = Answers()
    assert answers.get("alice", "1") is None
    answers.put("alice", ack("1", Outcome.ACCEPTED))
    answers.put("alice", ack("1"))
    assert answers.get("alice", "1") == ack("1")
    assert answers.get("bob", "1") is None


def test_the_oldest_answers_make_way_and_only_those_of_the_same_station() -> None:
    answers = Answers()
    answers.put("bob", ack("1"))
    for i in range(ANSWERS + 1):
        answers.put("alice", ack(str(i)))
    assert answers.get("alice", "0") is None
    assert answers.get("alice", "1") == ack("1")
    assert answers.get("bob", "1") == ack("1")


def test_the_station_that_was_answered_longest_ago_makes_way() -> None:
    answers = Answers()
    answers.put("alice", ack("1"))
    answers.put("bob", ack("1"))
    answers.put("alice", ack("2"))
    for i in range(MOST - 1):
        answers.put(f"x{i}", ack("1"))
    assert answers.get("bob", "1") is None
    assert answers.get("alice", "1") == ack("1")
