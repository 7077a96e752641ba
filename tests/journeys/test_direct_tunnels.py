"""Direct tunnels over the in-memory network: records pass through RIBs, and a direct link replaces the way round."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.control.endpoints import Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.crypto.tunnel_key import TunnelKey
from gdp.intervals import ENDPOINT, KEEPALIVE_MS
from gdp.names import Name
from gdp.switch.direct_tunnels import Action, Close, Open, Retry
from gdp.trust.revocation import Revocation
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import LEASE_S, flowing

POLL_S = 0.1
WITHIN_S = 1.0
ROBOT, SERVER = "home/robot", "cloud/server"


class Internet:
    """Border with RIBs, and two switches behind NATs, each of which publishes where the border sees it.

    Attributes:
        actions: of each switch, with their second.
    """

    def __init__(self, ribs: int = 1, lease_s: float = LEASE_S, keepalive_ms: int = KEEPALIVE_MS) -> None:
        attachments = [Attachment("border", "rib", f"rib{number}") for number in range(ribs)]
        topology = Topology(
            (Link("home", "border"), Link("cloud", "border"), Link("border", "other")),
            (DomainPlan("lab", ("border", "home", "cloud")), DomainPlan("else", ("other",), "lab")),
            (*attachments, Attachment("home", "proxy", "robot"), Attachment("cloud", "proxy", "server")),
        )
        self.world = Simulation(topology=topology, lease_s=lease_s, keepalive_ms=keepalive_ms, delay_s=0.02)
        self.network = self.world.network
        self.switches = self.world.switches
        self.actions: dict[str, list[tuple[float, Action]]] = {name: [] for name in self.switches}
        self.sequences = dict.fromkeys(self.switches, 0)
        assert self.world.run_until_attached()
        for name in self.switches:
            self._poll(name)

    def name(self, of: str) -> Name:
        return self.world.identities[of].name

    def publish(self, of: str, address: str) -> None:
        """Let a switch publish that the border sees it at this address."""
        self.sequences[of] += 1
        identity = self.world.identities[of]
        candidates = (Candidate(0, CandidateType.REFLEXIVE, Endpoint(address, 51_820)),)
        keys = (TunnelKey.derive(identity.kem).public,)
        until_unix_s = int(self.network.now.unix_s) + 86_400
        self.switches[of].tunnels.publish_endpoints(
            EndpointRecord.make(identity, keys, candidates, sequence=self.sequences[of], until_unix_s=until_unix_s)
        )
        self.network.send_pending(of)

    def begin(self) -> None:
        """Let both switches behind NATs publish, and wait until each tries the other."""
        self.publish("home", "192.0.2.1")
        self.publish("cloud", "198.51.100.1")
        assert self.network.run(WITHIN_S, lambda: self.tries("home", "cloud") and self.tries("cloud", "home"))

    def _poll(self, of: str) -> None:
        now = self.network.now
        self.actions[of] += [(now.mono_s, each) for each in self.switches[of].tunnels.poll_actions(now)]
        self.network.send_pending(of)
        self.network.call(POLL_S, partial(self._poll, of))

    def tries(self, at: str, peer: str, address: str = "", since_s: float = 0.0) -> bool:
        """Return whether a switch has tried to reach a peer, at this address if given, since a second."""
        return any(
            at_s >= since_s
            and isinstance(action, Open | Retry)
            and action.record.name == self.name(peer)
            and action.candidate is not None
            and action.candidate.endpoint.address == (address or action.candidate.endpoint.address)
            for at_s, action in self.actions[at]
        )

    def closes(self, at: str, peer: str) -> bool:
        return any(action == Close(self.name(peer)) for _, action in self.actions[at])

    def tunnel(self) -> SimLink:
        """Join the switches behind NATs by a direct tunnel."""
        link = self.network.connect("home", "cloud", SimLink(0.005), cost=5)
        for at, peer in (("home", "cloud"), ("cloud", "home")):
            self.switches[at].tunnels.set_direct_port(max(self.switches[at].hello_protocol.ports), self.name(peer))
        return link


@pytest.fixture
def internet() -> Internet:
    return Internet()


@pytest.mark.momentary("nothing of it has the lease of a name")
def test_two_switches_without_a_link_learn_each_others_endpoints_and_try_them_at_once(internet: Internet) -> None:
    internet.begin()
    starts = [internet.actions[at][0][0] for at in ("home", "cloud")]
    assert abs(starts[0] - starts[1]) < 0.5
    assert internet.actions["border"] == []


@pytest.mark.momentary("nothing of it has the lease of a name")
def test_a_moved_endpoint_is_tried_within_a_second(internet: Internet) -> None:
    internet.begin()
    internet.network.run(30)
    internet.publish("home", "203.0.113.5")
    assert internet.network.run(WITHIN_S, partial(internet.tries, "cloud", "home", "203.0.113.5"))


@pytest.mark.momentary("nothing of it has the lease of a name")
def test_a_moved_endpoint_arrives_despite_loss() -> None:
    internet = Internet()
    internet.begin()
    for link in internet.world.cables.values():
        link.loss = 0.05
    for number in range(10):
        internet.network.run(2)
        internet.publish("home", f"203.0.113.{number}")
        assert internet.network.run(5 * WITHIN_S, partial(internet.tries, "cloud", "home", f"203.0.113.{number}"))


@pytest.mark.momentary("records have a lease of their own, of which three pass")
def test_records_outlive_their_leases() -> None:
    internet = Internet(lease_s=24.0, keepalive_ms=1_000)
    internet.begin()
    internet.network.run(3 * ENDPOINT.lease_s)
    assert len(internet.world.ribs["lab"].rib.state.endpoints) == 2
    assert not internet.closes("home", "cloud")


@pytest.mark.momentary("nothing of it has the lease of a name")
def test_records_survive_the_death_of_the_rib(internet: Internet) -> None:
    internet.begin()
    internet.world.kill_rib("lab")
    internet.network.run(20)
    assert not internet.closes("home", "cloud")
    internet.world.restart_rib("lab")
    rib = internet.world.ribs["lab"].rib
    assert internet.network.run(5, lambda: len(rib.state.endpoints) == 2)
    internet.publish("home", "203.0.113.5")
    assert internet.network.run(WITHIN_S, partial(internet.tries, "cloud", "home", "203.0.113.5"))


@pytest.mark.momentary("nothing of it has the lease of a name")
def test_each_of_two_ribs_has_the_records_and_either_may_die() -> None:
    internet = Internet(ribs=2)
    internet.begin()
    assert internet.network.run(
        1, lambda: all(len(internet.world.ribs[each].rib.state.endpoints) == 2 for each in RIBS)
    )
    for number, dead in enumerate(RIBS, 1):
        internet.world.kill_rib(dead)
        internet.network.run(5)
        internet.publish("home", f"203.0.113.{number}")
        assert internet.network.run(WITHIN_S, partial(internet.tries, "cloud", "home", f"203.0.113.{number}"))
        internet.world.restart_rib(dead)
        rib = internet.world.ribs[dead].rib
        assert internet.network.run(5, lambda rib=rib: len(rib.state.endpoints) == 2)  # type: ignore[misc]


RIBS = ("lab", "lab#2")


@pytest.mark.momentary("nothing of it has the lease of a name")
def test_endpoints_are_unknown_to_another_domain(internet: Internet) -> None:
    internet.publish("other", "203.0.113.9")
    internet.begin()
    internet.network.run(10)
    assert internet.actions["other"] == []
    assert not internet.tries("home", "other")


@pytest.mark.momentary("nothing of it has the lease of a name")
def test_a_revoked_switch_loses_its_record_and_its_tunnels_within_a_second(internet: Internet) -> None:
    internet.begin()
    internet.tunnel()
    assert internet.network.run(3, lambda: is_direct(internet))
    authority, gone = internet.world.authorities["lab"], internet.world.identities["home"]
    until_unix_s = int(internet.network.now.unix_s) + 100_000
    wire = Revocation.make(authority.key, authority.root.subject, gone.member.fingerprint, until_unix_s)
    internet.switches["border"].revoke(wire, internet.network.now)
    internet.network.send_pending("border")
    internet.network.run(WITHIN_S)
    assert len(internet.world.ribs["lab"].rib.state.endpoints) == 1
    assert internet.closes("cloud", "home")
    assert not is_direct(internet)


def is_direct(internet: Internet) -> bool:
    """Return whether the switches behind NATs are neighbours."""
    ends = (internet.switches[at].hello_protocol.neighbours.all_up() for at in ("home", "cloud"))
    return all({each.name for each in up} & {internet.name("home"), internet.name("cloud")} for up in ends)


def test_a_direct_tunnel_takes_over_and_hands_back_without_a_lost_message(internet: Internet) -> None:
    internet.begin()
    flow = flowing(internet.world, source=ROBOT, readers=(SERVER,))
    number = 400
    flow.stream(number, 0.05, size=100)
    internet.network.run(3)
    link = internet.tunnel()
    assert internet.network.run(3, lambda: is_direct(internet))
    internet.network.run(5)
    assert not internet.tries("home", "cloud", since_s=internet.network.now.mono_s - 5)
    cut_s = internet.network.now.mono_s
    link.loss = 1.0  # the NAT has forgotten: neither end is notified
    assert internet.network.run(3, partial(internet.tries, "home", "cloud", since_s=cut_s))
    assert internet.network.run(60, lambda: flow.has(SERVER, number))
    assert flow.numbers(SERVER) == list(range(number))
    assert {2, 3} <= set(flow.hops(SERVER))
    flow.outlive()
