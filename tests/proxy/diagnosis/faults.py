"""The injected faults: how each comes about, and the cause that names it.

Each fault changes a stage before the two proxies start, or after messages flow. ``core``: into the real protocol cores
on the network in memory. ``facts``: one fact of a node was replaced, because the fault lies outside the cores.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from gdp.crypto.certificates import Role
from gdp.crypto.validity import Validity
from gdp.diagnosis.answer import Cause
from gdp.diagnosis.facts import Facts, RosProcess, TunnelFact, WaitFact
from gdp.sansio import OutgoingFrames, ProtocolCore, ReceivedFrame, Timestamps
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from lab.topology import Attachment, DomainPlan, Link, Topology
from proxy.endpoints.core.qos import default
from tests.proxy.bridge import known
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switched
from tests.proxy.bridge.sites import Ear, named, revocation_of
from tests.proxy.diagnosis.stage import CHATTER, ROBOT, SERVER, Stage, unreachable, with_waits
from tests.proxy.endpoints.fake import FakeGraph

__all__ = ["FAULTS", "Fault"]

SWITCH: Final = f"kind: service, name: /switch, type: {SET_BOOL}"


class Fault(NamedTuple):
    """One fault.

    Args:
        title: as in the table of the documentation.
        inject: builds the stage in an empty folder, with the fault in it.
        how: where it is injected.
        asked: the name that is typed at the reader's machine.
    """

    title: str
    cause: Cause
    how: Literal["core", "facts"]
    inject: Callable[[Path], Stage]
    asked: str = "/chatter"


def _plain(folder: Path, out: str | None = CHATTER, into: str | None = CHATTER, run_s: float = 10.0) -> Stage:
    """Return a stage with a talker and a listener that had time to find each other."""
    stage = Stage(folder).add(out, into)
    stage.listen()
    stage.talk()
    stage.run(run_s)
    return stage


def _flowing(folder: Path, **options: Any) -> Stage:
    stage = Stage(folder, **options).add()
    stage.flow(for_s=120.0)
    return stage


def not_exposed(folder: Path) -> Stage:
    return _plain(folder, out=None)


def other_type(folder: Path) -> Stage:
    stage = Stage(folder).add(into="name: /chatter, type: std_msgs/msg/Int32")
    Ear(stage.server.graph, "/chatter", "std_msgs/msg/Int32")
    stage.talk()
    stage.run(10)
    return stage


def other_metadata(folder: Path) -> Stage:
    return _plain(folder, into=f"{CHATTER}, metadata: {{site: hall-b}}")


def other_owner(folder: Path) -> Stage:
    return _plain(folder, into=f"{CHATTER}, owner: other.pub")


def no_publisher(folder: Path) -> Stage:
    stage = Stage(folder).add()
    stage.listen()
    stage.run(10)
    return stage


def publisher_left(folder: Path) -> Stage:
    stage = Stage(folder).add()
    talker = stage.talk()
    stage.listen()
    stage.run(5)
    talker.close()
    stage.run(10)
    return stage


def publisher_silent(folder: Path) -> Stage:
    stage = Stage(folder).add()
    stage.listen()
    stage.talk(for_s=0)
    stage.run(20)
    return stage


def no_read_right(folder: Path) -> Stage:
    stage = Stage(folder)
    stage.sites.add(ROBOT, expose=[CHATTER])
    stage.sites.add(SERVER, imports=[CHATTER], holds=[])
    stage.listen()
    stage.talk()
    stage.run(10)
    return stage


def no_publish_right(folder: Path) -> Stage:
    stage = Stage(folder)
    stage.sites.add(ROBOT, expose=[CHATTER], holds=[])
    stage.sites.add(SERVER, imports=[CHATTER])
    stage.listen()
    stage.talk()
    stage.run(10)
    return stage


def wrong_right(folder: Path) -> Stage:
    stage = Stage(folder)
    stage.sites.add(ROBOT, expose=[CHATTER])
    machine = stage.sites.add(SERVER, imports=[CHATTER], holds=[])
    topic = stage.sites._topic(machine.member, named("/chatter"), {Right.PUBLISH})
    machine.bridge.held._topics[topic.name] = topic
    machine.bridge.reload(machine.bridge.rules, machine.bridge.held)
    stage.listen()
    stage.talk()
    stage.run(10)
    return stage


def delegation_expired(folder: Path) -> Stage:
    stage = Stage(folder)
    world = stage.sites.world
    whole, now_s = world.validity, int(world.network.now.unix_s)
    stage.sites.add(ROBOT, expose=[CHATTER])
    world.identity(Role.PROXY, SERVER, "line")
    world.validity = Validity(whole.not_before_unix_s, now_s - 3_600 + 40)
    stage.sites.add(SERVER, imports=[CHATTER])
    world.validity = whole
    stage.listen()
    stage.talk(for_s=200, hz=1)
    stage.run(100)
    return stage


def delegation_revoked(folder: Path) -> Stage:
    stage = _flowing(folder)
    topic = stage.server.bridge.held.get(next(each.topic for each in stage.server.member.subscriptions).name)
    assert topic is not None
    world = stage.sites.world
    _revoke(stage, revocation_of(world, topic))
    stage.run(70)
    return stage


def membership_revoked(folder: Path) -> Stage:
    stage = _flowing(folder)
    world = stage.sites.world
    authority, member = world.authorities["line"], world.identities[SERVER].member
    until = int(world.network.now.unix_s) + 100_000
    _revoke(stage, Revocation.make(authority.key, authority.root.subject, member.fingerprint, until))
    stage.run(20)
    return stage


def membership_expired(folder: Path) -> Stage:
    stage = Stage(folder)
    world = stage.sites.world
    whole, now_s = world.validity, int(world.network.now.unix_s)
    stage.sites.add(ROBOT, expose=[CHATTER])
    world.validity = Validity(whole.not_before_unix_s, now_s - 3_600 + 40)
    world.identity(Role.PROXY, SERVER, "line")
    world.validity = whole
    stage.sites.add(SERVER, imports=[CHATTER])
    stage.listen()
    stage.talk(for_s=200, hz=1)
    stage.run(100)
    return stage


def key_epoch(folder: Path) -> Stage:
    stage = _flowing(folder)
    machine = stage.robot
    name = machine.stream.topic
    topic = machine.bridge.held.get(name)
    assert topic is not None
    machine.bridge.held._topics[name] = replace(topic, secrets={**topic.secrets, 2: bytes(range(32))})
    machine.bridge.reload(machine.bridge.rules, machine.bridge.held)
    stage.run(15)
    return stage


def clock_off(folder: Path) -> Stage:
    ahead_s = 3 * 86_400.0
    stage = Stage(folder, offsets_s={SERVER: ahead_s})
    stage.sites.add(ROBOT, expose=[CHATTER])
    stage.sites.add(SERVER, imports=[CHATTER])
    network = stage.sites.world.network
    node = network._nodes[SERVER]
    node.machine = ClockAhead(node.machine, ahead_s)
    network.set_link(stage.sites.world.leads[SERVER], up=False)
    network.set_link(stage.sites.world.leads[SERVER], up=True)
    stage.listen()
    stage.talk(for_s=60)
    stage.run(30)
    return stage


def qos_deadline(folder: Path) -> Stage:
    stage = Stage(folder).add()
    stage.listen(qos=replace(default(), deadline=(0, 100_000_000)))
    stage.talk()
    stage.run(10)
    return stage


def qos_best_effort(folder: Path) -> Stage:
    stage = Stage(folder).add(f"{CHATTER}, repair: never, fec: never, reliable: false")
    stage.listen(qos=default())
    stage.talk(qos=default(reliable=False), hz=50)
    stage.run(10)
    stage.sites.world.leads[SERVER].loss = 0.3  # of 50 messages in the window many, whatever is drawn
    stage.run(5)
    return stage


def qos_volatile(folder: Path) -> Stage:
    stage = Stage(folder).add()
    talker = stage.talk(for_s=0, qos=default())
    stage.run(5)
    talker.publish(string("once"))
    stage.run(30)
    stage.listen(qos=default(latched=True))
    stage.run(10)
    return stage


def rate_limit(folder: Path) -> Stage:
    return _plain(folder, out=f"{CHATTER}, max_hz: 0.01")


def deadline(folder: Path) -> Stage:
    out = f"name: /chatter, type: {STRING}, reliable: false, deadline_ms: 5, encoding: cdr"
    stage = Stage(folder).add(out)
    stage.listen()
    stage.sites.world.leads[ROBOT].bytes_s = 200_000
    stage.talk(hz=20, size=100_000)
    stage.run(10)
    return stage


def bit_rate(folder: Path) -> Stage:
    stage = Stage(folder).add(f"{CHATTER}, max_bits_s: 2000, reliable: false, deadline_ms: 100")
    stage.listen()
    stage.talk(hz=50, size=1_000)
    stage.run(10)
    return stage


def too_large(folder: Path) -> Stage:
    stage = Stage(folder).add(f"{CHATTER}, max_bytes: 100")
    stage.listen()
    stage.talk(size=500)
    stage.run(10)
    return stage


def without_control(folder: Path) -> Stage:
    stage = Stage(folder).add(into=f"{CHATTER}, control: exclusive")
    stage.listen()
    stage.talk()
    stage.run(10)
    return stage


def no_route(folder: Path) -> Stage:
    return _plain_with(folder, options={"leaves": ("s2",)}, rib_at="s2")


def untrusted_domain(folder: Path) -> Stage:
    topology = Topology(
        (Link("s1", "s2"), Link("s2", "s3")),
        (DomainPlan("line", ("s2", "s3")), DomainPlan("other", ("s1",))),
        (Attachment("s2", "rib", "rib"), Attachment("s1", "rib", "rib")),
    )
    stage = Stage(folder, topology=topology, options={"trusts": {"line": ("line",), "other": ("other",)}})
    stage.add()
    stage.listen()
    stage.talk()
    stage.run(15)
    return stage


def mtu_hole(folder: Path) -> Stage:
    stage = Stage(folder).add()
    _narrow(stage, "s2", "s3", 900)
    stage.listen()
    stage.talk(size=4_000)
    stage.run(15)
    return stage


def mtu_hole_for_messages(folder: Path) -> Stage:
    stage = Stage(folder).add()
    stage.listen()
    stage.talk(size=4_000)
    stage.run(10)
    _narrow(stage, "s2", "s3", 1_300)
    stage.run(15)
    return stage


def interface_down(folder: Path) -> Stage:
    stage = _flowing(folder)
    stage.sites.world.network.set_link(stage.sites.world.leads[SERVER], up=False)
    stage.run(20)
    return stage


def far_interface_down(folder: Path) -> Stage:
    stage = _flowing(folder)
    stage.sites.world.network.set_link(stage.sites.world.cables[frozenset(("s1", "s2"))], up=False)
    stage.run(60)
    return stage


def ethertype_filtered(folder: Path) -> Stage:
    stage = _flowing(folder)
    stage.sites.world.cables[frozenset(("s1", "s2"))].loss = 1.0
    stage.run(60)
    return stage


def rib_away(folder: Path) -> Stage:
    stage = Stage(folder).add()
    stage.stop_rib()
    stage.listen()
    stage.talk()
    stage.run(60)
    return stage


def switch_away(folder: Path) -> Stage:
    stage = _flowing(folder)
    stage.stop("s3")
    stage.more = {"unreachable": unreachable("switch", "s3")}
    stage.run(30)
    return stage


def far_switch_away(folder: Path) -> Stage:
    stage = _flowing(folder)
    stage.stop("s1")
    stage.run(60)
    return stage


def proxy_away(folder: Path) -> Stage:
    stage = _flowing(folder, options={"lease_s": 20.0})
    stage.kill_proxy(stage.robot)
    stage.run(60)
    return stage


def quota(folder: Path) -> Stage:
    stage = Stage(folder)
    rib = stage.sites.world.ribs["line"].rib
    rib.state.settings = replace(rib.state.settings, names_per_sender=2)
    stage.add(into=CHATTER)
    rib.state.settings = replace(rib.state.settings, names_per_sender=1)
    stage.listen()
    stage.talk()
    stage.run(10)
    return stage


def rival_proxy(folder: Path) -> Stage:
    stage = Stage(folder)
    graph = FakeGraph(2, known.channels(2), known.services(2))
    labels = sorted((ROBOT, "s1/rival"), key=lambda label: stage.sites.name(label).to_text())
    first, second = labels
    for label in (first, second):
        stage.sites.add(label, expose=[CHATTER], graph=graph)
        stage.run(3)
    stage.sites.add(SERVER, imports=[CHATTER])
    stage.listen()
    graph.publish("/talker", "/chatter", STRING)
    stage.run(10)
    stage.asks_at = second
    return stage


def type_support_missing(folder: Path) -> Stage:
    stage = Stage(folder)
    stage.sites.add(ROBOT, expose=[CHATTER], graph=FakeGraph(2, {}, {}))
    stage.sites.add(SERVER, imports=[CHATTER])
    stage.listen()
    stage.talk()
    stage.run(10)
    return stage


def local_type_differs(folder: Path) -> Stage:
    stage = Stage(folder).add()
    stage.listen()
    stage.robot.graph.publish("/talker", "/chatter", "std_msgs/msg/Int32")
    stage.run(10)
    return stage


def no_reader(folder: Path) -> Stage:
    stage = Stage(folder).add()
    stage.talk()
    stage.run(10)
    return stage


def no_server(folder: Path) -> Stage:
    stage = Stage(folder).add(SWITCH, SWITCH)
    stage.run(10)
    return stage


def replicas_dead(folder: Path) -> Stage:
    stage = Stage(folder)
    for label in (ROBOT, "s1/second"):
        LocalServer(stage.sites.add(label, expose=[SWITCH]).graph, answer=lambda raw: switched("done"))
    client = Client(stage.sites.add(SERVER, imports=[SWITCH]).graph)
    assert stage.run(10, client.sees_server)
    for label in (ROBOT, "s1/second"):
        stage.kill_proxy(next(each for each in stage.sites.machines if each.label == label))
    stage.run(8)
    return stage


def wrong_name(folder: Path) -> Stage:
    return _plain(folder)


def not_imported(folder: Path) -> Stage:
    return _plain(folder, into=None)


def dds_domain(folder: Path) -> Stage:
    stage = no_reader(folder)
    listener = RosProcess(pid=4_711, command="ros2 topic echo /chatter", domain=7)
    stage.more = {"graph_domain": 0, "processes": (listener,)}
    return stage


def shm_only(folder: Path) -> Stage:
    stage = no_reader(folder)
    listener = RosProcess(pid=4_711, command="listener", domain=0, transports="SHM")
    stage.more = {"graph_domain": 0, "processes": (listener,)}
    return stage


def tunnel_down(folder: Path) -> Stage:
    return _behind_tunnel(folder, TunnelFact(peer="robot", device="gdpt0", handshake_age_s=412.0, endpoint="[::]:5"))


def nat_closed(folder: Path) -> Stage:
    return _behind_tunnel(folder, TunnelFact(peer="robot", device="gdpt0", endpoint="203.0.113.7:41641"))


def parked_full(folder: Path) -> Stage:
    stage = Stage(folder).add()
    stage.listen()
    stage.talk(for_s=120)
    stage.run(10)

    def change(facts: Facts) -> Facts:
        near, *others = facts.switches
        server = replace(facts.proxies[0], flows=tuple(replace(f, received=0) for f in facts.proxies[0].flows))
        return replace(
            facts, switches=(replace(near, drops={"pending-full": 40}), *others), proxies=(server, *facts.proxies[1:])
        )

    stage.change = change
    return stage


def identity_in_use(folder: Path) -> Stage:
    stage = _plain(folder)
    stage.change = lambda facts: with_waits(_stopped(facts), [WaitFact(reason="identity-in-use")])
    return stage


FAULTS: Final = (
    Fault("topic not exposed", Cause.NOT_EXPOSED, "core", not_exposed),
    Fault("other type", Cause.TYPE_DIFFERS, "core", other_type),
    Fault("other metadata", Cause.METADATA_DIFFERS, "core", other_metadata),
    Fault("other owner", Cause.OWNER_DIFFERS, "core", other_owner),
    Fault("no publisher", Cause.NO_PUBLISHER, "core", no_publisher),
    Fault("publisher left", Cause.NO_PUBLISHER, "core", publisher_left),
    Fault("publisher there, but silent", Cause.PUBLISHER_SILENT, "core", publisher_silent),
    Fault("no read right", Cause.DELEGATION_MISSING, "core", no_read_right),
    Fault("no publish right", Cause.DELEGATION_MISSING, "core", no_publish_right),
    Fault("another right", Cause.RIGHT_MISSING, "core", wrong_right),
    Fault("delegation expired", Cause.DELEGATION_EXPIRED, "core", delegation_expired),
    Fault("delegation revoked", Cause.DELEGATION_REVOKED, "core", delegation_revoked),
    Fault("membership expired", Cause.MEMBERSHIP_EXPIRED, "core", membership_expired),
    Fault("membership revoked", Cause.MEMBERSHIP_REVOKED, "core", membership_revoked),
    Fault("key epoch", Cause.KEY_EPOCH, "core", key_epoch),
    Fault("clock three days ahead", Cause.CLOCK, "core", clock_off),
    Fault("QoS: deadline requested", Cause.QOS_IMPOSSIBLE, "core", qos_deadline),
    Fault("QoS: best effort offered, reliable requested, loss", Cause.QOS_RELIABILITY, "core", qos_best_effort),
    Fault("QoS: volatile offered, transient local requested", Cause.QOS_DURABILITY, "core", qos_volatile),
    Fault("max_hz", Cause.RATE_LIMIT, "core", rate_limit),
    Fault("deadline drops", Cause.DEADLINE, "core", deadline),
    Fault("max_bits_s", Cause.BIT_RATE_LIMIT, "core", bit_rate),
    Fault("max_bytes", Cause.TOO_LARGE, "core", too_large),
    Fault("control that no publisher holds", Cause.NOT_IN_CONTROL, "core", without_control),
    Fault("no route: a leaf in between", Cause.NO_ROUTE, "core", no_route),
    Fault("untrusted domain", Cause.UNTRUSTED_DOMAIN, "core", untrusted_domain),
    Fault("MTU hole", Cause.MTU_HOLE, "core", mtu_hole),
    Fault("MTU hole that appears later", Cause.MTU_HOLE, "core", mtu_hole_for_messages),
    Fault("interface down", Cause.INTERFACE_DOWN, "core", interface_down),
    Fault("far interface down", Cause.INTERFACE_DOWN, "core", far_interface_down),
    Fault("EtherType filtered between switches", Cause.ETHERTYPE_FILTERED, "core", ethertype_filtered),
    Fault("RIB away", Cause.RIB_DOWN, "core", rib_away),
    Fault("switch here away", Cause.SWITCH_DOWN, "core", switch_away),
    Fault("far switch away", Cause.LINK_SILENT, "core", far_switch_away),
    Fault("far proxy away", Cause.FAR_PROXY_DOWN, "core", proxy_away),
    Fault("quota of names", Cause.QUOTA, "core", quota),
    Fault("rival proxy", Cause.RIVAL_PROXY, "core", rival_proxy),
    Fault("type support missing", Cause.TYPE_SUPPORT_MISSING, "core", type_support_missing),
    Fault("local node with another type", Cause.LOCAL_TYPE_DIFFERS, "core", local_type_differs),
    Fault("reader stopped", Cause.NO_READER_HERE, "core", no_reader),
    Fault("service without server", Cause.NO_SERVER, "core", no_server, "/switch"),
    Fault("all replicas dead", Cause.REPLICAS_SILENT, "core", replicas_dead, "/switch"),
    Fault("wrong name typed", Cause.NAME_UNKNOWN, "core", wrong_name, "/chattr"),
    Fault("not imported", Cause.NOT_IMPORTED, "core", not_imported),
    Fault("other ROS domain", Cause.ROS_DOMAIN_DIFFERS, "facts", dds_domain),
    Fault("shared memory only", Cause.SHARED_MEMORY_ONLY, "facts", shm_only),
    Fault("tunnel down", Cause.TUNNEL_DOWN, "facts", tunnel_down),
    Fault("NAT closed", Cause.NAT_CLOSED, "facts", nat_closed),
    Fault("parked frames full", Cause.PENDING_FULL, "facts", parked_full),
    Fault("keys in use twice", Cause.IDENTITY_IN_USE, "facts", identity_in_use),
)


# -- helpers


class ClockAhead:
    """Protocol core whose wall clock is ahead."""

    def __init__(self, core: ProtocolCore, ahead_s: float) -> None:
        self._core = core
        self._ahead_s = ahead_s

    def _at(self, now: Timestamps) -> Timestamps:
        return now._replace(unix_s=now.unix_s + self._ahead_s)

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        self._core.add_port(index, mac, mtu, cost, self._at(now))

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        self._core.port_changed(port, up, self._at(now))

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        self._core.receive(arrivals, self._at(now))

    def handle_timer(self, now: Timestamps) -> None:
        self._core.handle_timer(self._at(now))

    def get_timer(self) -> float | None:
        return self._core.get_timer()

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        return self._core.frames_to_send(now_s)

    def frames_sent(self, now_s: float) -> None:
        self._core.frames_sent(now_s)

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        self._core.count_arrivals(frames_from)

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        return self._core.poll_neighbours()


def _revoke(stage: Stage, wire: bytes) -> None:
    stage.sites.world.switches["s2"].revoke(wire, stage.sites.world.network.now)
    stage.sites.world.network.send_pending("s2")


def _plain_with(folder: Path, options: dict[str, Any], rib_at: str) -> Stage:
    topology = Topology(
        (Link("s1", "s2"), Link("s2", "s3")),
        (DomainPlan("line", ("s1", "s2", "s3")),),
        (Attachment(rib_at, "rib", "rib"),),
    )
    stage = Stage(folder, topology=topology, options=options)
    stage.add()
    stage.listen()
    stage.talk()
    stage.run(15)
    return stage


def _narrow(stage: Stage, a: str, b: str, size: int) -> None:
    """Make a link drop long frames without a word, as a device in between with a smaller MTU does."""
    network, link = stage.sites.world.network, stage.sites.world.cables[frozenset((a, b))]
    send = network._send

    def through(wired: tuple[object, ...], frame: bytes) -> None:
        if wired[0] is link and len(frame) > size:
            network.lost += 1
            return
        send(wired, frame)  # type: ignore[arg-type]

    network._send = through  # type: ignore[method-assign]


def _behind_tunnel(folder: Path, tunnel: TunnelFact) -> Stage:
    """Return a stage whose far side is away, behind a tunnel of the near switch."""
    stage = _flowing(folder)
    stage.sites.world.cables[frozenset(("s1", "s2"))].loss = 1.0
    stage.run(60)

    def change(facts: Facts) -> Facts:
        switches = tuple(replace(each, tunnels=(tunnel,) if each.is_near else (), waits=()) for each in facts.switches)
        return replace(facts, switches=switches, proxies=facts.proxies[:1])

    stage.change = change
    return stage


def _stopped(facts: Facts) -> Facts:
    """Return the facts without arrivals."""
    proxies = tuple(
        replace(each, flows=tuple(replace(flow, received=0) for flow in each.flows)) for each in facts.proxies
    )
    return replace(facts, proxies=proxies)
