"""Actions, the context, and the service that visits entities, handles events and shuts down when idle."""

import asyncio
from types import SimpleNamespace


class Event:
    name = "launch.Event"


class LaunchDescriptionEntity:
    def visit(self, context):
        return None

    def get_asyncio_future(self):
        return None


class Action(LaunchDescriptionEntity):
    def __init__(self, *, condition=None):
        self._condition = condition

    @property
    def condition(self):
        return self._condition

    def visit(self, context):
        if self.condition is None or self.condition.evaluate(context):
            return self.execute(context)
        return None

    def execute(self, context):
        return None


class LaunchContext:
    def __init__(self, *, argv=None, noninteractive=False):
        self._configurations = {}
        self._configurations_stack = []
        self._locals = {}
        self._event_queue = asyncio.Queue()
        self._event_handlers = []
        self.asyncio_loop = None
        self.is_shutdown = False

    @property
    def launch_configurations(self):
        return self._configurations

    def _push_launch_configurations(self):
        self._configurations_stack.append(self._configurations.copy())

    def _pop_launch_configurations(self):
        if not self._configurations_stack:
            raise RuntimeError("launch_configurations stack unexpectedly empty")
        self._configurations = self._configurations_stack.pop()

    @property
    def locals(self):
        return SimpleNamespace(**self._locals)

    def extend_locals(self, extensions):
        self._locals.update(extensions)

    def register_event_handler(self, event_handler, append=False):
        self._event_handlers.insert(len(self._event_handlers) if append else 0, event_handler)

    async def emit_event(self, event):
        await self._event_queue.put(event)


class LaunchService:
    """``run`` returns 1 if an action, a handler or a future of an action raised something, else 0."""

    def __init__(self, *, argv=None, noninteractive=False, debug=False):
        self.context = LaunchContext(argv=argv, noninteractive=noninteractive)
        self._included = []
        self._pending = []

    def include_launch_description(self, launch_description):
        self._included.append(launch_description)

    def run(self, *, shutdown_when_idle=True):
        return asyncio.run(self.run_async(shutdown_when_idle=shutdown_when_idle))

    def _visit(self, entity):
        inner = entity.visit(self.context)
        if (future := entity.get_asyncio_future()) is not None:
            self._pending.append(future)
        for each in inner or ():
            self._visit(each)

    def _handle(self, event):
        from launch.events import Shutdown

        if isinstance(event, Shutdown):
            if self.context.is_shutdown:
                return
            self.context.is_shutdown = True
        for handler in tuple(self.context._event_handlers):
            if handler.matches(event):
                entities = handler.handle(event, self.context)
                for entity in entities if isinstance(entities, list | tuple) else (entities,):
                    if entity is not None:
                        self._visit(entity)

    async def run_async(self, *, shutdown_when_idle=True):
        from launch.events import Shutdown

        code = 0
        queue = self.context._event_queue
        self.context.asyncio_loop = asyncio.get_running_loop()
        work = [lambda each=each: self._visit(each) for each in self._included]
        while True:
            try:
                while work:
                    work.pop(0)()
                while not queue.empty():
                    self._handle(queue.get_nowait())
                self._pending = [future for future in self._pending if not future.done()]
                if not self._pending and queue.empty():
                    if self.context.is_shutdown:
                        return code
                    self._handle(Shutdown(reason="idle"))
                    continue
                event = asyncio.ensure_future(queue.get())
                done, _ = await asyncio.wait([event, *self._pending], return_when=asyncio.FIRST_COMPLETED)
                if event in done:
                    self._handle(event.result())
                else:
                    event.cancel()
                for future in done - {event}:
                    future.result()
            except Exception as error:
                code = 1
                print(f"[ERROR] [launch]: Caught exception in launch (see debug for traceback): {error}")
                work.append(lambda reason=str(error): self._handle(Shutdown(reason=reason)))
