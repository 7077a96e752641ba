"""Planner of a switch's direct tunnels: from endpoint records, links and the operator's tunnels to actions.

Sans-I/O. ``direct_tunnels.py`` decides about each peer; the I/O layer carries out what it returns.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from gdp.control.endpoints import EndpointRecord
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.switch.direct_tunnels import Action, DirectTunnels
from gdp.switch.endpoint_exchange import EndpointExchange
from gdp.switch.forwarding_state import ForwardingState


class TunnelPlanner:
    """Plans the direct tunnels of one switch.

    Args:
        endpoints: exchange of endpoint records with the RIB.
        wake: called when its timer has changed.
    """

    def __init__(self, state: ForwardingState, endpoints: EndpointExchange, wake: Callable[[], None]) -> None:
        self._state = state
        self.endpoints = endpoints
        self._wake = wake
        self._tunnels = DirectTunnels(state.me)
        self._ports: dict[int, Name] = {}  # ports of direct tunnels
        self._configured: frozenset[Name] = frozenset()  # peers of the operator's tunnels

    def publish_endpoints(self, record: EndpointRecord) -> None:
        """Publish this switch's endpoint record to the RIB; from the first one on, it learns those of other switches.

        Raises:
            StatementError: STALE, its sequence is not higher than that of the one before.
        """
        self.endpoints.set_own(record)
        self._wake()

    def set_configured_peers(self, names: Collection[Name]) -> None:
        """Set the switches to which the operator configured a tunnel: no direct tunnel to them is opened."""
        self._configured = frozenset(names)

    def set_direct_port(self, index: int, peer: Name | None) -> None:
        """State that a port is the direct tunnel to a switch; None: it is an ordinary port."""
        self._ports.pop(index, None)
        if peer is not None:
            self._ports[index] = peer

    def answered(self, name: Name, now: Timestamps) -> None:
        """Record that WireGuard completed a handshake with a peer of ``poll_actions``."""
        self._tunnels.answered(name, now.mono_s)

    def failure(self, name: Name) -> str:
        """Return why the direct tunnel to a peer is not up; empty: it is up, or too young to say."""
        return self._tunnels.failure(name)

    def poll_actions(self, now: Timestamps) -> list[Action]:
        """Return, once, what to do about direct tunnels; to be called about ten times a second.

        Empty until ``publish_endpoints``.
        """
        own = self.endpoints.own
        if own is None:
            return []
        up = self._state.neighbours.all_up()
        linked = {each.name for each in up if each.port not in self._ports} | self._configured
        wanted = self._tunnels.peers(self._state.paths.members(), linked)
        due_s = self.endpoints.get_timer()
        self.endpoints.want(wanted, now.mono_s)
        if self.endpoints.get_timer() != due_s:
            self._wake()
        return self._tunnels.poll_actions(
            own=own,
            records=self.endpoints.records(now),
            linked=linked,
            up={each.name for each in up if self._ports.get(each.port) == each.name},
            now_s=now.mono_s,
        )
