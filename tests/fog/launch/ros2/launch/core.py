"""Actions, the context, and the service that visits entities, handles events and shuts down when idle."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from .event_handler import BaseEventHandler


class Condition(Protocol):
    def evaluate(self, context: LaunchContext) -> bool: ...


class Event:
    name = "launch.Event"


class LaunchDescriptionEntity:
    def visit(self, context: LaunchContext) -> Iterable[LaunchDescriptionEntity] | None:
        return None

    def get_asyncio_future(self) -> asyncio.Future[None] | None:
        return None


class Action(LaunchDescriptionEntity):
    def __init__(self, *, condition: Condition | None = None) -> None:
        self._condition = condition

    @property
    def condition(self) -> Condition | None:
        return self._condition

    def visit(self, context: LaunchContext) -> Iterable[LaunchDescriptionEntity] | None:
        if self.condition is None or self.condition.evaluate(context):
            return self.execute(context)
        return None

    def execute(self, context: LaunchContext) -> Iterable[LaunchDescriptionEntity] | None:
        return None


class LaunchContext:
    def __init__(self, *, argv: Sequence[str] | None = None, noninteractive: bool = False) -> None:
        self._configurations: dict[str, str] = {}
        self._configurations_stack: list[dict[str, str]] = []
        self._locals: dict[str, object] = {}
        self._event_queue = asyncio.Queue[Event]()
        self._event_handlers: list[BaseEventHandler] = []
        self.asyncio_loop: asyncio.AbstractEventLoop | None = None
        self.is_shutdown = False

    @property
    def launch_configurations(self) -> dict[str, str]:
        return self._configurations

    def _push_launch_configurations(self) -> None:
        self._configurations_stack.append(self._configurations.copy())

    def _pop_launch_configurations(self) -> None:
        if not self._configurations_stack:
            raise RuntimeError("launch_configurations stack unexpectedly empty")
        self._configurations = self._configurations_stack.pop()

    @property
    def locals(self) -> SimpleNamespace:
        return SimpleNamespace(**self._locals)

    def extend_locals(self, extensions: Mapping[str, object]) -> None:
        self._locals.update(extensions)

    def register_event_handler(self, event_handler: BaseEventHandler, append: bool = False) -> None:
        self._event_handlers.insert(len(self._event_handlers) if append else 0, event_handler)

    async def emit_event(self, event: Event) -> None:
        await self._event_queue.put(event)


class LaunchService:
    """``run`` returns 1 if an action, a handler or a future of an action raised something, else 0."""

    def __init__(self, *, argv: Sequence[str] | None = None, noninteractive: bool = False, debug: bool = False) -> None:
        self.context = LaunchContext(argv=argv, noninteractive=noninteractive)
        self._included: list[LaunchDescriptionEntity] = []
        self._pending: list[asyncio.Future[None]] = []

    def include_launch_description(self, launch_description: LaunchDescriptionEntity) -> None:
        self._included.append(launch_description)

    def run(self, *, shutdown_when_idle: bool = True) -> int:
        return asyncio.run(self.run_async(shutdown_when_idle=shutdown_when_idle))

    def _visit(self, entity: LaunchDescriptionEntity) -> None:
        inner = entity.visit(self.context)
        if (future := entity.get_asyncio_future()) is not None:
            self._pending.append(future)
        for each in inner or ():
            self._visit(each)

    def _handle(self, event: Event) -> None:
        from .events import Shutdown

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

    def _shut_down(self, reason: str) -> None:
        from .events import Shutdown

        self._handle(Shutdown(reason=reason))

    async def run_async(self, *, shutdown_when_idle: bool = True) -> int:
        code = 0
        queue = self.context._event_queue
        self.context.asyncio_loop = asyncio.get_running_loop()
        work: list[Callable[[], None]] = [partial(self._visit, each) for each in self._included]
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
                    self._shut_down("idle")
                    continue
                event = asyncio.ensure_future(queue.get())
                waiting: list[asyncio.Future[Event] | asyncio.Future[None]] = [event, *self._pending]
                done, _ = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
                if event in done:
                    self._handle(event.result())
                else:
                    event.cancel()
                for future in done - {event}:
                    future.result()
            except Exception as error:
                code = 1
                print(f"[ERROR] [launch]: Caught exception in launch (see debug for traceback): {error}")
                work.append(partial(self._shut_down, str(error)))
