"""Sites in a row, each with a switch for robots and one for a replica, and a robot that calls the nearest replica.

What became of each request is kept: where the robot was, which replica answered, and after how long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count, pairwise
from typing import Final

from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.limits import COST_AUTO
from gdp.names import Name
from gdp.service.replication import NEAREST
from gdp.session.protocol.client_core import Call
from gdp.session.protocol.core import SessionCore
from gdp.session.protocol.server_core import ServerCore
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology

SERVICE: Final = "plan"
ROBOT: Final = "a0/robot"
SIZE: Final = 200
STEP_S: Final = 0.02


@dataclass(slots=True, eq=False)
class Request:
    """One request of the robot."""

    call: Call
    begun_s: float
    at: int  # the robot's site
    answered_s: float = float("inf")
    by: str = ""


@dataclass
class Sites:
    """Sites in a row.

    Args:
        apart_s: delay between the sites' switches, one way.
        near_s: delay between a site's switch and its replica's.
        order: of the sites, in which nodes are made; their names follow from it.
        work_s: how long a replica works on a request.
    """

    apart_s: Sequence[float] = (0.015, 0.06)
    near_s: float = 0.005
    order: Sequence[int] = ()
    work_s: float = 0.0
    is_measured: bool = True
    size: int = SIZE
    seed: int = 1
    world: Simulation = field(init=False)
    cores: dict[str, SessionCore] = field(default_factory=dict)
    serving: dict[str, ServerCore] = field(default_factory=dict)
    requests: list[Request] = field(default_factory=list)
    executed: dict[bytes, list[str]] = field(default_factory=dict)
    at: int = 0
    uplink_bytes: int = 0  # of requests
    uplink_frames: int = 0
    out: set[int] = field(default_factory=set)  # sites whose replica cannot answer
    frozen: set[str] = field(default_factory=set)  # replicas

    def __post_init__(self) -> None:
        sites = range(len(self.apart_s) + 1)
        order = list(self.order) or list(sites)
        switches = [f"{kind}{site}" for site in order for kind in "as"]
        links = [Link(f"a{one}", f"a{two}") for one, two in pairwise(sites)] + [Link(f"a{k}", f"s{k}") for k in sites]
        attached = [
            Attachment("a0", "rib", "rib"),
            *(Attachment(f"s{k}", "proxy", f"edge{k}") for k in order),
            Attachment("a0", "proxy", "robot"),
        ]
        self.world = Simulation(
            topology=Topology(tuple(links), (DomainPlan("lab", tuple(switches)),), tuple(attached)),
            seed=self.seed,
            keepalive_ms=None,
        )
        for link in links:
            delay_s = self.near_s if "s" in link.b else self.apart_s[int(link.a[1:])]
            self.set_delay(link.a, link.b, delay_s)
        self._starts = count(1, 1 << 20)
        for label in self.world.members:
            self._open(label)
        assert self.world.run_until_attached()
        for k in order:
            self.serve(k)
        self.world.network.taps.append(self._tap)
        self.settle()

    def service(self, site: int) -> str:
        """Return the name that a site's replica serves."""
        del site
        return SERVICE

    def settle(self) -> None:
        """Let the robot find all replicas."""
        self.begin()
        assert self.run(5.0, lambda: self.requests[-1].call.is_done and len(self.known()) == len(self.apart_s) + 1)
        self.run(1.0)
        self.requests.clear()

    def answer(self, label: str, request: bytes) -> bytes | str:
        """Return what a replica answers."""
        del request
        return label.encode()

    @property
    def now_s(self) -> float:
        """Return the present second."""
        return self.world.network.now.mono_s

    def set_delay(self, a: str, b: str, delay_s: float) -> None:
        """Change the delay of a link, and its cost."""
        cable = self.world.cables[frozenset((a, b))]
        cable.delay_s = delay_s
        self.world.network.set_cost(cable, COST_AUTO if self.is_measured else round(10 + 2_000 * delay_s))

    def trip_s(self, site: int) -> float:
        """Return the round trip between the robot's switch and a replica."""
        low, high = sorted((self.at, site))
        between = [f"a{k}" for k in range(low, high + 1)]
        cables = [*pairwise(between), (f"a{site}", f"s{site}")]
        return 2 * sum(self.world.cables[frozenset(each)].delay_s for each in cables)

    def nearest(self) -> set[int]:
        """Return the sites whose replicas are the nearest of those that can answer."""
        costs = {site: self.cost(site) for site in range(len(self.apart_s) + 1) if site not in self.out}
        return {site for site, cost in costs.items() if cost == min(costs.values())}

    def cost(self, site: int) -> float:
        """Return the cost of the path from the robot's switch to a replica."""
        return 1_000 * self.trip_s(site) + 10 * (abs(self.at - site) + 1)

    def known(self) -> list[Name]:
        """Return the replicas that keep up, as the robot knows."""
        return self.cores[ROBOT].member.services.peers(self.cores[ROBOT].resolve(SERVICE, Right.CALL).name)

    def _open(self, label: str) -> None:
        member = self.world.members[label]
        right, sites = (Right.CALL, range(len(self.apart_s) + 1)) if label == ROBOT else (Right.SERVE, [int(label[1])])
        topics = [self.world.topic(name, member, [right]) for name in {self.service(site): None for site in sites}]
        self.cores[label] = SessionCore(member, topics, lambda: next(self._starts))

    def label(self, site: int) -> str:
        """Return the label of a site's replica."""
        return f"s{site}/edge{site}"

    def serve(self, site: int) -> None:
        """Let a replica serve from now on."""
        label = self.label(site)
        core = self.cores[label]
        self.serving[label] = core.serve(
            core.resolve(self.service(site), Right.SERVE), at_once=None, is_global=True, urgent=False
        )
        self.send(label)

    def send(self, label: str) -> None:
        """Send the pending frames of a member."""
        self.cores[label].member.flush(self.now_s)
        self.world.network.send_pending(label)

    def kill(self, site: int) -> None:
        """Kill a replica without a goodbye."""
        label = self.label(site)
        self.serving.pop(label, None)
        self.world.network.stop(label)
        self.out.add(site)

    def freeze(self, site: int) -> None:
        """Stop the time of a replica."""
        self.world.network.freeze(self.label(site))
        self.out.add(site)
        self.frozen.add(self.label(site))

    def thaw(self, site: int) -> None:
        """Resume a frozen replica."""
        self.frozen.discard(self.label(site))
        self.world.network.thaw(self.label(site))
        self.out.discard(site)

    def cut(self, site: int, *, is_out: bool) -> None:
        """Let a replica's link lose all frames to it, or all from it; ``join`` ends that."""
        lead = self.world.leads[self.label(site)]
        lead.loss, lead.spared = 1.0, f"s{site}" if is_out else self.label(site)
        self.out.add(site)

    def join(self, site: int) -> None:
        """Let a replica's link lose nothing."""
        self.world.leads[self.label(site)].loss = 0.0
        self.out.discard(site)

    def restart(self, site: int) -> None:
        """Start a replica again, in another incarnation."""
        label = self.label(site)
        self.out.discard(site)
        self.world.restart_member(label)
        self._open(label)
        self.serve(site)

    def roam(self, site: int) -> None:
        """Move the robot to another site."""
        self.at = site
        self.world.roam(ROBOT, f"a{site}")

    def begin(self) -> None:
        """Begin a request."""
        core = self.cores[ROBOT]
        number = len(self.requests)
        payload = number.to_bytes(4, "big") + int(self.now_s * 1e6).to_bytes(8, "big") + bytes(self.size)
        request = Request(Call(payload=payload, timeout_s=20.0, replication=NEAREST), self.now_s, self.at)
        self.requests.append(request)
        core.call(core.resolve(SERVICE, Right.CALL), request.call, self.now_s)
        self.send(ROBOT)

    def call_often(self, duration_s: float, every_s: float = 0.05) -> None:
        """Begin requests for a while, however long each takes."""
        for number in range(int(duration_s / every_s)):
            self.world.network.call(number * every_s, self.begin)

    def run(self, duration_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass, and replicas answer."""
        open_calls = {id(each): each for each in self.requests if not each.call.is_done}
        seen = len(self.requests)

        def work() -> bool:
            nonlocal seen
            for label, core in self.cores.items():
                if label == ROBOT or (label in self.serving and label not in self.frozen):
                    core.handle(self.now_s)
                    self._answer(label)
                    self.send(label)
            for each in self.requests[seen:]:
                open_calls[id(each)] = each
            seen = len(self.requests)
            for key in [key for key, each in open_calls.items() if each.call.is_done]:
                each = open_calls.pop(key)
                if each.call.response is not None:
                    each.answered_s, each.by = self.now_s, each.call.response.payload.decode()
            return until()

        return self.world.network.run(duration_s, work)

    def _answer(self, label: str) -> None:
        server = self.serving.get(label)
        while server is not None and server.turns:
            turn = server.turns.popleft()
            self.executed.setdefault(turn.request[:12], []).append(label)
            self.world.network.call(self.work_s, partial(self._finish, label, server, turn.number, turn.request))

    def _finish(self, label: str, server: ServerCore, number: int, request: bytes) -> None:
        if label in self.frozen:
            self.world.network.call(STEP_S, partial(self._finish, label, server, number, request))
        elif self.serving.get(label) is server:
            server.finish(number, self.answer(label, request), self.now_s)
            self.send(label)

    def _tap(self, _at_s: float, a: str, _b: str, frame: bytes) -> None:
        if a == ROBOT and decode(frame, ETHER_BYTES).kind in (Kind.DATA, Kind.PARITY):
            self.uplink_bytes += len(frame)
            self.uplink_frames += 1
