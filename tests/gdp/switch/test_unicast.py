"""Unicast routes in a running network: resolved on demand, negative if there is none, never in a tree's way."""

from __future__ import annotations

from collections.abc import Sequence
from unittest.mock import patch

from gdp.errors import DropReason
from gdp.frame.codec import Flag, Header, Kind, decode, encode
from gdp.intervals import NEGATIVE_LEASE_S
from gdp.limits import HOPS_MAX
from gdp.names import Name
from gdp.sansio import ReceivedFrame, Timestamps
from gdp.switch.table import NOWHERE
from gdp.switch.unicast import _Installed
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, flowing, row
from tests.visited import visited

ABSENT = Name(b"?" * 32)
FILES_OF_A_MISS = 9  # all that run in the calls that carry it; it only falls


def send(world: Simulation, destination: Name, source: str = ROBOT, kind: int = Kind.ACKNACK) -> None:
    """Let a member send a frame to a name."""
    member = world.members[source]
    frame = encode(Header(kind, Flag.LAST, HOPS_MAX, 1, 0, 1, 0, 1, 9, destination, member.name))
    member.attachment.send([frame])
    world.network.send_pending(source)


def test_an_unadvertised_name_is_answered_and_then_dropped_by_the_data_plane() -> None:
    world = row()
    robot, nuc1 = world.members[ROBOT].name, world.switches["nuc1"]
    send(world, ABSENT)
    assert len(nuc1.resolver.pending) == 0
    world.network.run(0.1)
    send(world, ABSENT)
    world.network.run(0.01)
    assert nuc1.table.entries[ABSENT + robot] == NOWHERE
    world.network.run(NEGATIVE_LEASE_S + 0.5)
    assert ABSENT + robot not in nuc1.table.entries


def test_a_frame_waits_while_its_destination_is_asked_for() -> None:
    world = row()
    send(world, ABSENT)
    world.network.run(0.0005)
    assert len(world.switches["nuc1"].resolver.pending) == 1


def test_who_attaches_where_it_was_missed_is_reached_at_once() -> None:
    world = row()
    nuc1 = world.switches["nuc1"]
    late = world.add_member("nuc1/late", "nuc1")
    for _ in range(3):
        send(world, late.name)
        world.network.run(0.0002)
    world.network.run(1.0, lambda: late.attachment.is_attached)
    send(world, late.name)
    world.network.run(0.01)
    assert nuc1.table.entries[late.name] != NOWHERE
    assert late.name + world.members[ROBOT].name not in nuc1.table.entries


def test_who_is_found_is_reached_though_it_was_missed_a_moment_ago() -> None:
    world = row()
    nuc1, robot = world.switches["nuc1"], world.members[ROBOT].name
    server = world.members[SERVER].name
    nuc1.unicast._install_negative(server, robot, DropReason.NO_ROUTE, world.network.now.mono_s)
    assert nuc1.table.entries[server + robot] == NOWHERE
    nuc1.resolver.resolve(server, world.network.now.mono_s)
    world.network.send_pending("nuc1")
    world.network.run(1.0)
    send(world, server)
    world.network.run(0.1)
    assert nuc1.table.entries[server + robot] != NOWHERE


def test_no_change_of_links_takes_down_a_tree_that_grew_where_nothing_was_read() -> None:
    world = row()
    flow = flowing(world)
    nuc1, robot = world.switches["nuc1"], world.members[ROBOT].name
    key = flow.topic.name + robot
    standing = nuc1.table.entries[key]
    nuc1.unicast._note(key, _Installed(flow.topic.name, robot, DropReason.NO_ROUTE))
    nuc1.unicast.refresh(world.network.now.mono_s)
    assert nuc1.table.entries[key] == standing
    nuc1.unicast._note(key, _Installed(flow.topic.name, robot, DropReason.NO_ROUTE))
    nuc1.unicast.remove(flow.topic.name)
    assert nuc1.table.entries[key] == standing


def test_what_is_remembered_of_entries_goes_with_them() -> None:
    world = row()
    nuc1 = world.switches["nuc1"]
    for _ in range(2):
        for number in range(200):
            send(world, Name(number.to_bytes(32, "big")))
        world.network.run(0.5)
    assert len(nuc1.unicast._installed) > 100
    world.network.run(10)
    assert all(not why.is_negative for why in nuc1.unicast._installed.values())
    assert set(nuc1.unicast._installed) == {key for keys in nuc1.unicast._keys_of.values() for key in keys}
    assert set(nuc1.unicast._installed) <= set(nuc1.table.entries)


def test_a_frame_that_misses_visits_few_files_until_it_is_released() -> None:
    world = row()
    nuc1, server, seen = world.switches["nuc1"], world.members[SERVER].name, set[str]()
    receive, send_queries = nuc1.receive, nuc1.rib_client.send_queries

    def received(arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        kinds = {decode(each.frame).kind for each in arrivals}
        is_of_it = kinds & {Kind.ACKNACK, Kind.RIB_ANSWER}
        visited("switch", seen if is_of_it else set(), lambda: receive(arrivals, now))

    with (
        patch.object(nuc1, "receive", received),
        patch.object(
            nuc1.rib_client, "send_queries", lambda now_s: visited("switch", seen, lambda: send_queries(now_s))
        ),
    ):
        send(world, server)
        world.network.run(0.0005)
        assert len(nuc1.resolver.pending) == 1
        assert world.network.run(1.0, lambda: not len(nuc1.resolver.pending))
    assert nuc1.table.entries[server + world.members[ROBOT].name]
    assert len(seen) <= FILES_OF_A_MISS, sorted(seen)


def test_a_frame_enters_once_and_its_path_is_resolved_once_for_all_that_wait_for_it() -> None:
    world = row()
    nuc1, robot, server = world.switches["nuc1"], world.members[ROBOT].name, world.members[SERVER].name
    unicast = nuc1.unicast
    with (
        patch.object(unicast, "forward", wraps=unicast.forward) as entered,
        patch.object(unicast, "_resolve", wraps=unicast._resolve) as resolved,
    ):
        for _ in range(3):
            send(world, server)
        world.network.run(0.0005)
        assert len(nuc1.resolver.pending) == 3
        assert world.network.run(1.0, lambda: not len(nuc1.resolver.pending))
    assert sum(len(call.args[2]) for call in entered.call_args_list if call.args[:2] == (server, robot)) == 3
    assert [call.args[:2] for call in resolved.call_args_list].count((server, robot)) == 3 + 1  # arrivals, the release
