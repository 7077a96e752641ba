"""Price catalogue: offers in price order, the origin of prices, and the shipped data."""

from __future__ import annotations

import pytest

from fog.catalog.measured import measured
from fog.catalog.prices import aws_prices, price_list, regions_of
from fog.hardware import Hardware
from gdp.errors import LocalError


def test_the_price_list_starts_with_the_cheapest_that_has_enough() -> None:
    wanted = Hardware.from_text("cpu:8,T4")
    offers = price_list("aws", wanted, spot=True)
    assert offers == sorted(offers, key=lambda offer: offer.usd_per_hour)
    assert offers
    assert all(wanted.fits(offer.hardware) and offer.is_spot for offer in offers)


def test_a_spot_machine_costs_less_than_the_same_on_demand() -> None:
    for provider in ("aws", "local"):
        full = {(each.region, each.type_name): each for each in price_list(provider, Hardware(), spot=False)}
        for spot in price_list(provider, Hardware(), spot=True):
            assert 0 < spot.usd_per_hour < full[spot.region, spot.type_name].usd_per_hour


def test_local_pretends_any_region_and_any_gpu() -> None:
    (offer, *_) = price_list("local", Hardware.from_text("A100"), spot=True, regions=["us-east-1"])
    assert (offer.provider, offer.region, offer.hardware.gpu) == ("local", "us-east-1", "A100")
    assert regions_of("local") == ("local-a", "local-b", "local-c", "local-d")


def test_a_provider_without_a_list_is_named() -> None:
    with pytest.raises(LocalError, match="local, aws"):
        price_list("azure", Hardware())


def test_a_price_says_where_it_is_from() -> None:
    assert any("2024" in source for source in aws_prices().sources)
    assert measured().source


def test_pairs_of_one_region_go_together_more_often_than_independent_ones() -> None:
    low, high = measured().factors
    assert (low, high) == (1.63, 3.69)
    assert measured().uptime_s < measured().back_s
