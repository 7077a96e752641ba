"""Actions, the context, and the service that visits entities, handles events and shuts down when idle."""

import asyncio


class Action:
    def __init__(self, *, condition=None):
        self.condition = condition

    def visit(self, context):
        if self.condition is None or self.condition.evaluate(context):
            return self.execute(context)
        return None

    def execute(self, context):
        return None

    def get_asyncio_future(self):
        return None


class LaunchContext:
    def __init__(self, *, argv=(), noninteractive=False):
        self.launch_configurations = {}
        self.locals = {}
        self.handlers = []
        self.asyncio_loop = None
        self.is_shutdown = False
        self.queue = None

    def extend_locals(self, more):
        self.locals.update(more)

    def register_event_handler(self, handler):
        self.handlers.insert(0, handler)

    async def emit_event(self, event):
        await self.queue.put(event)


class LaunchService:
    """``run_async`` returns when all is done, 1 if an event of ours said why it ended."""

    def __init__(self):
        self.context = LaunchContext()
        self.pending = []
        self.reason = None

    def collect(self, entity):
        for inner in entity.visit(self.context) or ():
            self.collect(inner)
        if (future := entity.get_asyncio_future()) is not None:
            self.pending.append(future)

    def shut_down(self, reason):
        if not self.context.is_shutdown:
            self.context.is_shutdown = True
            self.reason = reason
            for handler in tuple(self.context.handlers):
                entity = handler.handle(None, self.context)
                if entity is not None:
                    self.collect(entity)

    async def run_async(self, description):
        self.context.asyncio_loop = asyncio.get_running_loop()
        self.context.queue = asyncio.Queue()
        self.collect(description)
        while True:
            self.pending = [future for future in self.pending if not future.done()]
            if not self.pending and self.context.queue.empty():
                if self.context.is_shutdown:
                    return 0 if self.reason == "idle" else 1
                self.shut_down("idle")
                continue
            event = asyncio.ensure_future(self.context.queue.get())
            await asyncio.wait([event, *self.pending], return_when=asyncio.FIRST_COMPLETED)
            if event.done():
                self.shut_down(event.result().reason)
            else:
                event.cancel()
