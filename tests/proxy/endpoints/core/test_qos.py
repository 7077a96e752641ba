"""QoS profiles: requested, offered and combined ones."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest

from proxy.endpoints.core.qos import DEPTH_MAX, deadline_s, default, depth_of, kept, offer, request, unmatched
from proxy.serial.channel import NEVER, Qos

LATCHED = default(latched=True, depth=5)
EASY = default(reliable=False)


def match(offered: Qos, wanted: Qos) -> bool:
    """Return whether DDS 1.4, section 2.2.3, lets these two match, for all policies without times."""
    reliable = wanted.reliability != "reliable" or offered.reliability == "reliable"
    return reliable and (wanted.durability != "transient_local" or offered.durability == "transient_local")


ALL = [default(reliable=reliable, latched=latched) for reliable, latched in product((True, False), repeat=2)]


@pytest.mark.parametrize("offers", [*product(ALL, repeat=1), *product(ALL, repeat=2), *product(ALL, repeat=3)])
def test_what_is_requested_matches_every_publisher(offers: tuple[Qos, ...]) -> None:
    assert all(match(each, request(offers)) for each in offers)


@pytest.mark.parametrize("wants", [*product(ALL, repeat=1), *product(ALL, repeat=2)])
@pytest.mark.parametrize("sources", [*product(ALL, repeat=0), *product(ALL, repeat=1), *product(ALL, repeat=2)])
def test_what_is_offered_matches_every_reader_and_is_no_less_than_any_source(
    sources: tuple[Qos, ...], wants: tuple[Qos, ...]
) -> None:
    offered = offer(sources, wants, is_latched=None)
    assert all(match(offered, each) for each in (*wants, *sources))


SHORT, LONG = replace(EASY, lifespan=(0, 250_000_000)), replace(EASY, deadline=(2, 0))


@pytest.mark.parametrize(
    ("offers", "seconds"),
    [
        ([SHORT], 0.25),
        ([LONG], 2.0),
        ([replace(SHORT, deadline=(2, 0))], 0.25),
        ([SHORT, LONG], 2.0),
        ([SHORT, EASY], None),
        ([replace(EASY, lifespan=(0, 0), deadline=(2_147_483_647, 0))], None),
        ([], None),
    ],
    ids=["lifespan", "deadline", "lifespan first", "the longest", "one without", "infinite", "no publisher"],
)
def test_messages_are_of_use_for_as_long_as_their_publishers_say(offers: list[Qos], seconds: float | None) -> None:
    assert deadline_s(offers) == seconds


def test_the_most_that_publishers_have_in_common_is_requested() -> None:
    assert request([LATCHED, LATCHED]).durability == "transient_local"
    assert request([LATCHED, default()]).durability == "volatile"
    assert request([default(), default()]).reliability == "reliable"
    assert request([default(), EASY]).reliability == "best_effort"
    assert request([]).durability == "volatile"


def test_late_joiners_get_what_one_latched_publisher_keeps_and_as_much_as_may_be_of_several() -> None:
    assert kept([]) == kept([default()]) == kept([LATCHED, default()]) == 0
    assert kept([LATCHED]) == 5
    assert kept([replace(LATCHED, depth=10_000)]) == DEPTH_MAX
    assert kept([replace(LATCHED, history="keep_all", depth=0)]) == DEPTH_MAX
    assert kept([LATCHED, LATCHED]) == DEPTH_MAX


def test_a_depth_that_is_not_said_is_ros_2s_default_and_one_of_what_is_latched() -> None:
    assert depth_of(replace(default(), depth=0)) == 10
    assert depth_of(replace(LATCHED, depth=0)) == DEPTH_MAX


def test_what_a_rule_latches_or_not_is_offered_so_unless_a_reader_insists() -> None:
    assert offer([default()], [], is_latched=True).durability == "transient_local"
    assert offer([LATCHED], [], is_latched=False).durability == "volatile"
    assert offer([LATCHED], [LATCHED], is_latched=False).durability == "transient_local"


def test_what_is_offered_keeps_as_much_as_its_source_and_as_may_be_of_several() -> None:
    assert offer([LATCHED], [], is_latched=None).depth == 5
    assert offer([LATCHED, LATCHED], [], is_latched=None).depth == DEPTH_MAX
    assert offer([], [replace(LATCHED, depth=1)], is_latched=None).depth == 1
    assert offer([], [], is_latched=None) == default()
    assert offer([replace(default(), depth=1 << 62)], [], is_latched=None).depth == 1_000


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, ""),
        ({"deadline": (0, 0)}, ""),
        ({"liveliness": "best_available"}, ""),
        ({"deadline": (0, 100)}, ""),
        (
            {"liveliness": "manual_by_topic"},
            "it requests liveliness manual_by_topic, which does not cross: publishers assert it by themselves",
        ),
        ({"lease": (1, 0)}, ""),
        ({"lease": NEVER}, ""),
    ],
)
def test_what_does_not_cross_is_named(change: dict[str, str], said: str) -> None:
    assert unmatched(replace(default(), **change)) == said  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["deadline", "lease"])
@pytest.mark.parametrize(
    ("stated", "wanted", "is_met"),
    [
        ([(1, 0)], (1, 0), True),
        ([(1, 0), (2, 0)], (3, 0), True),
        ([(1, 0), (2, 0)], (1, 500_000_000), False),
        ([(1, 0), NEVER], (3, 0), False),
        ([(0, 0)], (3, 0), False),
        ([(1, 0)], NEVER, True),
    ],
    ids=["equal", "longer than all", "shorter than one", "one without", "not stated", "no wish"],
)
def test_the_longest_time_of_the_far_publishers_is_offered_to_who_requests_one(
    name: str, stated: list[tuple[int, int]], wanted: tuple[int, int], is_met: bool
) -> None:
    def having(time: tuple[int, int]) -> Qos:
        return replace(default(), **{name: time})  # type: ignore[arg-type]

    want = having(wanted)
    offered = offer(list(map(having, stated)), [want], is_latched=None)
    assert (unmatched(want, offered) == "") is is_met
    assert not unmatched(want)
    assert getattr(offer([having((1, 0))], [default()], is_latched=None), name) == NEVER
