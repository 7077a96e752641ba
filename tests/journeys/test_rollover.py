"""Replacement of expiring memberships, a domain's root and an owner's key while messages flow, without a loss."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.client.participant import Topic
from gdp.crypto.keys import SigningKey
from gdp.crypto.validity import Validity
from gdp.limits import CLOCK_SKEW_S
from gdp.trust.domain import Policy
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.owner import Owner
from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, Flow, flowing, row

LASTS_S = 30  # of a short membership, clocks' differences included
RENEWED_S = 20
MESSAGES = 100  # one a second: past the ends of three memberships
RETIRES_S = 50  # of the old root, clocks' differences included
ENDED_S = 45.0  # then nothing has come for a while
SKEW_S = int(CLOCK_SKEW_S)


def settled() -> Simulation:
    """Return a network where no link fails, and names outlast what is renewed here by little."""
    return row(lease_s=8.0, keepalive_ms=2_000)


def unix_s(world: Simulation) -> int:
    return int(world.network.now.unix_s)


def renew_all(world: Simulation, lasts_s: int) -> None:
    """Issue every membership again, by the present root of its domain."""
    for identity in world.identities.values():
        authority = next(each for each in world.authorities.values() if each.root.domain == identity.member.domain)
        validity = Validity(unix_s(world) - 2 * SKEW_S, unix_s(world) + lasts_s - SKEW_S)
        identity.renew(authority.renew(identity.member, validity), authority.root)


def policies(world: Simulation) -> list[Policy]:
    switches = [each.state.policy for each in world.switches.values()]
    ribs = [each.attachment._policy for each in world.ribs.values()]
    return [*switches, *ribs, *(each.attachment._policy for each in world.members.values())]


def stream(flow: Flow, count: int = MESSAGES) -> None:
    flow.stream(count, 1.0, size=100)


@pytest.mark.momentary("memberships end here, and with them whatever rests on them")
def test_memberships_that_are_renewed_in_time_cost_no_message() -> None:
    flow = flowing(settled())
    renew_all(flow.world, LASTS_S)
    stream(flow)
    for again in range(1, MESSAGES // RENEWED_S + 1):
        flow.world.network.call(again * float(RENEWED_S), lambda: renew_all(flow.world, LASTS_S))
    assert flow.world.network.run(MESSAGES + 30, lambda: flow.has(SERVER, MESSAGES))
    assert flow.numbers(SERVER) == list(range(MESSAGES))


@pytest.mark.momentary("memberships end here, and with them whatever rests on them")
def test_without_renewal_the_same_flow_ends() -> None:
    flow = flowing(settled())
    renew_all(flow.world, LASTS_S)
    stream(flow)
    flow.world.network.run(LASTS_S + ENDED_S)
    assert LASTS_S - 2 <= len(flow.numbers(SERVER)) <= LASTS_S + 30


@pytest.mark.momentary("a root ends here, and with it whatever rests on it")
def test_a_domains_root_rolls_over_without_a_lost_message() -> None:
    flow = flowing(settled())
    world, network = flow.world, flow.world.network
    retires = unix_s(world) + RETIRES_S - SKEW_S
    heirs = {
        label: authority.succeed(SigningKey.generate(), world.validity, retires)
        for label, authority in world.authorities.items()
    }

    def finish() -> None:
        world.authorities.update(heirs)

    roots = {each.root.domain: each.root for each in heirs.values()}
    for index, policy in enumerate(policies(world)):  # one node after the other
        network.call(1.0 + index, partial(policy.renew_roots, [roots[domain] for domain in policy.roots]))
    network.call(20.0, finish)
    for index, identity in enumerate(world.identities.values()):
        authority = next(each for each in heirs.values() if each.root.domain == identity.member.domain)
        member = authority.renew(identity.member, world.validity)
        network.call(21.0 + index, partial(identity.renew, member, authority.root))
    assert 21 + len(world.identities) < RETIRES_S < MESSAGES - 30
    stream(flow)
    assert network.run(MESSAGES + 30, lambda: flow.has(SERVER, MESSAGES))
    assert flow.numbers(SERVER) == list(range(MESSAGES))


@pytest.mark.momentary("a root ends here, and with it whatever rests on it")
def test_who_was_not_renewed_is_out_when_the_old_root_retires() -> None:
    flow = flowing(settled())
    world, network = flow.world, flow.world.network
    heirs = {
        label: authority.succeed(SigningKey.generate(), world.validity, unix_s(world) + RETIRES_S - SKEW_S)
        for label, authority in world.authorities.items()
    }
    roots = {each.root.domain: each.root for each in heirs.values()}
    for policy in policies(world):
        policy.renew_roots([roots[domain] for domain in policy.roots])
    stream(flow)
    network.run(RETIRES_S + ENDED_S)
    assert len(flow.numbers(SERVER)) <= RETIRES_S + 30


def given(flow: Flow, owner: Owner, label: str, right: Right) -> Topic:
    """Return the flow's topic for a member, as this owner delegates it."""
    identity, metadata = flow.world.identities[label], flow.topic.delegation.metadata
    assert metadata is not None
    delegation = owner.delegate(
        NodeDescriptor.from_wire(NodeDescriptor.make(identity)), metadata, [right], [1], flow.world.validity
    )
    return Topic(delegation, {epoch: grant.secret for epoch, grant in delegation.open(identity).items()})


def test_an_owners_key_rolls_over_without_a_lost_message() -> None:
    flow = flowing(settled())
    world, network = flow.world, flow.world.network
    key = SigningKey.generate()
    links = world.owner.succeed(key.public, flow.topic.delegation.subject, world.validity)
    heir = Owner(key, world.owner.master, world.owner.public, {links.name: links.chain})
    flow.stream(200, 0.02)
    network.call(1.0, lambda: world.members[SERVER].renew(given(flow, heir, SERVER, Right.READ)))
    network.call(2.0, lambda: flow.member.renew(given(flow, heir, ROBOT, Right.PUBLISH)))
    assert network.run(20, lambda: flow.has(SERVER, 200))
    assert flow.numbers(SERVER) == list(range(200))
    flow.outlive()
