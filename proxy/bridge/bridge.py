"""All flows of a proxy: begun, followed and ended as local nodes, rules and delegations come and go.

Place: shell; endpoints and the member do the I/O. The loop that drives it calls ``work`` after every step.

A message's way out: endpoint -> ``Seat.deliver`` -> its flow -> ``Publisher.publish``. And in: ``take_messages`` ->
the flow of its name -> ``Endpoint.publish``, ``call`` or ``answer``.
"""

from __future__ import annotations

import logging
import secrets
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple, Protocol, TypeAlias

from gdp.client.member import Message, Topic
from gdp.errors import LocalError
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.trust.right import Right
from proxy.bridge.exposed_service import ExposedService
from proxy.bridge.exposed_topic import ExposedTopic
from proxy.bridge.imported_service import ImportedService
from proxy.bridge.imported_topic import ImportedTopic
from proxy.bridge.rivals import SIGN, Rivals, mark_of, sign
from proxy.bridge.seat import Seat
from proxy.bridge.site import Site
from proxy.bridge.wishes import Complaint, Wish, exposed, imported
from proxy.endpoints.endpoint import End, Endpoint, Event, Faulted, Graph, Role, proxy_node_name
from proxy.faults import Fault
from proxy.rules.rule import Rule
from proxy.tally import Tally

__all__ = ["Bridge", "BridgeRules"]

log = logging.getLogger(__name__)

_ENDED_MAX: Final = 256
TICK_S: Final = 0.05  # how often services look whom they hear, and who may begin is looked at

Flow: TypeAlias = ExposedTopic | ImportedTopic | ExposedService | ImportedService


class BridgeRules(Protocol):
    """Rules of a bridge: those of ``proxy.yaml``, or of a recording."""

    @property
    def expose(self) -> Sequence[Rule]:
        """Return the rules for what leaves this machine."""

    @property
    def imports(self) -> Sequence[Rule]:
        """Return the rules for what comes from elsewhere."""

    def endpoint_of(self, rule: Rule) -> int:
        """Return which of the bridge's endpoints a rule is about."""


class _Key(NamedTuple):
    seat: int
    is_exposed: bool
    kind: str
    local: str
    name: Name


class _View:
    """One look at a graph."""

    def __init__(self, graph: Graph, me: str) -> None:
        self.graph = graph
        self.rivals = Rivals(me, graph)
        self._ends: dict[tuple[Role, str, str], list[End]] = {}
        for end in graph:
            if not end.is_proxy:
                self._ends.setdefault((end.role, end.name, end.type_name), []).append(end)

    def ends(self, role: Role, wish: Wish) -> Sequence[End]:
        """Return what nodes other than proxies do with the wish's name."""
        return self._ends.get((role, wish.local, wish.type_name), ())


class _Signboard:
    """Owns the sign by which other proxies know this one."""

    def take(self, event: Event, now_s: float) -> None:
        """Say what is wrong with it: without a sign two proxies of one graph may both carry a name for a moment."""
        del now_s
        if isinstance(event, Faulted):
            log.warning("no sign for other proxies reason=%s", event.reason)


class Bridge:
    """Carries what the rules say between endpoints and the overlay.

    Args:
        endpoints: as the rules number them, in the order of the configuration's ``ros`` section.
        look_s: seconds to look around before anything begins: what graphs take to show the other proxies in them.
    """

    def __init__(
        self,
        site: Site,
        config: BridgeRules,
        endpoints: Sequence[Endpoint],
        held: DelegationStore,
        *,
        look_s: float = 0.0,
    ) -> None:
        self._site = site
        self._config = config
        self._held = held
        self._me = proxy_node_name(site.member.name.to_text())
        self._seats = [Seat(endpoint) for endpoint in endpoints]
        self._flows: dict[_Key, tuple[Wish, Flow]] = {}
        self._inbound: dict[Name, Flow] = {}  # who takes the overlay's messages of a name
        self._timed: list[ExposedService | ImportedService] = []
        self._since: dict[_Key, float] = {}  # wished, and waiting for other proxies to begin
        self._failed: dict[_Key, Complaint] = {}  # could not begin in this graph as it is
        self._complaints: set[Complaint] = set()
        self._ended = deque[Tally](maxlen=_ENDED_MAX)
        self._is_stale = True
        self._look_s = look_s
        self._begun_s: float | None = None  # when the first look was
        self._tick_at_s = 0.0
        self._now_s = 0.0
        self.unknown_names = 0
        for seat in self._seats:
            if not seat.endpoint.is_live:
                continue  # no other proxy looks into a recording
            try:
                seat.advertise(_Signboard(), sign(SIGN, seat.endpoint.ros))
            except LocalError as error:
                log.warning("no sign for other proxies endpoint=%s reason=%s", seat.endpoint.label, error)

    @property
    def flows(self) -> list[tuple[Wish, Flow]]:
        """Return what is carried now."""
        return list(self._flows.values())

    @property
    def labels(self) -> list[str]:
        """Return what people call the graphs."""
        return [seat.endpoint.label for seat in self._seats]

    @property
    def tallies(self) -> list[Tally]:
        """Return the figures of every topic that comes in, those that ended included."""
        imported = [flow for _, flow in self.flows if isinstance(flow, ImportedTopic)]
        for flow in imported:
            flow.count_losses()
        return [*self._ended, *(flow.tally for flow in imported)]

    @property
    def is_settled(self) -> bool:
        """Return whether nothing waits to begin."""
        return not self._is_stale and not self._since

    def work(self, now_s: float) -> None:
        """Take what endpoints and the overlay have, and do what is due."""
        self._now_s = now_s
        for seat in self._seats:
            if seat.deliver(now_s):
                self._is_stale = True
                self._failed.clear()
        for message in self._site.member.take_messages():
            self._receive(message, now_s)
        if self._is_stale or (self._since and now_s >= self._tick_at_s):
            self._refresh(now_s)
        for seat in self._seats:
            seat.deliver_faults(now_s)
        is_tick = now_s >= self._tick_at_s
        for flow in self._timed:
            due_s = flow.next_timeout()
            if is_tick:
                flow.tick(now_s)
            elif due_s is not None and due_s <= now_s:
                flow.timeout(now_s)
        if is_tick:
            self._tick_at_s = now_s + TICK_S
            self._site.traffic.dropped = sum(seat.endpoint.dropped for seat in self._seats)

    def next_timeout(self) -> float | None:
        """Return the monotonic second at which there is something to do, or None."""
        if self._is_stale:
            return 0.0
        if not self._timed:
            return self._tick_at_s if self._since else None
        times = [flow.next_timeout() for flow in self._timed]
        return min([self._tick_at_s, *(time for time in times if time is not None)])

    def reload(self, config: BridgeRules, held: DelegationStore) -> None:
        """Take rules and delegations anew; flows whose rule is the same go on undisturbed while it is delegated."""
        self._config, self._held = config, held
        for key, (wish, flow) in list(self._flows.items()):
            topic = held.find(wish.name, _right(wish))
            if topic is None:
                self._end(key)
            else:
                flow.renew(topic)
        self._failed.clear()
        self._is_stale = True

    def drain(self, now_s: float) -> None:
        """Let no client begin anything new with the servers here; what is under way is answered."""
        for _, flow in self.flows:
            if isinstance(flow, ExposedService):
                flow.drain(now_s)

    def is_drained(self, now_s: float) -> bool:
        """Return whether every server here, after ``drain``, has answered everything."""
        return all(flow.is_drained(now_s) for _, flow in self.flows if isinstance(flow, ExposedService))

    def close(self) -> None:
        """End every flow; endpoints stay open."""
        for key in list(self._flows):
            self._end(key)

    def _receive(self, message: Message, now_s: float) -> None:
        flow = self._inbound.get(message.topic)
        if flow is None or isinstance(flow, ExposedTopic):
            self.unknown_names += 1  # ended a moment ago
            return
        flow.receive(message, now_s)

    def _refresh(self, now_s: float) -> None:
        """Begin what is wished and not there, end what is there and not wished, tell the others who is there."""
        self._is_stale = False
        complaints = list[Complaint]()
        wished = set[_Key]()
        for at, seat in enumerate(self._seats):
            view = _View(seat.endpoint.graph(), self._me)
            for wish in self._wishes(at, view.graph, complaints):
                key = _Key(at, wish.is_exposed, wish.rule.kind, wish.local, wish.name)
                rival = view.rivals.before_us(_shown_as(wish), is_begun=key in self._flows)
                if rival:
                    complaints.append(Complaint(wish.local, Fault.RIVAL, f"{rival} carries it in this graph"))
                    continue
                wished.add(key)
                if key in self._flows and self._flows[key][0].rule != wish.rule:
                    self._end(key)
                if key not in self._flows and key not in self._failed and self._is_our_turn(key, view, now_s):
                    self._begin(key, wish, view)
                try:
                    self._follow(key, wish, view, now_s)
                except LocalError as error:
                    self._end(key)
                    self._failed[key] = Complaint(wish.local, Fault.NO_GRAPH, str(error))
                complaints += [self._failed[key]] if key in self._failed else []
        for key in [key for key in self._flows if key not in wished]:
            self._end(key)
        self._since = {key: since for key, since in self._since.items() if key in wished}
        self._tell(complaints)

    def _is_our_turn(self, key: _Key, view: _View, now_s: float) -> bool:
        """Return whether the proxies before us in this graph had time to show themselves, and to begin."""
        self._begun_s = now_s if self._begun_s is None else self._begun_s
        ours_s = self._since.setdefault(key, now_s) + view.rivals.patience_s
        if now_s < max(ours_s, self._begun_s + self._look_s):
            return False
        del self._since[key]
        return True

    def _follow(self, key: _Key, wish: Wish, view: _View, now_s: float) -> None:
        _, flow = self._flows.get(key, (wish, None))
        if isinstance(flow, ExposedTopic):
            flow.follow(view.ends(Role.PUBLISHES, wish))
        elif isinstance(flow, ImportedTopic):
            flow.follow(view.ends(Role.SUBSCRIBES, wish))
        elif isinstance(flow, ExposedService):
            flow.follow(view.ends(Role.SERVES, wish), now_s)

    def _wishes(self, at: int, graph: Graph, complaints: list[Complaint]) -> Iterator[Wish]:
        config = self._config
        yield from exposed([rule for rule in config.expose if config.endpoint_of(rule) == at], graph, complaints)
        rules = [rule for rule in config.imports if config.endpoint_of(rule) == at]
        held = [*self._held.described(Right.READ), *self._held.described(Right.CALL)]
        yield from imported(rules, graph, held, complaints)

    def _begin(self, key: _Key, wish: Wish, view: _View) -> None:
        """Begin a flow, or note why it cannot be begun in this graph."""
        topic = self._held.find(wish.name, _right(wish))
        if topic is None:
            self._failed[key] = Complaint(wish.local, Fault.NO_DELEGATION, self._how_to_delegate(wish))
            return
        try:
            flow = self._make(self._seats[key.seat], wish, topic, view)
        except LocalError as error:
            self._failed[key] = Complaint(wish.local, Fault.UNKNOWN_TYPE, str(error))
            return
        self._flows[key] = wish, flow
        if not isinstance(flow, ExposedTopic):
            self._inbound[wish.name] = flow
        if isinstance(flow, ExposedService | ImportedService):
            self._timed.append(flow)
        log.debug("flow begun name=%s exposed=%s", wish.name.short, wish.is_exposed)

    def _make(self, seat: Seat, wish: Wish, topic: Topic, view: _View) -> Flow:
        site = self._site
        if wish.rule.kind != "topic":
            kind = ExposedService if wish.is_exposed else ImportedService
            return kind(site, seat, wish, topic, secrets.randbits(63))
        if wish.is_exposed:
            return ExposedTopic(site, seat, wish, topic, view.ends(Role.PUBLISHES, wish))
        return ImportedTopic(site, seat, wish, topic)

    def _end(self, key: _Key) -> None:
        wish, flow = self._flows.pop(key)
        if self._inbound.get(wish.name) is flow:
            del self._inbound[wish.name]
        if isinstance(flow, ExposedService | ImportedService):
            self._timed.remove(flow)
        if isinstance(flow, ImportedTopic):
            self._ended.append(flow.tally)
        flow.close(self._now_s)
        log.debug("flow ended name=%s exposed=%s", wish.name.short, wish.is_exposed)

    def _how_to_delegate(self, wish: Wish) -> str:
        right, kind = _right(wish).value, wish.rule.kind
        return (
            f"no delegation for {wish.name.to_text()} in {self._held.directory}; the owner makes one with"
            f" 'gdp delegate name --right {right} --kind {kind} --name {wish.rule.global_name_of(wish.local)}"
            f" --type {wish.type_name} ...'"
        )

    def _tell(self, complaints: Sequence[Complaint]) -> None:
        """Tell what is newly odd; what no longer is may be told again."""
        now = set(complaints)
        for complaint in self._complaints - now:
            if complaint.fault is not Fault.UNKNOWN_TYPE and complaint.fault is not Fault.NO_DELEGATION:
                self._site.faults.over(complaint.local, complaint.fault)
        for complaint in now - self._complaints:
            self._site.faults.tell(complaint.local, complaint.fault, complaint.detail)
        self._complaints = now


def _shown_as(wish: Wish) -> str:
    """Return the local name at which other proxies see that we carry this."""
    return mark_of(wish.local) if wish.is_exposed and wish.rule.kind != "topic" else wish.local


def _right(wish: Wish) -> Right:
    if wish.rule.kind == "topic":
        return Right.PUBLISH if wish.is_exposed else Right.READ
    return Right.SERVE if wish.is_exposed else Right.CALL
