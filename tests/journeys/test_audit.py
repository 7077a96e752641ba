"""Audit log entries of switches and RIBs while a topic flows."""

from __future__ import annotations

from gdp.trust.audit import BEGIN, AuditLine
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from tests.journeys.flows import SERVER, Flow, flowing, ring


def lines(policy: Policy) -> list[AuditLine]:
    return policy.audit.poll_lines(0.0, 0.0, 0, BEGIN)


def audited() -> tuple[Flow, list[Policy], list[Policy]]:
    world = ring()
    switches = [each.state.policy for each in world.switches.values()]
    ribs = [each.rib.state.policy for each in world.ribs.values()]
    for policy in (*switches, *ribs):
        policy.audit.begin()
    return flowing(world), switches, ribs


def test_switch_and_rib_note_the_names_that_they_accept_once() -> None:
    flow, switches, ribs = audited()
    name, node = flow.topic.name.to_text(), flow.member.name.to_text()
    for policies in (switches, ribs):
        reported = [each for policy in policies for each in lines(policy) if (each.about, each.who) == (name, node)]
        assert reported
        assert {(each.action, each.what) for each in reported} == {("accepted", "name")}
    flow.outlive()
    assert not [each for policy in (*switches, *ribs) for each in lines(policy) if each.about == name]


def test_a_revocation_is_noted_where_it_is_taken() -> None:
    flow, switches, _ = audited()
    world = flow.world
    member = world.identities[SERVER].member
    root = next(each for each in world.authorities.values() if each.root.domain == member.domain)
    wire = Revocation.make(root.key, root.root.signer, member.fingerprint, member.not_after_unix_s)
    world.switches["nuc1"].revoke(wire, world.network.now)
    world.network.send_pending("nuc1")
    world.network.run(5)
    for policy in switches:
        (reported,) = [each for each in lines(policy) if each.action == "revoked"]
        assert (reported.who, reported.about) == (root.root.domain.to_text(), member.fingerprint.hex())
    flow.outlive(negative=True)
