"""Local servers that respond on command of a test, and local clients that record the results of their calls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from tests.proxy.bridge.known import SET_BOOL
from tests.proxy.endpoints.fake import FakeGraph, Server

__all__ = ["Client", "LocalServer"]


@dataclass(slots=True)
class LocalServer:
    """Serving node; ``answer`` is its immediate response, None: it waits for the test."""

    graph: FakeGraph
    name: str = "/switch"
    type_name: str = SET_BOOL
    answer: Callable[[bytes], bytes | str] | None = None
    waiting: list[tuple[bytes, Callable[[bytes | str], None]]] = field(default_factory=list)
    asked: int = 0
    handle: Server = field(init=False)

    def __post_init__(self) -> None:
        self.handle = self.graph.serve("/server", self.name, self.type_name, self._ask)

    def _ask(self, raw: bytes, done: Callable[[bytes | str], None]) -> None:
        self.asked += 1
        if self.answer is None:
            self.waiting.append((raw, done))
        else:
            done(self.answer(raw))


@dataclass(slots=True)
class Client:
    """Calling node."""

    graph: FakeGraph
    name: str = "/switch"
    got: dict[int, list[bytes | str]] = field(default_factory=dict)  # by call

    def call(self, raw: bytes) -> int:
        """Call now; return the call's number."""
        number = len(self.got)
        outcomes: list[bytes | str] = []
        self.got[number] = outcomes
        self.graph.call(self.name, raw, outcomes.append)
        return number

    @property
    def outcomes(self) -> list[bytes | str]:
        """Return the results, call by call."""
        return [outcome for outcomes in self.got.values() for outcome in outcomes]

    def sees_server(self) -> bool:
        """Return whether the graph shows a server."""
        return any(server.end.name == self.name for server in self.graph.servers)
