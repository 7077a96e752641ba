"""Endpoint within this process: its graph has no middleware, and its nodes serve nothing.

I/O only for its descriptor.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from typing import ClassVar

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import Event
from proxy.serial.channel import RosVersion, Service


class InProcessEndpoint:
    """Queue of events, and the refusal of what needs a local server.

    Attributes:
        kind: what it is, for errors.
        is_live: whether nodes take part in it; a recording has none.
    """

    kind: ClassVar[str]
    is_live: bool = True

    def __init__(self) -> None:
        self._events = deque[Event]()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    @property
    def ros(self) -> RosVersion:
        """Return the dialect of its messages: CDR."""
        return 2

    @property
    def dropped(self) -> int:
        """Return 0: nothing is dropped."""
        return 0

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``poll_events`` has events."""
        return self._wake

    def poll_events(self) -> Sequence[Event]:
        """Remove and return the pending events, in order."""
        if not self._events:
            return ()
        os.eventfd_read(self._wake)
        events = list(self._events)
        self._events.clear()
        return events

    def service(self, name: str, type_name: str) -> Service:
        """Raise ``LocalError``: the definition of a server is used."""
        raise LocalError(f"{name}: {self.kind} has no definition of {type_name}; that of its server is used")

    def create_client(self, name: str, type_name: str) -> int:
        """Raise ``LocalError``: there is no local server."""
        raise LocalError(f"{name}: {self.kind} cannot serve {type_name}")

    def call(self, handle: int, call: int, raw: bytes) -> None:
        """Raise ``LocalError``: see ``create_client``."""
        del call, raw
        raise LocalError(f"handle {handle} is no client")

    def drop(self, handle: int, call: int) -> None:
        """Do nothing: no call was begun."""

    def shut_down(self) -> None:
        """Free the descriptor."""
        os.close(self._wake)

    def _put(self, event: Event) -> None:
        self._events.append(event)
        os.eventfd_write(self._wake, 1)
