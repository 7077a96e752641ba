"""Work of a network at rest, in virtual time: keepalives call nothing else, and those of a kernel nothing at all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import pytest

from gdp.control.link_quality import LinkReport
from gdp.exchange.anti_entropy import AntiEntropy
from gdp.intervals import UPKEEP_S
from gdp.rib.core import RibCore
from gdp.sansio import KeepaliveOffer, KeepaliveRun, NodeCore
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology

AT_REST_S = 60.0
TURNS_MAX = {"switch": 115, "rib": 85, "member": 60}  # of a core in this time: hellos, renewals, statements


class KernelSessions:
    """Keepalive sessions of one core, all run as the kernel does: nothing is lost, and reports come when they are due.

    Attributes:
        turns: how often the core was called for anything else.
    """

    def __init__(self, world: Simulation, name: str, core: NodeCore) -> None:
        self.turns = 0
        self._network, self._name, self._core = world.network, name, core
        self._sessions: dict[tuple[int, bytes], KeepaliveOffer] = {}
        self._is_reporting = False
        self._look()

    def count_turns(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Count the calls of the core from now on."""
        for name in "receive", "handle_timer":
            call = getattr(self._core, name)

            def counted(*arguments: object, call: Callable[..., object] = call) -> object:
                self.turns += not self._is_reporting
                return call(*arguments)

            monkeypatch.setattr(self._core, name, counted)

    def _look(self) -> None:
        """Report, as a loop does each ``UPKEEP_S``, and begin what is offered."""
        now = self._network.now
        offers = {(each.port, each.name): each for each in self._core.offload.offers(now.mono_s)}
        runs = [self._run(each, now.mono_s, key in self._sessions) for key, each in offers.items()]
        self._sessions = offers
        self._is_reporting = True
        self._core.offload.take_runs(runs, 0.0, now)
        self._is_reporting = False
        self._network.send_pending(self._name)
        self._network.call(UPKEEP_S, self._look)

    @staticmethod
    def _run(offer: KeepaliveOffer, now_s: float, lasts: bool) -> KeepaliveRun:
        if not lasts:
            return KeepaliveRun(offer.port, offer.name, offer.nonce, received=offer.received, heard_s=offer.heard_s)
        came = round(UPKEEP_S / offer.out_interval_s)
        sent_s = tuple(now_s - offer.out_interval_s * each for each in range(came))
        report = LinkReport(offer.echo + came, offer.sent + came, 0, 0)
        return KeepaliveRun(
            offer.port, offer.name, offer.nonce, sent_s, offer.sequence + came, came, offer.received + came, now_s,
            report, 3, 0, now_s,
        )  # fmt: skip


def test_nodes_whose_keepalives_the_kernel_runs_are_called_for_their_own_work_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nodes = (Attachment("a1", "rib", "rib"), Attachment("a1", "proxy", "P"))
    world = Simulation(
        topology=Topology((Link("a1", "a2"),), (DomainPlan("a", ("a1", "a2")),), nodes), keepalive_ms=None
    )
    assert world.run_until_attached()
    world.network.run(AT_REST_S)
    cores: list[tuple[str, str, NodeCore]] = [("switch", name, each) for name, each in world.switches.items()]
    cores += [("rib", world.rib_node(label), each) for label, each in world.ribs.items()]
    cores += [("member", label, each) for label, each in world.members.items()]
    found = [(kind, name, KernelSessions(world, name, core)) for kind, name, core in cores]
    world.network.run(3 * UPKEEP_S)
    for _, _, each in found:
        each.count_turns(monkeypatch)
    world.network.run(AT_REST_S)
    assert {name: each.turns for kind, name, each in found if each.turns > TURNS_MAX[kind]} == {}


def test_a_rib_at_rest_runs_its_own_timers_when_they_are_due_and_not_with_each_keepalive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = DomainPlan("a", ("a1",))
    nodes = (Attachment("a1", "rib", "rib"), Attachment("a1", "proxy", "P"))
    world = Simulation(topology=Topology((), (plan,), nodes), keepalive_ms=None)
    assert world.run_until_attached()
    world.network.run(AT_REST_S)
    (host,) = world.ribs.values()
    counted, keepalives = Counter[str](), 0
    for owner, name in (RibCore, "handle_timer"), (AntiEntropy, "_find_next"):
        before = getattr(owner, name)

        def count(*arguments: object, before: object = before, name: str = name) -> object:
            counted[name] += 1
            return before(*arguments)  # type: ignore[operator]

        monkeypatch.setattr(owner, name, count)
    (port,) = host.attachment.hello_protocol.ports.values()
    begun = port.keepalive_sequence
    world.network.run(AT_REST_S)
    keepalives = port.keepalive_sequence - begun
    assert keepalives > 10 * AT_REST_S
    assert counted["handle_timer"] < AT_REST_S
    assert counted["_find_next"] < 2 * AT_REST_S
