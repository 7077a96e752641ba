"""Reminder schedule of connections that a ROS 1 graph should have and lacks.

Sans-I/O. rospy connects to a publisher when the master announces it. If the handshake fails, because the publisher is
just being replaced, the subscriber keeps the failed connection for a second. Meanwhile it ignores the announcement of
the new publisher, and afterwards nothing announces it. So a connection that stays missing is announced again, with
growing delays: a connection that can never exist costs little.
"""

from __future__ import annotations

from collections.abc import Hashable, Set
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

__all__ = ["MissingConnections"]

_FIRST_S: Final = 1.5  # rospy drops a failed connection after 1 s
_LONGEST_S: Final = 60.0

_Connection = TypeVar("_Connection", bound=Hashable)


@dataclass(slots=True)
class _Reminder:
    due_s: float
    delay_s: float


class MissingConnections(Generic[_Connection]):
    """Missing connections, each with the time of its next reminder."""

    def __init__(self) -> None:
        self._reminders: dict[_Connection, _Reminder] = {}

    def due(self, missing: Set[_Connection], now_s: float) -> list[_Connection]:
        """Return the connections to announce again.

        Args:
            missing: all connections that are missing now.
            now_s: monotonic seconds.
        """
        self._reminders = {each: kept for each, kept in self._reminders.items() if each in missing}
        for each in missing - self._reminders.keys():
            self._reminders[each] = _Reminder(now_s + _FIRST_S, _FIRST_S)
        found = [each for each, reminder in self._reminders.items() if now_s >= reminder.due_s]
        for each in found:
            reminder = self._reminders[each]
            reminder.delay_s = min(2 * reminder.delay_s, _LONGEST_S)
            reminder.due_s = now_s + reminder.delay_s
        return found
