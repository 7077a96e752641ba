"""Several servers of one name: requests to all or to one, one copy on a shared path, and the cost of a dead one."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.client.unicast_stream import private_name
from gdp.client.writer_proxy import WriterProxyState
from gdp.errors import DropReason, LocalError
from gdp.frame.codec import Kind
from gdp.intervals import READER, SERVER
from gdp.limits import PRIVATE_WAIT_BYTES
from gdp.names import Name
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology, chain
from tests.journeys.flows import LEASE_S, LEASES, Tap
from tests.journeys.services import Party, meet, outlive, work
from tests.lanes import nightly

CLIENT = "s1/left"
SERVERS = ("s3/a", "s3/b", "s3/c")


def cluster(*labels: str, lease_s: float = LEASE_S) -> tuple[Simulation, Party, list[Party]]:
    """Return a client and servers that answer nothing at the other end of a chain, matched with each other."""
    world = Simulation(topology=chain(3), lease_s=lease_s)
    for label in labels:
        world.add_member(label, "s3")
    assert world.run_until_attached()
    servers = [Party(world, label, Right.SERVE, answers=False) for label in labels]
    client = Party(world, CLIENT, Right.CALL)
    assert meet(world, client, *servers)
    return world, client, servers


def ask(client: Party, server: Party, message: bytes) -> None:
    client.member.services.send_request(client.service, server.member.name, message)
    client.world.network.send_pending(client.label)


class Load:
    """Numbered requests at a steady rate to all servers, and the arrival times at each."""

    def __init__(self, client: Party, servers: list[Party], *, size: int) -> None:
        self._network = client.world.network
        self._client = client
        self._servers = servers
        self._size = size
        self._sent_s: list[float] = []
        self.waits_s: dict[str, dict[int, float]] = {server.label: {} for server in servers}

    def send(self, count: int) -> None:
        for _ in range(count):
            number = len(self._sent_s)
            self._sent_s.append(self._network.now.mono_s)
            self._client.stream.publish(number.to_bytes(4, "big") + bytes(self._size))
        self._client._flush()

    def look(self) -> None:
        for server in self._servers:
            for each in server.member.poll_messages():
                number = int.from_bytes(each.delivered.message[:4], "big")
                waited_s = self._network.now.mono_s - self._sent_s[number]
                assert self.waits_s[server.label].setdefault(number, waited_s) == waited_s

    def run(self, for_s: float, *, per_s: int, every_s: float = 0.01) -> None:
        """Advance time under load, and half a second without."""
        steps = round(for_s / every_s)
        for step in range(steps):
            self._network.call(step * every_s, partial(self.send, round(per_s * every_s)))
        for step in range(round((for_s + 0.5) / every_s)):
            self._network.call((step + 0.5) * every_s, self.look)
        self._network.run(for_s + 0.5)
        self.look()

    def worst_s(self, label: str) -> float:
        return max(self.waits_s[label].values())


def test_a_request_to_one_server_reaches_that_one_alone_and_at_once() -> None:
    world, client, (one, other) = cluster(*SERVERS[:2])
    tap = Tap("s3", other.label)
    world.network.taps.append(tap)
    ask(client, one, b"only you")
    assert work(world, one, until_s=0.05, have=1)
    (got,) = one.got
    assert (got.topic, got.private, got.description) == (client.service, True, b"call by s1/left")
    assert (Name(got.delivered.publisher), got.delivered.message) == (client.member.name, b"only you")
    world.network.run(1)
    assert (other.bodies(), tap.count(Kind.DATA)) == ([], 0)
    outlive(world, client, one, other)


@pytest.mark.parametrize("first", [Right.SERVE, Right.CALL])
@pytest.mark.parametrize("lossy", [False, True])
def test_a_request_to_a_server_that_has_just_become_a_peer_is_not_lost(first: Right, *, lossy: bool) -> None:
    world = Simulation(topology=chain(3), lease_s=LEASE_S)
    assert world.run_until_attached()
    if lossy:
        for sim_link in world.cables.values():
            sim_link.loss, sim_link.jitter_s = 0.1, 0.002
    labels = {Right.SERVE: "s3/right", Right.CALL: CLIENT}
    rights = sorted(labels, key=lambda right: right is not first)
    parties = {right: Party(world, labels[right], right) for right in rights}
    client, server = parties[Right.CALL], parties[Right.SERVE]
    assert world.network.run(30, lambda: bool(client.member.services.peers(client.service)))
    ask(client, server, b"first")
    assert work(world, server, client, until_s=5 if lossy else 0.05, have=1)
    assert client.bodies() == [b"first by s3/right"]
    outlive(world, client, server)


def test_requests_to_one_server_are_complete_and_in_order_over_links_that_lose() -> None:
    world, client, (one, _) = cluster(*SERVERS[:2])
    for sim_link in world.cables.values():
        sim_link.loss, sim_link.jitter_s = 0.05, 0.002
    sent = [b"%d" % number * 700 for number in range(100)]
    for message in sent:
        ask(client, one, message)
    assert work(world, one, until_s=20, have=100)
    assert one.bodies() == sent
    outlive(world, client, one)


@pytest.mark.momentary("it is refused at once")
def test_who_is_not_heard_cannot_be_asked() -> None:
    world, client, (one, _) = cluster(*SERVERS[:2])
    with pytest.raises(LocalError, match="is not heard"):
        client.member.services.send_request(client.service, world.members["s3/right"].name, b"?")
    with pytest.raises(LocalError, match="no call of"):
        one.member.services.send_request(client.service, client.member.name, b"?")
    with pytest.raises(LocalError, match="no serve of"):
        client.member.services.respond(client.service, one.member.name, b"?")
    gone = one.member.name
    one.member.withdraw(one.service)
    world.network.send_pending(one.label)
    assert world.network.run(1, lambda: len(client.member.subscriptions.writer_proxies_of(client.service)) == 1)
    with pytest.raises(LocalError, match="is not heard"):
        client.member.services.send_request(client.service, gone, b"?")


def test_requests_to_a_former_life_of_a_server_do_not_reach_the_new_one() -> None:
    world, client, (one,) = cluster(SERVERS[0])
    ask(client, one, b"to the first life")
    assert work(world, one, until_s=1, have=1)
    world.network.stop(one.label)
    ask(client, one, b"to unknown")
    world.network.run(0.1)
    world.restart_member(one.label)
    one.got.clear()
    one.begin()
    assert world.network.run(1, lambda: one.member.services.peers(one.service) == [client.member.name])
    assert world.network.run(1, lambda: client.member.services.peers(client.service) == [one.member.name])
    ask(client, one, b"to the second life")
    assert work(world, one, until_s=1, have=1)
    world.network.run(2)
    assert one.bodies() == [b"to the second life"]
    outlive(world, client, one)


def test_what_a_client_may_ask_before_it_has_said_what_its_requests_are_is_bounded() -> None:
    world, client, (one,) = cluster(SERVERS[0])
    (public,) = one.member.subscriptions.writer_proxies_of(one.service)
    public.state = WriterProxyState.NEW  # as if its first Heartbeat had been lost
    public.schedule.due_s = float("inf")
    messages = 40
    for number in range(messages):
        ask(client, one, bytes([number]) * 20_000)
    world.network.run(2)
    (private,) = [
        writer_proxy for writer_proxy in one.member.subscriptions.writer_proxies() if writer_proxy is not public
    ]
    assert private.delivery.delivered * 20_000 <= PRIVATE_WAIT_BYTES + 20_000
    assert private.drops[DropReason.MEMORY_FULL] > 0
    public.schedule.due_s = world.network.now.mono_s
    public.state = WriterProxyState.LIVE
    client.publish(b"?")
    assert work(world, one, until_s=5, have=messages + 1)
    assert [each.delivered.message[0] for each in one.got if each.private] == list(range(messages))
    outlive(world, client, one)


@pytest.mark.momentary("two names are compared, nothing is sent")
def test_the_two_directions_of_two_nodes_are_two_streams() -> None:
    _, client, (one,) = cluster(SERVERS[0])
    (writer_proxy,) = client.member.subscriptions.writer_proxies_of(client.service)
    (back,) = one.member.subscriptions.writer_proxies_of(one.service)
    server, caller = ((each.publisher, each.incarnation) for each in (writer_proxy, back))
    assert len({private_name(client.service, *ends) for ends in ((server, caller), (caller, server))}) == 2  # type: ignore[arg-type]


@pytest.mark.parametrize("kill", [False, *nightly(True)])
def test_a_frozen_or_dead_server_holds_up_no_other_and_is_no_peer_after_a_second(*, kill: bool) -> None:
    world, client, servers = cluster(*SERVERS)
    *healthy, victim = servers
    load = Load(client, servers, size=100)
    world.network.call(1.0, partial(world.network.stop if kill else world.network.freeze, victim.label))
    listed: list[int] = []
    for late_s in (-0.1, READER.refresh_s + 0.1):
        world.network.call(1.0 + late_s, lambda: listed.append(len(client.member.services.peers(client.service))))
    load.run(4, per_s=2_000)
    assert listed == [3, 2]
    for server in healthy:
        assert len(load.waits_s[server.label]) == 8_000
        assert load.worst_s(server.label) <= READER.refresh_s
    outlive(world, client, *healthy)


def test_large_requests_wait_for_a_frozen_server_no_longer_than_its_lag() -> None:
    world, client, servers = cluster(*SERVERS)
    load = Load(client, servers, size=10_000)
    world.network.call(0.2, partial(world.network.freeze, SERVERS[2]))
    load.run(2, per_s=500, every_s=0.02)
    for label in SERVERS[:2]:
        assert len(load.waits_s[label]) == 1_000
        assert load.worst_s(label) <= READER.refresh_s + 0.1
    outlive(world, client, *servers[:2])


def test_two_of_three_servers_may_freeze_at_once() -> None:
    world, client, servers = cluster(*SERVERS)
    load = Load(client, servers, size=100)
    for label in SERVERS[1:]:
        world.network.call(0.5, partial(world.network.freeze, label))
    load.run(3, per_s=1_000)
    assert len(load.waits_s[SERVERS[0]]) == 3_000
    assert load.worst_s(SERVERS[0]) <= READER.refresh_s
    assert client.member.services.peers(client.service) == [servers[0].member.name]
    outlive(world, client, servers[0])


def test_a_server_that_thaws_continues_with_new_requests_and_delays_no_other() -> None:
    world, client, servers = cluster(*SERVERS)
    load = Load(client, servers, size=3_000)
    frozen = servers[2]
    world.network.call(0.5, partial(world.network.freeze, frozen.label))
    world.network.call(2.5, partial(world.network.thaw, frozen.label))
    load.run(5, per_s=500, every_s=0.02)
    assert len(client.member.services.peers(client.service)) == 3
    for label in SERVERS[:2]:
        assert len(load.waits_s[label]) == 2_500
        assert load.worst_s(label) <= READER.refresh_s
    after = [number for number in load.waits_s[frozen.label] if number >= 2_000]  # from a second and a half after it
    assert after == list(range(2_000, 2_500))
    outlive(world, client, *servers)


def test_a_silent_server_is_no_peer_even_without_requests() -> None:
    world, client, (heard, silent) = cluster(*SERVERS[:2])
    world.network.run(3)
    assert len(client.member.services.peers(client.service)) == 2
    world.network.stop(silent.label)
    assert world.network.run(SERVER.lease_s + 0.3, lambda: len(client.member.services.peers(client.service)) == 1)
    outlive(world, client, heard)


@pytest.mark.momentary("it is about the first moment after a pause")
def test_a_client_that_had_no_time_does_not_take_its_servers_for_silent() -> None:
    world, client, _ = cluster(*SERVERS[:2])
    world.network.freeze(client.label)
    world.network.run(SERVER.lease_s + 1)
    client.member.handle_timer(world.network.now)  # before it has read the messages of that time
    assert len(client.member.services.peers(client.service)) == 2


def test_the_only_server_keeps_its_requests_as_long_as_ever() -> None:
    world, client, servers = cluster(SERVERS[0])
    world.network.call(0.5, partial(world.network.freeze, SERVERS[0]))
    world.network.call(4.5, partial(world.network.thaw, SERVERS[0]))
    load = Load(client, servers, size=100)
    load.run(5, per_s=100)
    assert len(load.waits_s[SERVERS[0]]) == 500
    outlive(world, client, *servers)


def test_a_restarted_server_is_a_peer_again_as_soon_as_it_is_there() -> None:
    world, client, servers = cluster(*SERVERS, lease_s=10.0)
    load = Load(client, servers, size=100)
    again = servers[2]
    world.network.call(0.5, partial(world.network.stop, again.label))
    load.run(2, per_s=100)
    world.restart_member(again.label)
    again.begin()
    assert world.network.run(0.1, lambda: len(client.member.services.peers(client.service)) == 3)
    client.publish(b"once more")
    assert work(world, again, until_s=0.1, have=1)
    assert again.bodies() == [b"once more"]
    outlive(world, client, *servers)


@pytest.mark.parametrize("replicas", [4, *nightly(1, 2)])
def test_the_clients_link_carries_one_copy_of_a_request_whatever_the_number_of_servers(replicas: int) -> None:
    names = [f"r{number}" for number in range(replicas)]
    world = Simulation(
        topology=Topology(
            links=(Link("robot", "gateway"), *(Link("gateway", name) for name in names)),
            domains=(DomainPlan("one", ("robot", "gateway", *names)),),
            attachments=(
                Attachment("gateway", "rib", "rib"),
                Attachment("robot", "proxy", "proxy"),
                *(Attachment(name, "proxy", "proxy") for name in names),
            ),
        ),
        lease_s=LEASE_S,
    )
    assert world.run_until_attached()
    servers = [Party(world, f"{name}/proxy", Right.SERVE, answers=False) for name in names]
    client = Party(world, "robot/proxy", Right.CALL)
    assert meet(world, client, *servers)
    client.stream.queue.bundle_bytes = 0
    uplink, branches = Tap("robot", "gateway"), [Tap("gateway", name) for name in names]
    world.network.taps += [uplink, *branches]
    for number in range(200):
        world.network.call(number * 0.01, partial(client.publish, bytes(10_000)))
    world.network.run(3)
    assert [len(server.bodies()) for server in servers] == [200] * replicas
    parts = 8  # of 10,000 bytes over 1,500
    assert [tap.count(Kind.DATA) for tap in (uplink, *branches)] == [200 * parts] * (1 + replicas)
    outlive(world, client, *servers)


@pytest.mark.parametrize("seed", [22, *nightly(28, 29, 34)])
def test_a_new_server_is_a_peer_at_once_though_its_advertisements_and_questions_about_it_overtake_each_other(
    seed: int,
) -> None:
    star = Topology(
        links=(Link("r", "g"), Link("g", "m1"), Link("g", "m2")),
        domains=(DomainPlan("d", ("r", "g", "m1", "m2")),),
        attachments=(Attachment("r", "rib", "rib"),),
    )
    world = Simulation(topology=star, seed=seed)
    for sim_link in world.cables.values():
        sim_link.jitter_s = 0.003
    for label in ("r/proxy", "r/watch", "m1/old"):
        world.add_member(label, label.partition("/")[0])
    spare = world.cables[frozenset(("g", "m2"))]
    world.network.set_link(spare, up=False)
    assert world.run_until_attached()
    clients = [Party(world, label, Right.CALL) for label in ("r/proxy", "r/watch")]
    old = Party(world, "m1/old", Right.SERVE).member.name
    assert world.network.run(10.0, lambda: all(old in each.member.services.peers(each.service) for each in clients))
    world.network.set_link(spare, up=True)
    world.network.run(0.6)
    world.add_member("m2/new", "m2")
    name = Party(world, "m2/new", Right.SERVE).member.name
    assert world.network.run(1.0, lambda: all(name in each.member.services.peers(each.service) for each in clients))
    world.network.run(LEASES * world.lease_s)
    assert all({name, old} <= set(each.member.services.peers(each.service)) for each in clients)
