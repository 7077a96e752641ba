"""Exclusive control of a topic: of its far publishers one holds control, and its silence is answered by a stop.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: DDS 1.4, section 2.2.3.9 (OWNERSHIP, exclusive), with
an owner chosen by request in place of a strength; IEC 60204-1, section 9.2.3.7 (hold-to-run control)::

    FREE -- take --> HELD -- silent --> SILENT -- a message --> HELD
                     give to another: HELD;   give, or silent and without a route: FREE
"""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum

from gdp.errors import DropReason, LocalError
from gdp.intervals import TICK_S
from gdp.names import Name


class ControlState(Enum):
    """State of a topic under exclusive control."""

    FREE = "free"
    HELD = "held"
    SILENT = "silent"  # the holder has sent nothing for longer than the rule allows


class ExclusiveControl:
    """Control of one topic.

    Args:
        silence_s: after which a silent holder counts as absent; None: never.
        generation: a random one.

    Attributes:
        holder: the publisher in control; None: none is.
        generation: another one after each request that was granted.
        refused: messages that did not pass.
    """

    def __init__(self, silence_s: float | None, generation: int) -> None:
        self._silence_s = silence_s
        self.generation = generation
        self.holder: Name | None = None
        self.refused = 0
        self._since_ns = 0  # the holder's clock when it took control
        self._heard_s = 0.0  # its newest message, or when control began
        self._check_s = 0.0  # when its route is looked at again
        self._is_moving = False  # a message has passed that no stop has ended

    def state(self, now_s: float) -> ControlState:
        """Return the state now."""
        if self.holder is None:
            return ControlState.FREE
        is_silent = self._silence_s is not None and now_s >= self._heard_s + self._silence_s
        return ControlState.SILENT if is_silent else ControlState.HELD

    def take(self, publisher: Name, now_s: float, *, since_ns: int, force: bool) -> None:
        """Give control to a publisher that asks for it.

        Args:
            since_ns: its wall clock when it asked; what it sent before never passes.
            force: take it from another holder.

        Raises:
            LocalError: another publisher holds control.
        """
        if self.holder not in (None, publisher) and not force:
            raise LocalError("another publisher holds control; ask it to give control, or take it with --force")
        self._begin(publisher, now_s, since_ns)

    def give(self, to: Name | None, now_s: float) -> None:
        """Give control to another publisher, or to none: that is answered by a stop at once."""
        self._begin(to, now_s, 0)

    def refusal(self, publisher: bytes, stamp_ns: int, age_s: float, now_s: float) -> DropReason | None:
        """Take a message; return why it does not pass, or None.

        Args:
            stamp_ns: the publisher's wall clock when it sent the message.
            age_s: least time for which it has been under way; 0: not known.
        """
        reason = None
        if publisher != self.holder:
            reason = DropReason.NOT_IN_CONTROL
        elif stamp_ns < self._since_ns or (self._silence_s is not None and age_s > self._silence_s):
            reason = DropReason.LATE
        if reason is not None:
            self.refused += 1
            return reason
        self._heard_s, self._is_moving = now_s, True
        return None

    def poll_stop(self, known: Collection[bytes], now_s: float) -> bool:
        """Return, once, whether the message of stop is due.

        Args:
            known: publishers that have a route and the right to publish.
        """
        self._check_s = now_s + TICK_S
        is_held = self.state(now_s) is ControlState.HELD
        if self.holder not in known and not (is_held and self._silence_s is not None):
            self.holder = None
        is_due = self._is_moving and not (is_held and self.holder is not None)
        self._is_moving &= not is_due
        return is_due

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self.holder is None:
            return 0.0 if self._is_moving else None
        if self._silence_s is None or not self._is_moving:
            return self._check_s
        return min(self._heard_s + self._silence_s, self._check_s)

    def _begin(self, holder: Name | None, now_s: float, since_ns: int) -> None:
        self.holder, self._heard_s, self._since_ns = holder, now_s, since_ns
        self.generation += 1
