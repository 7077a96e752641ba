"""Calls across two domains: requests to every server by a tree, each response to its client."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.crypto.statements import parse
from gdp.errors import DropReason, LocalError
from gdp.frame.codec import Kind
from gdp.intervals import ADVERTISEMENT, FORGET_S, READER
from gdp.sansio import ReceivedFrame
from gdp.trust.adcert import AdCert
from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.journeys.flows import LEASES, ROBOT, SERVER, Tap, row
from tests.journeys.services import SERVICE, Party, meet, outlive, work
from tests.lanes import nightly

OTHER = "nuc2/other"


def row_of_three() -> Simulation:
    """Return the row with a third member."""
    world = row()
    world.add_member(OTHER, "nuc2")
    assert world.run_until_attached()
    return world


def pair(world: Simulation) -> tuple[Party, Party]:
    server, client = Party(world, SERVER, Right.SERVE), Party(world, ROBOT, Right.CALL)
    assert meet(world, server, client)
    return server, client


def test_a_call_is_answered_across_domains() -> None:
    world = row()
    server, client = pair(world)
    client.publish(b"1+2")
    assert work(world, server, client, until_s=2, have=1)
    (answer,) = client.got
    assert (answer.topic, answer.private, answer.delivered.message) == (client.service, True, b"1+2 by nuc5/server")
    assert (answer.description, answer.delivered.hops) == (b"serve by nuc5/server", 3)
    assert [(each.private, each.description) for each in server.got] == [(False, b"call by nuc1/robot")]
    outlive(world, client, server)


@pytest.mark.parametrize("first", [Right.SERVE, Right.CALL])
def test_the_first_call_is_answered_as_soon_as_a_server_is_known(first: Right) -> None:
    world = row()
    order = sorted((Right.SERVE, Right.CALL), key=lambda right: right is not first)
    parties = {right: Party(world, SERVER if right is Right.SERVE else ROBOT, right) for right in order}
    client, server = parties[Right.CALL], parties[Right.SERVE]
    assert world.network.run(2, lambda: bool(client.member.services.peers(client.service)))
    client.publish(b"first")
    assert work(world, server, client, until_s=0.1, have=1)
    assert client.stream.drops[DropReason.NO_READER] == 0
    outlive(world, client, server)


def test_two_servers_both_answer() -> None:
    world = row_of_three()
    servers = [Party(world, SERVER, Right.SERVE), Party(world, OTHER, Right.SERVE)]
    client = Party(world, ROBOT, Right.CALL)
    assert meet(world, *servers, client)
    client.publish(b"?")
    assert work(world, *servers, client, until_s=2, have=2)
    assert sorted(client.bodies()) == [b"? by nuc2/other", b"? by nuc5/server"]
    outlive(world, client, *servers)


def test_an_answer_goes_to_the_client_that_asked_alone() -> None:
    world = row_of_three()
    server = Party(world, SERVER, Right.SERVE)
    asks, idle = Party(world, ROBOT, Right.CALL), Party(world, OTHER, Right.CALL)
    assert meet(world, server, asks, idle)
    tap = Tap("nuc2", OTHER)
    world.network.taps.append(tap)
    asks.publish(b"?")
    assert work(world, server, idle, asks, until_s=2, have=1)
    assert (idle.got, tap.count(Kind.DATA)) == ([], 0)
    outlive(world, asks, server)
    assert (idle.collect(), tap.count(Kind.DATA)) == ([], 0)


def test_news_of_a_server_reaches_all_its_clients() -> None:
    world = row_of_three()
    server = Party(world, SERVER, Right.SERVE)
    clients = [Party(world, ROBOT, Right.CALL), Party(world, OTHER, Right.CALL)]
    assert meet(world, server, *clients)
    server.publish(b"feedback")
    for client in clients:
        assert work(world, client, until_s=2, have=1)
        assert [(each.private, each.delivered.message) for each in client.got] == [(False, b"feedback")]
    outlive(world, clients[0], server)


def test_a_server_that_dies_is_no_peer_any_more_and_its_private_stream_ends() -> None:
    world = row()
    _, client = pair(world)
    world.network.stop(SERVER)
    assert world.network.run(READER.lease_s + 2, lambda: not client.member.services.peers(client.service))
    assert world.network.run(40, lambda: not list(client.member.subscriptions.writer_proxies()))
    world.network.run(LEASES * world.lease_s)
    assert list(client.member.subscriptions.writer_proxies()) == []


@pytest.mark.momentary("it is about the seconds in which clients still ask a server that died")
def test_a_server_that_died_is_sought_a_few_times_a_second() -> None:
    world = row()
    _, client = pair(world)
    tap = Tap("nuc5", "nuc5/rib")
    world.network.taps.append(tap)
    world.network.stop(SERVER)
    for number in range(20):
        world.network.call(0.1 * number, partial(client.publish, b"?"))
    world.network.run(3.0)
    assert 0 < tap.count(Kind.RIB_REQUEST) < 100


def test_a_server_that_withdraws_is_no_peer_at_once() -> None:
    world = row()
    server, client = pair(world)
    server.member.withdraw(server.service)
    world.network.send_pending(SERVER)
    assert world.network.run(1, lambda: not list(client.member.subscriptions.writer_proxies()))
    assert client.member.services.peers(client.service) == []
    with pytest.raises(LocalError):
        server.member.services.respond(server.service, client.member.name, b"too late")
    world.network.run(LEASES * world.lease_s)
    assert client.member.services.peers(client.service) == []


def test_answers_to_a_former_life_do_not_reach_the_new_one() -> None:
    world = row()
    server, client = pair(world)
    server.answers = False
    client.publish(b"asked in the first life")
    assert work(world, client, server, until_s=2, have=1)
    world.restart_member(ROBOT)
    server.answer(client.member.name, b"for the first life")
    client.begin()
    assert meet(world, server, client)
    server.answer(client.member.name, b"for the second life")
    assert work(world, client, until_s=2, have=1)
    assert client.bodies() == [b"for the second life"]
    outlive(world, client, server)


def test_a_restarted_server_answers_again() -> None:
    world = row()
    server, client = pair(world)
    client.publish(b"1")
    assert work(world, server, client, until_s=2, have=1)
    world.restart_member(SERVER)
    server.begin()
    assert world.network.run(
        30, lambda: client.stream.readers == 1 and len(server.member.services.peers(server.service)) == 1
    )
    world.network.run(1)
    client.publish(b"2")
    assert work(world, server, client, until_s=2, have=2)
    assert client.bodies() == [b"1 by nuc5/server", b"2 by nuc5/server"]
    outlive(world, client, server)


@pytest.mark.parametrize("seed", [1, *nightly(2, 3)])
def test_a_lost_part_of_an_answer_is_repaired(seed: int) -> None:
    world = row(seed, lease_s=8.0, keepalive_ms=None)  # shorter ones may end before a renewal has passed such links
    server, client = pair(world)
    server.answers = False
    for sim_link in world.cables.values():
        sim_link.loss = 0.1  # one frame of five is lost on two cables
    large = bytes(range(256)) * 400
    for _ in range(20):
        server.answer(client.member.name, large)
    assert work(world, client, until_s=20, have=20)
    assert client.bodies() == [large] * 20
    for sim_link in world.cables.values():
        sim_link.loss = 0.0
    outlive(world, client, server)


def test_a_lost_answer_alone_is_asked_for_and_repaired() -> None:
    world = row()
    server, client = pair(world)
    world.leads[ROBOT].loss = 1.0
    server.answer(client.member.name, b"lost at first")
    world.network.run(0.5)
    world.leads[ROBOT].loss = 0.0
    assert work(world, client, until_s=2, have=1)
    outlive(world, client, server)


def test_replayed_answers_are_dropped() -> None:
    world = row()
    server, client = pair(world)
    tap = Tap("nuc1", ROBOT)
    world.network.taps.append(tap)
    for _ in range(3):
        client.publish(b"?")
    assert work(world, server, client, until_s=2, have=3)
    neighbour = client.member.attachment.switch
    assert neighbour is not None
    frames = [frame for header, frame in zip(tap.headers, tap.frames, strict=True) if header.kind == Kind.DATA]
    assert frames
    dropped = client.member.drops()[DropReason.LATE]
    client.member.receive([ReceivedFrame(neighbour.port, neighbour.mac, frame) for frame in frames], world.network.now)
    assert client.member.poll_messages() == []
    assert client.member.drops()[DropReason.LATE] > dropped
    outlive(world, client, server)


@pytest.mark.momentary("it is refused before anything is claimed")
def test_a_node_without_the_right_to_serve_or_call_does_neither() -> None:
    world = row()
    member = world.members[ROBOT]
    caller = world.topic(SERVICE, member, [Right.CALL], kind="service")
    with pytest.raises(LocalError, match="no delegation to serve"):
        member.serve(caller, b"")
    with pytest.raises(LocalError, match="no serve of"):
        member.services.respond(caller.name, world.members[SERVER].name, b"")
    with pytest.raises(LocalError, match="no delegation to call"):
        member.call(world.topic(SERVICE, member, [Right.SERVE], kind="service"), b"")


def test_a_node_that_may_only_call_reaches_no_client_however_it_advertises() -> None:
    world = row()
    server, client = pair(world)
    world.add_member(OTHER, "nuc2")
    liar = world.members[OTHER]
    assert world.run_until_attached()
    topic = world.topic(SERVICE, liar, [Right.CALL], kind="service")
    liar.attachment.advertisement(topic.delegation.subject, Right.SERVE, topic.delegation.chain, is_global=True)
    world.network.send_pending(OTHER)
    world.network.run(2)
    assert liar.attachment.refusals[DropReason.NOT_DELEGATED] >= 1
    assert client.member.services.peers(client.service) == [server.member.name]
    outlive(world, client, server)


@pytest.mark.momentary("it is refused before anything is claimed")
def test_a_node_serves_or_calls_a_name_not_both() -> None:
    world = row()
    member = world.members[ROBOT]
    topic = world.topic(SERVICE, member, [Right.CALL, Right.SERVE], kind="service")
    member.serve(topic, b"")
    with pytest.raises(LocalError, match="in use"):
        member.call(topic, b"")
    member.withdraw(topic.name)
    member.call(topic, b"")


def test_two_hundred_calls_at_once_are_all_answered_once() -> None:
    world = row()
    server, client = pair(world)
    for number in range(200):
        client.stream.publish(b"%d" % number)
    client.publish(b"last")
    assert work(world, server, client, until_s=5, have=201)
    world.network.run(1)
    answered = sorted(client.bodies())
    assert answered == sorted([b"%d by nuc5/server" % number for number in range(200)] + [b"last by nuc5/server"])
    outlive(world, client, server)


@pytest.mark.momentary("the lease of a reader ends, that of its claim does not")
def test_a_client_that_was_cut_off_for_longer_than_its_lease_goes_on_and_loses_nothing() -> None:
    world = row(lease_s=ADVERTISEMENT.lease_s)
    server, client = pair(world)
    server.answer(client.member.name, b"before")
    assert work(world, client, until_s=2, have=1)
    world.leads[ROBOT].loss = 1.0
    server.answer(client.member.name, b"meanwhile")
    world.network.run(READER.lease_s + 3)
    world.leads[ROBOT].loss = 0.0
    assert meet(world, server, client)
    server.answer(client.member.name, b"after")
    assert work(world, client, until_s=3, have=3)
    assert client.bodies() == [b"before", b"meanwhile", b"after"]
    assert sum(writer_proxy.losses.total for writer_proxy in client.member.subscriptions.writer_proxies()) == 0


def test_a_client_whose_advertisement_ended_meanwhile_goes_on_and_counts_what_it_lost() -> None:
    world = row()
    server, client = pair(world)
    server.answer(client.member.name, b"before")
    assert work(world, client, until_s=2, have=1)
    world.leads[ROBOT].loss = 1.0
    server.answer(client.member.name, b"meanwhile")
    world.network.run(READER.lease_s + 3)
    world.leads[ROBOT].loss = 0.0
    assert meet(world, server, client)
    server.answer(client.member.name, b"after")
    assert work(world, client, until_s=3, have=2)
    assert client.bodies() == [b"before", b"after"]
    assert sum(writer_proxy.losses.total for writer_proxy in client.member.subscriptions.writer_proxies()) == 1
    outlive(world, client, server)


def test_a_narrower_path_lets_answers_go_in_smaller_frames() -> None:
    world = row()
    server, client = pair(world)
    world.network.set_mtu(world.leads[ROBOT], 900)
    world.network.run(1)
    server.answer(client.member.name, bytes(5_000))
    assert work(world, client, until_s=2, have=1)
    outlive(world, client, server)


def test_an_unused_unicast_stream_is_forgotten_and_goes_on_above_its_numbers() -> None:
    world = row(lease_s=20.0, keepalive_ms=2_000)  # no link fails, and much time passes
    server, client = pair(world)
    server.answer(client.member.name, b"1")
    assert work(world, client, until_s=2, have=1)
    streams = server.member.publications._private[server.service]
    assert len(streams) == 1
    world.network.run(1)
    (writer_proxy,) = [
        writer_proxy
        for writer_proxy in client.member.subscriptions.writer_proxies()
        if writer_proxy not in client.member.subscriptions.writer_proxies_of(client.service)
    ]
    writer_proxy.schedule.due_s = float("inf")  # it sends nothing any more
    world.network.run(READER.lease_s + 1.5 * FORGET_S)
    assert len(streams) == 0
    server.answer(client.member.name, b"2")
    assert work(world, client, until_s=2, have=2)
    assert [each.delivered.number for each in client.got] == [1, 2]


def test_withdrawn_and_served_again_goes_on_above_all_numbers_with_another_description() -> None:
    world = row()
    server, client = pair(world)
    server.publish(b"news 1")
    server.answer(client.member.name, b"answer 1")
    assert work(world, client, until_s=2, have=2)
    server.member.withdraw(server.service)
    topic = world.topic(SERVICE, server.member, [Right.SERVE], kind="service")
    server.stream = server.member.serve(topic, b"another description")
    assert meet(world, server, client)
    world.network.run(1)
    server.publish(b"news 2")
    server.answer(client.member.name, b"answer 2")
    assert work(world, client, until_s=2, have=4)
    news = [each.delivered.number for each in client.got if not each.private]
    answers = [each.delivered.number for each in client.got if each.private]
    assert (news, answers) == ([1, 2], [1, 2])
    assert {each.description for each in client.got[2:]} == {b"another description"}
    outlive(world, client, server)


def test_a_change_of_secrets_reaches_private_streams() -> None:
    world = row()
    server, client = pair(world)
    for party in (server, client):
        topic = world.topic(SERVICE, party.member, [party.right], kind="service")
        party.member.renew(type(topic)(topic.delegation, {1: topic.secrets[1], 2: bytes(32)}))
    client.publish(b"?")
    assert work(world, server, client, until_s=2, have=1)
    outlive(world, client, server)


def test_calls_go_on_while_the_client_roams() -> None:
    world = row()
    server, client = pair(world)
    for number in range(40):
        world.network.call(0.1 * number, lambda: client.publish(b"?"))
    world.network.call(1.55, lambda: world.roam(ROBOT, "nuc2"))
    assert work(world, server, client, until_s=20, have=40)
    assert len(client.bodies()) == 40
    outlive(world, client, server)


def test_a_running_action_goes_on_while_its_client_roams() -> None:
    world = row()
    server, client = pair(world)
    server.answers = False
    client.publish(b"goal")
    assert world.network.run(2, lambda: bool(server.collect()))
    steps = [b"feedback %d" % number for number in range(60)]
    for number, step in enumerate(steps):
        world.network.call(0.1 * number, partial(server.publish, step))
    world.network.call(1.55, lambda: world.roam(ROBOT, "nuc2"))
    world.network.call(6.0, lambda: server.answer(client.member.name, b"result"))
    assert work(world, client, until_s=20, have=61)
    assert [each.delivered.message for each in client.got if not each.private] == steps
    assert [each.delivered.message for each in client.got if each.private] == [b"result"]
    outlive(world, client, server)


def test_a_client_whose_delegation_is_revoked_is_answered_no_more() -> None:
    world = row()
    server, client = pair(world)
    delegation = world.topic(SERVICE, client.member, [Right.CALL], kind="service").delegation
    pending_advertisement = next(each for each in client.member.attachment.advertisements if each.right is Right.CALL)
    link = AdCert.from_statement(parse(pending_advertisement.chain[0]))
    world.switches["nuc5"].revoke(
        world.owner.revoke(delegation.subject, link.fingerprint, link.validity.not_after_unix_s), world.network.now
    )
    world.network.send_pending("nuc5")
    assert world.network.run(1, lambda: not server.member.services.peers(server.service))
    with pytest.raises(LocalError, match="is not heard"):
        server.answer(client.member.name, b"?")
    world.network.run(LEASES * world.lease_s)
    assert server.member.services.peers(server.service) == []


def test_calls_over_links_that_lose_and_reorder_are_all_answered_once() -> None:
    # An advertisement of seven frames crosses three such links half of the time: a lease has to last for many tries.
    world = row(lease_s=8.0)
    server, client = pair(world)
    for sim_link in [*world.cables.values(), *world.leads.values()]:
        sim_link.loss, sim_link.jitter_s = 0.03, 0.002
    for number in range(100):
        world.network.call(0.01 * number, partial(client.publish, b"%d" % number))
    assert work(world, server, client, until_s=30, have=100)
    world.network.run(1)
    assert sorted(client.bodies()) == sorted(b"%d by nuc5/server" % number for number in range(100))
    outlive(world, client, server)
