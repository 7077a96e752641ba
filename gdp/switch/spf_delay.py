"""SPF delay: when to compute paths after changes; at once in quiet times, less often while changes continue.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: RFC 8405, sections 5 and 6. The delays are shorter
than its examples, for domains are small. Losses at this switch's own ports are handled without a delay. A loss
elsewhere never waits the long delay, as frames vanish or circle until all switches know it; links that come and go are
damped at their ends (``damping.py``)::

    QUIET --news--> SHORT_WAIT --time to learn is over--> LONG_WAIT
      ^-- hold-down ----'    ^------- hold-down ----------' (to QUIET)
"""

from __future__ import annotations

from enum import Enum
from typing import Final

from gdp.due_queue import earliest

TIME_TO_LEARN_S: Final = 0.5
HOLD_DOWN_S: Final = 2.0


class SpfState(Enum):
    """State of the back-off."""

    QUIET = "quiet"
    SHORT_WAIT = "short-wait"
    LONG_WAIT = "long-wait"


class SpfEvent(Enum):
    """Event that changes the state."""

    NEWS = "news"  # a link state that changes paths
    LEARNED = "learned"  # TIME_TO_LEARN_S after the first of them
    HELD_DOWN = "held-down"  # HOLD_DOWN_S after the last of them


_S, _E = SpfState, SpfEvent
TRANSITIONS: Final[dict[tuple[SpfState, SpfEvent], SpfState]] = {
    (_S.QUIET, _E.NEWS): _S.SHORT_WAIT,
    (_S.QUIET, _E.LEARNED): _S.QUIET,
    (_S.QUIET, _E.HELD_DOWN): _S.QUIET,
    (_S.SHORT_WAIT, _E.NEWS): _S.SHORT_WAIT,
    (_S.SHORT_WAIT, _E.LEARNED): _S.LONG_WAIT,
    (_S.SHORT_WAIT, _E.HELD_DOWN): _S.QUIET,
    (_S.LONG_WAIT, _E.NEWS): _S.LONG_WAIT,
    (_S.LONG_WAIT, _E.LEARNED): _S.LONG_WAIT,
    (_S.LONG_WAIT, _E.HELD_DOWN): _S.QUIET,
}
# INITIAL_SPF_DELAY, SHORT_SPF_DELAY and LONG_SPF_DELAY
_DELAYS_S: Final = {_S.QUIET: 0.005, _S.SHORT_WAIT: 0.05, _S.LONG_WAIT: 0.3}


class SpfDelay:
    """The SPF back-off of one switch; ``due_s``: monotonic second at which paths are to be computed, or None."""

    def __init__(self) -> None:
        self.state = SpfState.QUIET
        self.due_s: float | None = None
        self._learned_s = float("inf")
        self._held_down_s = float("inf")

    def record_change(self, now_s: float, *, is_loss: bool = False) -> None:
        """Record that link states have changed paths; ``is_loss``: one that was there is gone."""
        self._settle(now_s)
        if self.state is SpfState.QUIET:
            self._learned_s = now_s + TIME_TO_LEARN_S
        pace = SpfState.SHORT_WAIT if is_loss and self.state is SpfState.LONG_WAIT else self.state
        self.due_s = earliest(self.due_s, now_s + _DELAYS_S[pace])
        self._held_down_s = now_s + HOLD_DOWN_S
        self.state = TRANSITIONS[self.state, SpfEvent.NEWS]

    def computed(self) -> None:
        """Record that paths match the link states now."""
        self.due_s = None

    def _settle(self, now_s: float) -> None:
        """Run the timers that were due since the last change; nothing else depends on them."""
        if now_s >= self._learned_s:
            self.state, self._learned_s = TRANSITIONS[self.state, SpfEvent.LEARNED], float("inf")
        if now_s >= self._held_down_s:
            self.state, self._held_down_s = TRANSITIONS[self.state, SpfEvent.HELD_DOWN], float("inf")
            self._learned_s = float("inf")
