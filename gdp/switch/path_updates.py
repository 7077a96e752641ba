"""Path updates: everything at a switch that depends on paths follows a change of links.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Link states come in bursts, so an update covers the changes
that follow closely (``spf_delay.py``). Alternates are not urgent: they are computed a little after the paths.
"""

from __future__ import annotations

from typing import Final

from gdp.control.neighbour_discovery import HelloProtocol
from gdp.crypto.certificates import Role
from gdp.due_queue import earliest
from gdp.intervals import UPKEEP_S
from gdp.switch.flooding import Flooding
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.location_updates import LocationUpdates
from gdp.switch.multicast import MulticastTrees
from gdp.switch.rib_client import RibClient
from gdp.switch.spf_delay import SpfDelay
from gdp.switch.unicast import Unicast

_PROTECT_S: Final = 0.1  # from new paths to their alternates


class PathUpdates:
    """Recomputes routes and trees of one switch, and checks identities, when link states have changed."""

    def __init__(
        self,
        state: ForwardingState,
        *,
        flooding: Flooding,
        hello_protocol: HelloProtocol,
        multicast: MulticastTrees,
        unicast: Unicast,
        rib_client: RibClient,
        locations: LocationUpdates,
    ) -> None:
        self._state = state
        self._flooding = flooding
        self._hello_protocol = hello_protocol
        self._multicast = multicast
        self._unicast = unicast
        self._rib_client = rib_client
        self._locations = locations
        self._spf_delay = SpfDelay()
        self._seen_version = -1
        self._seen_losses = 0
        self._protect_at_s: float | None = None  # when alternates are computed
        self._followed_s = self._conflicts_sought_s = float("-inf")

    def neighbour_came(self) -> None:
        """Compute the hops to a neighbour that came up again, because it may have another address now."""
        self._seen_version = -1

    def plan(self, now_s: float) -> None:
        """Schedule an update if link states have changed."""
        link_states = self._flooding.link_states
        is_loss = link_states.losses != self._seen_losses
        if is_loss or (self._spf_delay.due_s is None and link_states.version != self._seen_version):
            self._spf_delay.record_change(now_s, is_loss=is_loss)
            self._seen_losses = link_states.losses

    def follow(self, now_s: float) -> None:
        """Update everything now if link states have changed."""
        self._spf_delay.computed()
        version = self._flooding.link_states.version
        if version == self._seen_version:
            return
        self._flooding.neighbour_changed(now_s)  # our domain's interior may have changed
        self._seen_version, self._seen_losses = self._flooding.link_states.version, self._flooding.link_states.losses
        self._followed_s = now_s
        self._state.paths.has_alternates, self._protect_at_s = False, now_s + _PROTECT_S
        self._unicast.refresh(now_s)
        self._multicast.reroute(now_s)
        self._rib_client.links_changed(now_s)
        self._locations.paths_changed(now_s)
        self._find_conflicts(now_s)

    def handle_timer(self, now_s: float, *, has_lost: bool) -> None:
        """Run the timers that are due; ``has_lost``: a neighbour was lost, so the update is not delayed."""
        if has_lost or (self._spf_delay.due_s is not None and self._spf_delay.due_s <= now_s):
            self.follow(now_s)
        else:
            self.plan(now_s)
        if self._protect_at_s is not None and self._protect_at_s <= now_s:
            self._protect_at_s = None
            self._state.paths.has_alternates = True
            self._unicast.refresh(now_s)
        if self._unicast.is_refreshing:
            self._unicast.refresh_more(now_s)
        if now_s >= self._conflicts_sought_s + UPKEEP_S:
            self._find_conflicts(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self._spf_delay.due_s, self._protect_at_s]
        if self._unicast.is_refreshing:
            times.append(self._followed_s)  # in the past: due at once
        if self._state.paths.refused_elsewhere():
            times.append(self._conflicts_sought_s + UPKEEP_S)
        return earliest(*times)

    def _find_conflicts(self, now_s: float) -> None:
        """Drop RIBs with an older node's identity; notify nodes whose identity a younger node elsewhere copies."""
        self._conflicts_sought_s = now_s
        for neighbour in self._state.neighbours.all_up():
            elsewhere = self._state.paths.incarnation_elsewhere(neighbour.name) if neighbour.role is Role.RIB else None
            if elsewhere is not None and elsewhere < neighbour.incarnation_id:
                self._hello_protocol.schedule_removal(neighbour, now_s)
        for name in self._state.paths.refused_elsewhere():
            self._hello_protocol.tell_conflicts(name, now_s)
            if name == self._state.me:
                self._hello_protocol.conflicts.record_clash(name, now_s)
