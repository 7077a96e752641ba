"""Name cache of locations: entries last for a lease, negative entries for a moment."""

from __future__ import annotations

from gdp.intervals import NEGATIVE_LEASE_S
from gdp.switch.name_cache import Location, NameCache
from gdp.trust.right import Right
from tests.gdp.switch.net import HOME, name

TOPIC = name("topic")


def place(advertiser: str = "robot", expires_s: float = 30.0) -> Location:
    return Location(
        name=TOPIC,
        advertiser=name(advertiser),
        right=Right.PUBLISH,
        switch=name("switch"),
        domain=HOME,
        transit=frozenset(),
        advertisement=b"claim",
        expires_s=expires_s,
    )


def test_a_place_is_believed_for_its_lease() -> None:
    places = NameCache()
    places.put(place(expires_s=5.0))
    assert [each.advertiser for each in places.of(TOPIC, 4.9)] == [name("robot")]
    assert places.of(TOPIC, 5.0) == []
    places.expire(5.0)
    assert len(places) == 0


def test_two_advertisers_of_one_name_are_both_known() -> None:
    places = NameCache()
    places.put(place("one"))
    places.put(place("two"))
    places.remove(TOPIC, name("one"))
    assert [each.advertiser for each in places.of(TOPIC, 0.0)] == [name("two")]


def test_a_negative_entry_lasts_for_a_moment() -> None:
    places = NameCache()
    places.put_negative(TOPIC, 0.0)
    assert places.is_negative(TOPIC, NEGATIVE_LEASE_S - 0.1)
    assert not places.is_negative(TOPIC, NEGATIVE_LEASE_S)


def test_a_location_ends_a_negative_entry() -> None:
    places = NameCache()
    places.put_negative(TOPIC, 0.0)
    places.put(place())
    assert not places.is_negative(TOPIC, 0.2)
