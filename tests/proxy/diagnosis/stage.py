"""Robot and server at the ends of a line of three switches, and the diagnosis of a name between them.

::

    s1/robot: graph, proxy - s1 - s2 - s3 - s3/server: graph, proxy
                                  |
                                 RIB

All cores are the real ones, on a network in memory whose clock jumps. Faults are injected into them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from gdp.client.attachment import attachment_waits
from gdp.control.diagnostics import Question, Reply
from gdp.control.waiting import wait_fact
from gdp.diagnosis.answer import Answer
from gdp.diagnosis.diagnosis import diagnose
from gdp.diagnosis.facts import Facts, ProxyFacts, RibFacts, SwitchFacts, Unreachable, WaitFact
from gdp.diagnosis.fields import from_fields, to_fields
from gdp.diagnosis.survey import ROLES, Survey
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.state.node_state import SwitchState
from gdp.state.state_answers import answer_for_rib, answer_for_switch, answer_state, rib_facts
from gdp.state.switch_facts import switch_facts
from lab.topology import Attachment, DomainPlan, Link, Topology
from proxy.bridge.name_facts import proxy_facts
from proxy.serial.channel import Qos
from tests.gdp.state.memory_states import rib_state, switch_state
from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import Ear, Machine, Sites
from tests.proxy.endpoints.fake import Publication

ROBOT, SERVER = "s1/robot", "s3/server"
CHATTER = f"name: /chatter, type: {STRING}"
WINDOW_S = 1.0
LINE = Topology(
    (Link("s1", "s2"), Link("s2", "s3")),
    (DomainPlan("line", ("s1", "s2", "s3")),),
    (Attachment("s2", "rib", "rib"),),
)


@dataclass(eq=False)
class Stage:
    """The line, and what a fault changes about it.

    Attributes:
        dead: switches and RIBs that were stopped.
        offsets_s: how much the clock of a node is ahead.
        uptime_s: of every node.
        asks_at: where ``gdp explain`` is typed.
        more: further fields of the facts; ``change`` changes them.
    """

    folder: Path
    topology: Topology = LINE
    options: dict[str, Any] = field(default_factory=dict)
    dead: set[str] = field(default_factory=set)
    offsets_s: dict[str, float] = field(default_factory=dict)
    uptime_s: float = 60.0
    asks_at: str = SERVER
    more: dict[str, Any] = field(default_factory=dict)
    change: Callable[[Facts], Facts] = lambda facts: facts
    sites: Sites = field(init=False)

    def __post_init__(self) -> None:
        self.sites = Sites(self.folder, topology=self.topology, **self.options)

    @property
    def robot(self) -> Machine:
        """Return the publisher's machine."""
        return next(each for each in self.sites.machines if each.label == ROBOT)

    @property
    def server(self) -> Machine:
        """Return the reader's machine."""
        return next(each for each in self.sites.machines if each.label == SERVER)

    def add(self, out: str | None = CHATTER, into: str | None = CHATTER, **options: Any) -> Stage:
        """Start both proxies."""
        self.sites.add(ROBOT, expose=[out] if out else [], **options)
        self.sites.add(SERVER, imports=[into] if into else [])
        return self

    def talk(
        self, hz: float = 10.0, for_s: float = 30.0, size: int = 10, qos: Qos | None = None, topic: str = "/chatter"
    ) -> Publication:
        """Publish from now on."""
        talker = self.robot.graph.publish("/talker", topic, STRING, qos)
        self.sites.every(1 / hz, int(for_s * hz), lambda number: talker.publish(string("x" * size)))
        return talker

    def listen(self, topic: str = "/chatter", qos: Qos | None = None) -> Ear:
        """Subscribe at the server."""
        return Ear(self.server.graph, topic, qos=qos)

    def flow(self, **options: Any) -> Ear:
        """Publish and subscribe; return when messages arrive."""
        ear = self.listen()
        self.talk(**options)
        assert self.run(10, lambda: bool(ear.heard))
        return ear

    def run(self, duration_s: float, until: Callable[[], bool] | None = None) -> bool:
        """Let time pass."""
        return self.sites.run(duration_s, until)

    def kill_proxy(self, machine: Machine) -> None:
        """End a proxy without a goodbye."""
        self.sites.kill(machine)

    def stop(self, name: str) -> None:
        """Stop a switch without a goodbye."""
        self.dead.add(name)
        self.sites.world.network.stop(name)

    def stop_rib(self) -> None:
        """Stop the RIB without a goodbye."""
        self.dead.add("line")
        self.sites.world.kill_rib("line")

    def explain(self, asked: str = "/chatter", at: str | None = None) -> Answer:
        """Return what ``gdp explain`` says on a machine after two samples."""
        at = at or self.asks_at
        before = self.facts(asked, at)
        self.run(WINDOW_S)
        return diagnose(self.change(self.facts(asked, at).since(before, WINDOW_S)))

    def explain_over_network(self, asked: str = "/chatter", at: str | None = None) -> Answer:
        """Return what ``gdp explain`` says on a machine that asks the far nodes by diagnostic frames alone."""
        at = at or self.asks_at
        before = self._survey(asked, at)
        self.run(WINDOW_S)
        return diagnose(self.change(self._survey(asked, at).since(before, WINDOW_S)))

    def _survey(self, asked: str, at: str) -> Facts:
        self._answer()
        survey = Survey(asked)
        machine = next((each for each in self.sites.machines if each.label == at), None)
        if machine is not None:
            survey.add("proxy", to_fields(self._proxy(machine, asked, is_near=True)), is_near=True)
            for round_, role in enumerate(ROLES):
                for target in survey.targets(round_):
                    asks = (self._ask(machine, target, survey.name, asked) for _ in range(8))
                    result = next((each for each in asks if each is not None), None)
                    if result is None:
                        survey.add_silent(role, target[:3], "no answer")
                    else:
                        survey.add(role, result, is_near=round_ == 0)
        return replace(survey.facts(), **self.more)

    def _ask(self, machine: Machine, target: str, name: str, asked: str) -> Mapping[str, object] | None:
        """Send a request over the network in memory; return the result, or None."""
        replies: list[Reply | None] = []
        machine.member.diagnostics.ask(
            Name.from_text(target),
            "state",
            now=self.sites.world.network.now,
            on_reply=lambda reply, _: replies.append(reply),
            name=Name.from_text(name),
            body={"q": asked},
            reply_bytes=2_500,
        )
        self.sites.world.network.send_pending(machine.label)
        self.run(1.0, lambda: bool(replies))
        reply = replies[0] if replies else None
        return None if reply is None or reply.error else dict(reply.result)

    def _answer(self) -> None:
        """Let every node answer, as the real nodes do."""
        world = self.sites.world
        for machine in self.sites.machines:
            self._answer_for(machine)
        for label in world.switches:
            answer_for_switch(self._state_of(label))
        for label in world.ribs:
            answer_for_rib(rib_state(world, label))

    def _answer_for(self, machine: Machine) -> None:
        def gather(question: Question, _now: Timestamps) -> ProxyFacts:
            return self._proxy(machine, str(question.body["q"]), is_near=False)

        member = machine.member

        def holders(name: Name, _now_s: float) -> set[Name]:
            return {
                reader
                for each in list(member.publications)
                if each.topic == name
                for reader in map(Name, each.matched.names())
            }

        answer_state(member.diagnostics, member.attachment._policy, gather, holders)

    def _state_of(self, label: str) -> SwitchState:
        state = switch_state(self.sites.world, label, begun_s=self.sites.now_s - self.uptime_s)
        state.unwaited = partial(frozenset, self._edges(label))
        return state

    def facts(self, asked: str, at: str) -> Facts:
        """Return the facts of all nodes that run, through their JSON form."""
        machines = sorted(self.sites.machines, key=lambda each: each.label != at)
        proxies = [self._proxy(each, asked, is_near=each.label == at) for each in machines]
        near = proxies[0] if machines and machines[0].label == at else None
        overlays = {flow.overlay for flow in near.flows if flow.overlay} if near else set()
        name = Name.from_text(min(overlays)) if overlays else Name(bytes(32))
        world = self.sites.world
        switches = [self._switch(label, name, at) for label in world.switches if label not in self.dead]
        ribs = [self._rib(label, name) for label in world.ribs if label not in self.dead]
        return Facts(asked=asked, proxies=tuple(proxies), switches=tuple(switches), ribs=tuple(ribs), **self.more)

    def _proxy(self, machine: Machine, asked: str, *, is_near: bool) -> ProxyFacts:
        identity = self.sites.world.identities[machine.label]
        now = self.sites.world.network.now
        waits = attachment_waits(machine.member.attachment, now.mono_s)
        known = proxy_facts(
            machine.bridge,
            machine.context,
            identity,
            asked,
            now._replace(unix_s=now.unix_s + self.offsets_s.get(machine.label, 0.0)),
            waits=tuple(wait_fact(wait, "eth0") for wait in waits),
            uptime_s=self.uptime_s,
            with_known=is_near,
        )
        return replace(from_fields(ProxyFacts, to_fields(known)), is_near=is_near)

    def _switch(self, label: str, name: Name, at: str) -> SwitchFacts:
        known = switch_facts(self._state_of(label), name, self.sites.world.network.now)
        return replace(from_fields(SwitchFacts, to_fields(known)), is_near=at.startswith(f"{label}/"))

    def _edges(self, label: str) -> list[int]:
        """Return the ports of a switch that lead to nodes of its own machine."""
        ports = self.sites.world.network._nodes[label].ports
        return [port for port, (_, _, far) in ports.items() if "/" in far.node]

    def _rib(self, label: str, name: Name) -> RibFacts:
        known = rib_facts(self.sites.world.ribs[label].rib.state, name, self.sites.world.network.now)
        return from_fields(RibFacts, to_fields(known))


def unreachable(role: str, where: str) -> tuple[Unreachable, ...]:
    """Return a node that was asked and does not run."""
    return (Unreachable(role=role, where=where, why="no process serves its control socket"),)


def with_waits(facts: Facts, waits: Sequence[WaitFact]) -> Facts:
    """Return the facts with what the near proxy waits for."""
    near, *others = facts.proxies
    return replace(facts, proxies=(replace(near, is_attached=False, waits=tuple(waits)), *others))
