"""Actions that more than one package uses."""

from __future__ import annotations

import asyncio
import os
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from .core import Action
from .substitutions import LaunchConfiguration
from .utilities import normalize_to_list_of_substitutions, perform_substitutions

if TYPE_CHECKING:
    from .core import Condition, LaunchContext, LaunchDescriptionEntity
    from .launch_description import LaunchDescription
    from .launch_description_sources import PythonLaunchDescriptionSource
    from .utilities import Part


class DeclareLaunchArgument(Action):
    def __init__(
        self,
        name: str,
        *,
        default_value: str | None = None,
        description: str | None = None,
        choices: Sequence[str] | None = None,
        condition: Condition | None = None,
    ) -> None:
        super().__init__(condition=condition)
        self.name, self.default_value = name, default_value

    def execute(self, context: LaunchContext) -> None:
        if self.name not in context.launch_configurations:
            if self.default_value is None:
                raise RuntimeError(f'Required launch argument "{self.name}" was not provided.')
            context.launch_configurations[self.name] = self.default_value


class IncludeLaunchDescription(Action):
    def __init__(
        self,
        launch_description_source: PythonLaunchDescriptionSource,
        *,
        launch_arguments: Iterable[tuple[str, str]] | None = None,
        condition: Condition | None = None,
    ) -> None:
        super().__init__(condition=condition)
        self._source, self._arguments = launch_description_source, launch_arguments or ()

    def execute(self, context: LaunchContext) -> list[LaunchDescription]:
        description = self._source.get_launch_description(context)
        context.launch_configurations.update(self._arguments)
        return [description]


class OpaqueFunction(Action):
    def __init__(
        self,
        *,
        function: Callable[..., Iterable[LaunchDescriptionEntity] | None],
        args: Iterable[object] | None = None,
        kwargs: Mapping[str, object] | None = None,
        condition: Condition | None = None,
    ) -> None:
        super().__init__(condition=condition)
        self._function, self._args, self._kwargs = function, args or (), kwargs or {}

    def execute(self, context: LaunchContext) -> Iterable[LaunchDescriptionEntity] | None:
        return self._function(context, *self._args, **self._kwargs)


class PushLaunchConfigurations(Action):
    def execute(self, context: LaunchContext) -> None:
        context._push_launch_configurations()


class PopLaunchConfigurations(Action):
    def execute(self, context: LaunchContext) -> None:
        context._pop_launch_configurations()


class GroupAction(Action):
    def __init__(
        self,
        actions: Iterable[Action],
        *,
        scoped: bool = True,
        forwarding: bool = True,
        launch_configurations: Mapping[str, str] | None = None,
        condition: Condition | None = None,
    ) -> None:
        super().__init__(condition=condition)
        self._actions, self._scoped = list(actions), scoped

    def execute(self, context: LaunchContext) -> list[Action]:
        if self._scoped:
            return [PushLaunchConfigurations(), *self._actions, PopLaunchConfigurations()]
        return self._actions


class ExecuteProcess(Action):
    def __init__(
        self,
        *,
        cmd: Iterable[Part | Iterable[Part]],
        prefix: Part | Iterable[Part] | None = None,
        name: Part | Iterable[Part] | None = None,
        additional_env: Mapping[Part, Part] | None = None,
        output: Part | Iterable[Part] = "log",
        condition: Condition | None = None,
    ) -> None:
        super().__init__(condition=condition)
        self._cmd = [normalize_to_list_of_substitutions(word) for word in cmd]
        self._prefix = LaunchConfiguration("launch-prefix", default="") if prefix is None else prefix
        self._name = name
        self.output = normalize_to_list_of_substitutions(os.environ.get("OVERRIDE_LAUNCH_PROCESS_OUTPUT", output))
        self.additional_env: list[tuple[list[Part], list[Part]]] | None = None
        if additional_env is not None:
            self.additional_env = [
                (normalize_to_list_of_substitutions(key), normalize_to_list_of_substitutions(value))
                for key, value in additional_env.items()
            ]
        self._completed: asyncio.Future[None] | None = None

    @property
    def cmd(self) -> list[list[Part]]:
        return self._cmd

    def execute(self, context: LaunchContext) -> None:
        if context.is_shutdown:
            return
        prefix = perform_substitutions(context, normalize_to_list_of_substitutions(self._prefix))
        words = shlex.split(prefix) + [perform_substitutions(context, word) for word in self.cmd]
        name = self._name and perform_substitutions(context, normalize_to_list_of_substitutions(self._name))
        print(f"[INFO] [{name or os.path.basename(words[0])}-1]: process started with pid [0]")
        assert context.asyncio_loop is not None
        self._completed = context.asyncio_loop.create_task(self._run(words))

    async def _run(self, words: Sequence[str]) -> None:
        await (await asyncio.create_subprocess_exec(*words)).wait()

    def get_asyncio_future(self) -> asyncio.Future[None] | None:
        return self._completed
