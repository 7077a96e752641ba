"""What happens when a launch ends."""


class OnShutdown:
    def __init__(self, *, on_shutdown):
        self.on_shutdown = on_shutdown

    def handle(self, event, context):
        return self.on_shutdown(event, context)
