"""Handler of a launch's end."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from .event_handler import BaseEventHandler, Entities
from .events import Shutdown

if TYPE_CHECKING:
    from .core import Event, LaunchContext


class OnShutdown(BaseEventHandler):
    def __init__(self, *, on_shutdown: Callable[[Event, LaunchContext], Entities], handle_once: bool = False) -> None:
        super().__init__(matcher=lambda event: isinstance(event, Shutdown), handle_once=handle_once)
        self._on_shutdown = on_shutdown

    def handle(self, event: Event, context: LaunchContext) -> Entities:
        super().handle(event, context)
        return self._on_shutdown(event, context)
