"""Event that ends a launch."""

from __future__ import annotations

from .core import Event


class Shutdown(Event):
    name = "launch.events.Shutdown"

    def __init__(self, *, reason: str = "reason not given", due_to_sigint: bool = False) -> None:
        self.reason, self.due_to_sigint = reason, due_to_sigint
