"""Report of a node that makes no progress, and its time."""

from __future__ import annotations

import pytest

from gdp.client.attachment import Attachment, attachment_waits
from gdp.control.hello import NodeSettings
from gdp.control.hello_port import STRANGERS_MAX, Strangers
from gdp.control.waiting import Wait, WaitLog, WaitReason
from gdp.crypto.certificates import Role
from gdp.crypto.statements import parse
from gdp.errors import DropReason, StatementError
from gdp.intervals import NEIGHBOUR, REPORT_S
from gdp.sansio import ReceivedFrame
from gdp.trust.right import Right
from tests.gdp.control.members import CLOUD, ELSEWHERE, POLICY, Nonces, at, hello_protocol, node, statement_of
from tests.journeys.flows import ROBOT, ring

DOWN, ALONE = Wait(WaitReason.LINK_DOWN, 0), Wait(WaitReason.NO_NEIGHBOUR, 0)
NO_RIB = Wait(WaitReason.NO_RIB)


def attachment() -> Attachment:
    return Attachment(
        node("robot", Role.PROXY), POLICY, NodeSettings(incarnation=1, first_sequence=1, random_bytes=Nonces(1))
    )


def reasons(of: Attachment, now_s: float = 0.0) -> list[WaitReason]:
    return [wait.reason for wait in attachment_waits(of, now_s)]


def test_what_lasts_is_reported_once_and_again_when_it_changes() -> None:
    log = WaitLog()
    assert log.update([DOWN], 0.0) == []
    assert log.update([DOWN], REPORT_S) == [DOWN]
    assert log.update([DOWN], 2 * REPORT_S) == []
    assert log.update([ALONE], 2 * REPORT_S) == []
    assert log.update([ALONE], 2 * REPORT_S + 1) == [ALONE]
    assert log.lasting == [ALONE]


def test_what_is_over_in_time_is_not_reported_and_what_comes_back_waits_again() -> None:
    log = WaitLog()
    log.update([DOWN], 0.0)
    log.update([], REPORT_S - 1)
    assert log.update([DOWN], REPORT_S) == []
    assert log.update([DOWN], 2 * REPORT_S) == [DOWN]
    log.update([], 2 * REPORT_S)
    assert log.lasting == []


def test_a_port_and_a_missing_rib_are_reported_apart() -> None:
    log = WaitLog()
    log.update([DOWN], 0.0)
    log.update([DOWN, NO_RIB], 2.0)
    assert log.update([DOWN, NO_RIB], REPORT_S) == [DOWN]
    assert log.update([DOWN, NO_RIB], REPORT_S + 2) == [NO_RIB]


def test_a_node_whose_link_is_down_and_then_up_says_so() -> None:
    alone = attachment()
    alone.hello_protocol.add_port(0, bytes(6), 1_500, 10, 0.0)
    assert reasons(alone) == [WaitReason.NO_NEIGHBOUR]
    alone.hello_protocol.port_changed(0, False, 0.0)
    assert reasons(alone) == [WaitReason.LINK_DOWN]


@pytest.mark.parametrize(("role", "reason"), [(Role.SWITCH, WaitReason.ONE_WAY), (Role.PROXY, WaitReason.NO_SWITCH)])
def test_a_neighbour_that_does_not_answer_differs_from_one_that_is_no_switch(role: Role, reason: WaitReason) -> None:
    alone, other = attachment(), hello_protocol(node("other", role), 2)
    alone.hello_protocol.add_port(0, bytes(6), 1_500, 10, 0.0)
    for hello in other.hellos_to_send(0.0):
        alone.hello_protocol.receive(
            ReceivedFrame(0, b"\2far\0\0", hello.frames[0]), parse(statement_of(hello.frames[0])), at(0.0)
        )
    assert reasons(alone) == [reason]


def test_a_neighbour_of_a_domain_that_is_not_trusted_is_named_while_it_is_heard() -> None:
    alone, stranger = attachment(), hello_protocol(node("stranger", domain=ELSEWHERE), 2)
    alone.hello_protocol.add_port(0, bytes(6), 1_500, 10, 0.0)
    (hello,) = stranger.hellos_to_send(0.0)
    with pytest.raises(StatementError):
        alone.hello_protocol.receive(
            ReceivedFrame(0, b"\2far\0\0", hello.frames[0]), parse(statement_of(hello.frames[0])), at(0.0)
        )
    (wait,) = attachment_waits(alone, NEIGHBOUR.refresh_s)
    assert wait == Wait(WaitReason.STRANGER, 0, ELSEWHERE.root.label, refused=DropReason.WRONG_DOMAIN)
    assert reasons(alone, 10.0) == [WaitReason.NO_NEIGHBOUR]


def test_what_is_kept_of_strangers_is_bounded_and_unreadable_ones_are_kept_too() -> None:
    strangers = Strangers()
    for at_s in range(3 * STRANGERS_MAX):
        strangers.record(at_s.to_bytes(1, "big"), DropReason.BAD_CERTIFICATE, float(at_s))
    kept = strangers.since(0.0)
    assert [each.heard_s for each in kept] == [*range(2 * STRANGERS_MAX, 3 * STRANGERS_MAX)]
    assert {each.domain for each in kept} == {""}


def test_a_world_at_work_waits_for_nothing_and_without_ribs_says_so() -> None:
    world = ring()
    now_s = world.network.now.mono_s
    robot, nuc1 = world.members[ROBOT].attachment, world.switches["nuc1"]
    assert attachment_waits(robot, now_s) == nuc1.waits((), now_s) == []
    for lead in [each for each in world.leads if each.endswith("/rib")]:
        world.network.set_link(world.leads[lead], up=False)
    robot = world.restart_member(ROBOT).attachment
    world.network.run(3)
    assert NO_RIB in attachment_waits(robot, world.network.now.mono_s)
    assert NO_RIB in nuc1.waits(range(9), world.network.now.mono_s)


def test_a_refused_advertisement_is_named_with_the_reason() -> None:
    world = ring()
    robot = world.members[ROBOT].attachment
    own = world.identities[ROBOT].subject
    robot.advertisement(own, Right.PUBLISH, (), is_global=True)
    next(each for each in robot.advertisements if each.right is Right.PUBLISH).refused = DropReason.NOT_DELEGATED
    assert attachment_waits(robot, 0.0) == [Wait(WaitReason.REFUSED, name=own.name, refused=DropReason.NOT_DELEGATED)]


def test_the_domain_of_a_trusted_member_is_not_a_stranger() -> None:
    alone, other = attachment(), hello_protocol(node("other", domain=CLOUD), 2)
    alone.hello_protocol.add_port(0, bytes(6), 1_500, 10, 0.0)
    (hello,) = other.hellos_to_send(0.0)
    alone.hello_protocol.receive(
        ReceivedFrame(0, b"\2far\0\0", hello.frames[0]), parse(statement_of(hello.frames[0])), at(0.0)
    )
    assert reasons(alone) == [WaitReason.ONE_WAY]
