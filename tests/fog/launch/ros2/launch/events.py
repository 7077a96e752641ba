"""The event that ends a launch."""


class Shutdown:
    def __init__(self, *, reason="reason not given", due_to_sigint=False):
        self.reason = reason
