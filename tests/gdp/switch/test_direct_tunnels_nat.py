"""Direct tunnels between two switches behind simulated NATs: both ends come up whenever the NATs permit it."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.gdp.switch.nat import Nat, World, permits

NATS = [each for each in Nat if each is not Nat.LINUX]
PAIRS = list(product(NATS, NATS))
QUICK_S = 10.0
LOSSY_S = 240.0


@pytest.mark.parametrize(("one", "other"), [pair for pair in PAIRS if permits(*pair)])
def test_both_ends_come_up_soon_where_the_nats_permit_it_and_stay_up(one: Nat, other: Nat) -> None:
    world = World(one, other)
    assert world.run(QUICK_S, lambda: world.is_up)
    world.run(5)
    assert not world.run(120, lambda: not world.is_up)


@pytest.mark.parametrize(("one", "other"), [pair for pair in PAIRS if not permits(*pair)])
def test_nats_without_a_direct_path_stay_without_one(one: Nat, other: Nat) -> None:
    assert not (world := World(one, other)).run(120, lambda: world.is_up)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.sampled_from([Nat.FULL_CONE, Nat.ADDRESS, Nat.PORT]), st.integers(0, 1 << 32))
def test_a_linux_router_that_keeps_the_peers_first_packet_is_passed_after_a_silence(other: Nat, seed: int) -> None:
    world = World(Nat.LINUX, other, seed=seed)
    assert world.run(60, lambda: world.is_up)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.sampled_from([pair for pair in PAIRS if permits(*pair)]), st.integers(0, 1 << 32), st.floats(0.0, 0.25))
def test_both_ends_come_up_despite_loss(pair: tuple[Nat, Nat], seed: int, loss: float) -> None:
    world = World(*pair, seed=seed, loss=loss)
    assert world.run(LOSSY_S, lambda: world.is_up)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.sampled_from([pair for pair in PAIRS if permits(*pair)]), st.sampled_from(NATS), st.integers(0, 1 << 32))
def test_an_end_that_moves_behind_another_nat_is_reached_again(pair: tuple[Nat, Nat], nat: Nat, seed: int) -> None:
    world = World(*pair, seed=seed)
    assert world.run(QUICK_S, lambda: world.is_up)
    moved, other = world.ends
    world.move(moved, nat, "203.0.113.77")
    world.run(1.5)  # both ends have found out
    assert world.run(3 * QUICK_S, lambda: world.is_up) is permits(nat, other.gateway.nat)


@pytest.mark.parametrize("pair", [(Nat.PORT, Nat.PORT), (Nat.SYMMETRIC, Nat.FULL_CONE), (Nat.SYMMETRIC, Nat.ADDRESS)])
def test_nats_that_forget_their_mappings_are_opened_again(pair: tuple[Nat, Nat]) -> None:
    world = World(*pair)
    assert world.run(QUICK_S, lambda: world.is_up)
    for end in world.ends:
        end.gateway.ports.clear()
        end.gateway.sent.clear()
        end.gateway.next_port += 1_000
        end.observe()
        world.publish(end)
    world.run(1.5)
    assert world.run(3 * QUICK_S, lambda: world.is_up)
