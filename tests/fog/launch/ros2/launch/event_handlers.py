"""Handler of a launch's end."""

from launch.event_handler import BaseEventHandler
from launch.events import Shutdown


class OnShutdown(BaseEventHandler):
    def __init__(self, *, on_shutdown, **rest):
        super().__init__(matcher=lambda event: isinstance(event, Shutdown), **rest)
        self._on_shutdown = on_shutdown

    def handle(self, event, context):
        super().handle(event, context)
        return self._on_shutdown(event, context)
