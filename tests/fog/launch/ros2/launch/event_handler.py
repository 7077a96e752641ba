"""Base of event handlers."""


class BaseEventHandler:
    def __init__(self, *, matcher, handle_once=False):
        self._matcher = matcher

    def matches(self, event):
        return self._matcher(event)

    def handle(self, event, context):
        context.extend_locals({"event": event})
