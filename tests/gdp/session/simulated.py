"""Sessions over the simulated network, whose clock jumps from event to event."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TypeVar

from gdp.client.participant import Topic
from gdp.client.publisher import Publisher
from gdp.errors import LocalError
from gdp.names import Name
from gdp.session.protocol.core import SessionCore
from gdp.session.protocol.opened import Kept
from gdp.session.session import Session
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Topology

__all__ = ["FOREVER_S", "Simulated", "world_of"]

T = TypeVar("T")
FOREVER_S = 60.0

Rights = Mapping[str, Mapping[str, Collection[Right]]]  # by node and name


class _Node:
    """Node without a device."""

    def __init__(self, core: SessionCore) -> None:
        self.core = core
        self.is_closed = False

    def waiting_for(self) -> str:
        return "no neighbour"

    def refused(self, name: Name) -> str:
        del name
        return ""

    def reload(self) -> None:
        raise LocalError("there are no files")

    def keep(self, topic: Topic, publisher: Publisher, holders: Sequence[Topic], most_bytes: int) -> Kept:
        raise LocalError("there is no disk")

    def close(self) -> None:
        self.is_closed = True


class _Driver:
    def __init__(self, simulated: Simulated, label: str) -> None:
        self._simulated = simulated
        self._label = label

    def now_s(self) -> float:
        return self._simulated.now_s

    def run(self, command: Callable[[], T]) -> T:
        result = command()
        self._simulated.send(self._label)
        return result

    def publish(self, publisher: Publisher, message: bytes) -> None:
        publisher.publish(message, self.now_s())
        self._simulated.send(self._label)

    def wait(self, is_ready: Callable[[], bool], deadline_s: float | None) -> bool:
        left_s = FOREVER_S if deadline_s is None else max(deadline_s - self.now_s(), 0.0)
        return self._simulated.run(left_s, is_ready)

    def close(self) -> None:
        return


class Simulated:
    """Switch, a RIB, and a session for each node."""

    def __init__(self, rights: Rights) -> None:
        attachments = (Attachment("s", "rib", "rib0"), *(Attachment("s", "proxy", label) for label in rights))
        self.world = Simulation(topology=Topology((), (DomainPlan("lab", ("s",)),), attachments))
        self.cores: dict[str, SessionCore] = {}
        self.sessions: dict[str, Session] = {}
        starts = iter(range(1, 1 << 30, 1 << 20))
        for label, names in rights.items():
            member = self.world.members[f"s/{label}"]
            topics = [self.world.topic(name, member, given) for name, given in names.items()]
            core = self.cores[label] = SessionCore(member, topics, lambda: next(starts))
            self.sessions[label] = Session(_Node(core), _Driver(self, label))
        assert self.world.run_until_attached()

    @property
    def now_s(self) -> float:
        """Return the present second of the network."""
        return self.world.network.now.mono_s

    def send(self, label: str) -> None:
        """Send the pending frames of a session."""
        self.cores[label].member.flush(self.now_s)
        self.world.network.send_pending(f"s/{label}")

    def run(self, duration_s: float, is_ready: Callable[[], bool] = lambda: False) -> bool:
        """Advance time; return whether ``is_ready`` came true."""

        def handle() -> bool:
            for label, core in self.cores.items():
                core.handle(self.now_s)
                if core.has_services:
                    self.send(label)
            return is_ready()

        return self.world.network.run(duration_s, handle)


def world_of(rights: Rights) -> Simulated:
    """Return a network whose nodes have these rights."""
    return Simulated(rights)
