"""Choice between the UDP tunnel and the TLS relay to one border, with damping.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). UDP is always tried. The relay runs while the tunnel has had
no handshake for a while, and until the tunnel has then been up without a break for ``stable_s``. In between both are
up, and routing prefers the tunnel, because the relay's port costs more::

             no handshake for start_s or lost_s
    UDP ------------------------------------------> TLS
     ^                                               |
     +--------- up for stable_s, no break -----------+
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True, kw_only=True)
class RelayChoice:
    """Decision for one border.

    Args:
        begun_s: monotonic second of the start.
        start_s: seconds for the first handshake of the tunnel, before the relay starts.
        lost_s: seconds without the tunnel later, before the relay starts.
        stable_s: seconds for which the tunnel is up without a break, before the relay stops.
    """

    begun_s: float
    start_s: float = 5.0
    lost_s: float = 3.0
    stable_s: float = 30.0
    _was_up: bool = False
    _is_up: bool = False
    _since_s: float | None = None
    _relays: bool = False

    def update(self, now_s: float, *, is_udp_up: bool) -> bool:
        """Take in whether the tunnel is up now; return whether the relay is to run."""
        if self._since_s is None:
            self._since_s = self.begun_s
        if is_udp_up is not self._is_up:
            self._is_up, self._since_s = is_udp_up, now_s
        self._was_up |= is_udp_up
        if now_s >= self._due_s():
            self._relays = not is_udp_up
        return self._relays

    def next_due_s(self) -> float | None:
        """Return the monotonic second at which the answer changes if the tunnel stays as it is; None: never."""
        return None if self._relays is not self._is_up else self._due_s()

    def _due_s(self) -> float:
        since_s = self.begun_s if self._since_s is None else self._since_s
        if self._is_up:
            return since_s + self.stable_s
        return since_s + (self.lost_s if self._was_up else self.start_s)
