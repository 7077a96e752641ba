"""Reminder schedule of connections that a ROS 1 graph should have and lacks.

Sans-I/O. rospy connects to a publisher when the master announces it. If the handshake fails, because the publisher is
just being replaced, the subscriber keeps the failed connection for a second. Meanwhile it ignores the announcement of
the new publisher, and afterwards nothing announces it. So a connection that stays missing is announced again, with
growing delays: a connection that can never exist costs little.
"""

from __future__ import annotations

from collections.abc import Hashable, Set
from typing import Final, Generic, TypeVar

from gdp.requests import Backoff, Requests

_REMINDERS: Final = Backoff(1.5, 60.0)  # rospy drops a failed connection after 1 s

_Connection = TypeVar("_Connection", bound=Hashable)


class MissingConnections(Generic[_Connection]):
    """Missing connections, each with the time of its next reminder."""

    def __init__(self) -> None:
        self._reminders = Requests[_Connection]()

    def due(self, missing: Set[_Connection], now_s: float) -> list[_Connection]:
        """Return the connections to announce again.

        Args:
            missing: all connections that are missing now.
            now_s: monotonic seconds.
        """
        for each in self._reminders.keys() - missing:
            self._reminders.cancel(each)
        for each in missing - self._reminders.keys():
            self._reminders.start(each, now_s)
            self._reminders.sent(each, now_s, _REMINDERS)  # the master has announced it
        found = self._reminders.poll_due(now_s)
        for each in found:
            self._reminders.sent(each, now_s, _REMINDERS)
        return found
