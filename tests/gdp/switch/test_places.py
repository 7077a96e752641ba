"""Where names are: asked until answered, watched on, believed for a lease, bounded."""

from __future__ import annotations

from itertools import pairwise

from gdp.limits import CLAIM_LEASE_S, NEGATIVE_LEASE_S, PARKED_S
from gdp.names import Name
from gdp.switch.places import AT_ONCE, QUESTIONS_MAX, RETRY_S, TRIES_MAX, WINDOW, Place, Places
from gdp.trust.right import Right
from tests.gdp.switch.net import HOME, name

TOPIC = name("topic")


def place(advertiser: str = "robot", expires_s: float = 30.0) -> Place:
    return Place(TOPIC, name(advertiser), Right.PUBLISH, name("switch"), HOME, frozenset(), b"claim", expires_s)


def asked(places: Places, now_s: float) -> list[tuple[Name, float]]:
    return places.due(now_s)[0]


def test_a_question_is_asked_at_once_and_again_until_it_is_given_up() -> None:
    places, now_s, times = Places(), 0.0, 0
    given_up: list[Name] = []
    places.want(TOPIC, now_s, watch=False)
    while not given_up:
        questions, given_up = places.due(now_s)
        times += len(questions)
        now_s += RETRY_S
    assert (times, given_up) == (TRIES_MAX, [TOPIC])
    assert places.next_due() is None


def test_wanting_twice_asks_once() -> None:
    places = Places()
    places.want(TOPIC, 0.0, watch=False)
    places.want(TOPIC, 0.0, watch=False)
    assert asked(places, 0.0) == [(TOPIC, 0.0)]
    assert asked(places, 0.0) == []


def test_an_answer_ends_a_question() -> None:
    places = Places()
    places.want(TOPIC, 0.0, watch=False)
    places.put(place(), 0.0)
    assert (places.is_asked(TOPIC), places.next_due()) == (False, None)


def test_a_watch_goes_on_after_its_answer() -> None:
    places = Places()
    places.want(TOPIC, 0.0, watch=True)
    places.put(place(), 0.0)
    assert asked(places, 1.0) == []
    assert asked(places, CLAIM_LEASE_S / 4) == [(TOPIC, places.watch_s)]


def test_a_watch_is_asked_at_once_though_the_name_was_asked_for_before() -> None:
    places = Places()
    places.want(TOPIC, 0.0, watch=False)
    assert asked(places, 0.0) == [(TOPIC, 0.0)]
    places.want(TOPIC, 0.1, watch=True)
    assert asked(places, 0.1) == [(TOPIC, places.watch_s)]


def test_a_new_rib_is_asked_everything_at_once() -> None:
    places = Places()
    places.want(TOPIC, 0.0, watch=True)
    places.put(place(), 0.0)
    places.ask_again(1.0)
    assert asked(places, 1.0) == [(TOPIC, places.watch_s)]


def test_what_is_watched_no_more_is_asked_no_more() -> None:
    places = Places()
    places.want(TOPIC, 0.0, watch=True)
    places.unwatch(TOPIC)
    assert (asked(places, 1.0), places.next_due()) == ([], None)


def test_a_place_is_believed_for_its_lease() -> None:
    places = Places()
    places.put(place(expires_s=5.0), 0.0)
    assert [each.advertiser for each in places.of(TOPIC, 4.9)] == [name("robot")]
    assert places.of(TOPIC, 5.0) == []
    places.expire(5.0)
    assert len(places) == 0


def test_two_advertisers_of_one_name_are_both_known() -> None:
    places = Places()
    places.put(place("one"), 0.0)
    places.put(place("two"), 0.0)
    places.remove(TOPIC, name("one"), 0.0)
    assert [each.advertiser for each in places.of(TOPIC, 0.0)] == [name("two")]


def test_nobody_is_believed_for_a_moment() -> None:
    places = Places()
    places.nobody(TOPIC, 0.0)
    assert places.is_nowhere(TOPIC, NEGATIVE_LEASE_S - 0.1)
    assert not places.is_nowhere(TOPIC, NEGATIVE_LEASE_S)


def test_somebody_ends_nobody() -> None:
    places = Places()
    places.nobody(TOPIC, 0.0)
    places.put(place(), 0.1)
    assert not places.is_nowhere(TOPIC, 0.2)


def test_open_questions_are_bounded_and_watches_stand_apart() -> None:
    places = Places()
    for number in range(QUESTIONS_MAX + 10):
        places.want(name(str(number)), 0.0, watch=False)
    places.want(TOPIC, 0.0, watch=True)
    assert places.is_asked(TOPIC)
    assert places.is_asked(name(str(QUESTIONS_MAX - 1)))
    assert not places.is_asked(name(str(QUESTIONS_MAX + 9)))


def test_a_window_of_new_names_awaits_answers_and_each_answer_lets_another_go() -> None:
    places = Places()
    for number in range(2 * WINDOW):
        places.want(name(str(number)), 0.0, watch=False)
    first = [each for _ in range(10) for each, _ in asked(places, 0.0)]
    assert len(first) == WINDOW
    assert max(len(asked(places, RETRY_S)), len(asked(places, RETRY_S))) == AT_ONCE  # the same ones again
    places.nobody(first[0], RETRY_S)
    assert [each for each, _ in asked(places, RETRY_S)] == [name(str(WINDOW))]


def test_who_has_many_names_asked_for_holds_up_nobody_else() -> None:
    places = Places()
    for number in range(2 * WINDOW):
        places.want(name(str(number)), 0.0, watch=False, owner=b"greedy")
    places.want(TOPIC, 0.0, watch=False, owner=b"modest")
    assert (TOPIC, 0.0) in asked(places, 0.0)


def test_a_name_whose_turn_comes_too_late_is_given_up_unasked() -> None:
    places = Places()
    for number in range(WINDOW + 1):
        places.want(name(str(number)), 0.0, watch=False)
    first = [each for _ in range(10) for each, _ in asked(places, 0.0)]
    late = name(str(WINDOW))
    assert late not in first
    places.nobody(first[0], PARKED_S)
    given_up = [each for _ in range(10) for each in places.due(PARKED_S)[1]]
    assert given_up == [late]
    assert not places.is_asked(late)


def test_the_echo_of_a_claim_that_was_brought_from_here_answers_no_question_until_it_is_told_again() -> None:
    places = Places()
    places.want(TOPIC, 0.0, watch=True)
    assert asked(places, 0.0) == [(TOPIC, places.watch_s)]
    places.put(place(), 0.01, is_ours=True)
    assert asked(places, RETRY_S) == [(TOPIC, places.watch_s)]
    places.put(place(), RETRY_S + 0.01, is_ours=True)
    assert asked(places, 2 * RETRY_S + 0.1) == []
    assert asked(places, CLAIM_LEASE_S / 4 + 1) == [(TOPIC, places.watch_s)]


def test_a_watch_is_renewed_in_time_however_often_the_rib_tells_of_the_name() -> None:
    places = Places()
    places.want(TOPIC, 0.0, watch=True)
    asked_s = []
    for now_s in range(60):
        asked_s += [now_s] if asked(places, now_s) else []
        places.put(place(expires_s=now_s + 30.0), now_s)
    assert asked_s[0] == 0
    assert all(b - a <= CLAIM_LEASE_S / 4 for a, b in pairwise(asked_s))
    assert len(asked_s) >= 60 / (CLAIM_LEASE_S / 4)
