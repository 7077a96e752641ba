"""Simulated network that records which frames were caused by a hostile member's frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from gdp.frame.codec import ETHER_BYTES, HOPS_AT
from gdp.sansio import OutgoingFrames
from lab.network import SimNetwork

__all__ = ["Echo", "TracingNetwork"]


@dataclass(slots=True)
class Echo:
    """Effect of one utterance on all nodes, as far as frames caused it; timers are not attributed.

    Args:
        said: its frames. A machine that forwards one of them once acts like a data plane.

    Attributes:
        sent: bytes after the Ethernet header that machines sent, by node.
        forwarded: bytes that were carried, copies of multicast included.
    """

    said: tuple[bytes, ...] = ()
    sent: Counter[str] = field(default_factory=Counter)
    forwarded: Counter[str] = field(default_factory=Counter)
    _carried: set[tuple[str, bytes]] = field(default_factory=set)  # by machines

    def note(self, node: str, frame: bytes, *, is_machine: bool) -> None:
        """Count a frame (from its header on) that a node sends."""
        is_carried = not is_machine
        if is_machine and (body := _but_hops(frame)) in map(_but_hops, self.said):
            is_carried = (node, body) not in self._carried
            self._carried.add((node, body))
        (self.forwarded if is_carried else self.sent)[node] += len(frame)

    @property
    def most(self) -> int:
        """Return the bytes that the busiest machine sent."""
        return max(self.sent.values(), default=0)


class TracingNetwork(SimNetwork):
    """Network that traces frames: those a machine sends while it takes a traced frame are traced, too.

    Attributes:
        echo: trace of the frame in delivery; None: of no traced frame.
    """

    echo: Echo | None = None
    _is_machine = False  # a frame that enters a link now is from a machine

    def _push(self, at_s: float, action: Callable[..., object], *arguments: object) -> None:
        if self.echo is None:
            super()._push(at_s, action, *arguments)
        else:
            super()._push(at_s, self._under, self.echo, action, *arguments)

    def _under(self, echo: Echo, action: Callable[..., object], *arguments: object) -> object:
        self.echo = echo
        try:
            return action(*arguments)
        finally:
            self.echo = None

    def _arm(self, name: str) -> None:
        echo, self.echo = self.echo, None
        super()._arm(name)
        self.echo = echo

    def _transmit(self, node: Any, transmit: OutgoingFrames) -> None:
        self._is_machine = True
        super()._transmit(node, transmit)
        self._is_machine = False

    def _send(self, wired: Any, frame: bytes) -> None:
        if self.echo is not None:
            self.echo.note(wired[1].node, frame[ETHER_BYTES:], is_machine=self._is_machine)
        super()._send(wired, frame)


def _but_hops(frame: bytes) -> bytes:
    """Return a frame without the field that changes on its path."""
    return frame[:HOPS_AT] + frame[HOPS_AT + 1 :]
