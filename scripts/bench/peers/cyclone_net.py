"""Cyclone DDS on the row, unsecured: peers by address, no multicast, the kernel forwards IPv4.

I/O. Starts processes. All other settings are the defaults of Cyclone, including its packet sizes.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Final

from topologies import LEFT, RIGHT

from peers.baseline import READY_S, Measured, ask_end, start_end
from peers.chain import NODES, Chain, address
from peers.exchange import Load
from peers.process import Started

_MODULE: Final = "peers.cyclone_endpoint"


def cyclone_xml(own: str, other: str) -> str:
    """Return the configuration of an end at the address ``own``, of IPv4 or IPv6, whose only peer is at ``other``."""
    transport = "<Transport>udp6</Transport>" if ":" in own else ""
    return (
        f'<CycloneDDS><Domain id="any"><General>{transport}<Interfaces><NetworkInterface address="{own}"/></Interfaces>'
        "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f'<MaxAutoParticipantIndex>1</MaxAutoParticipantIndex><Peers><Peer address="{other}"/></Peers></Discovery>'
        "</Domain></CycloneDDS>"
    )


class CycloneNet:
    """Cyclone DDS, reliable."""

    name = "cyclone"
    labels = ("cyclone",)

    def measure(self, chain: Chain, load: Load) -> list[Measured]:
        """Start B, then A.

        Raises:
            FailedError: as ``Baseline.measure``.
        """
        with ExitStack() as stack:
            pong = stack.enter_context(_end(chain, RIGHT, load, {}))
            pong.read(READY_S)
            ping = stack.enter_context(_end(chain, LEFT, load, {"receiver": [pong.pid]}))
            return ask_end(ping, {"cyclone": self.name})


def _end(chain: Chain, node: str, load: Load, pids: dict[str, list[int]]) -> Started:
    left, right = address(LEFT, NODES[1]), address(RIGHT, NODES[-2])
    own, other = (left, right) if node == LEFT else (right, left)
    return start_end(chain, _MODULE, node, load, {"xml": cyclone_xml(own, other)}, pids)
