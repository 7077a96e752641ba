"""Actions that more than one package uses."""

import asyncio
import os
import shlex

from launch.core import Action
from launch.substitutions import LaunchConfiguration
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions


class DeclareLaunchArgument(Action):
    def __init__(self, name, *, default_value=None, description=None, choices=None, **rest):
        super().__init__(**rest)
        self.name, self.default_value = name, default_value

    def execute(self, context):
        if self.name not in context.launch_configurations:
            if self.default_value is None:
                raise RuntimeError(f'Required launch argument "{self.name}" was not provided.')
            context.launch_configurations[self.name] = self.default_value


class IncludeLaunchDescription(Action):
    def __init__(self, launch_description_source, *, launch_arguments=None, **rest):
        super().__init__(**rest)
        self._source, self._arguments = launch_description_source, launch_arguments or ()

    def execute(self, context):
        description = self._source.get_launch_description(context)
        context.launch_configurations.update(self._arguments)
        return [description]


class OpaqueFunction(Action):
    def __init__(self, *, function, args=None, kwargs=None, **rest):
        super().__init__(**rest)
        self._function, self._args, self._kwargs = function, args or (), kwargs or {}

    def execute(self, context):
        return self._function(context, *self._args, **self._kwargs)


class PushLaunchConfigurations(Action):
    def execute(self, context):
        context._push_launch_configurations()


class PopLaunchConfigurations(Action):
    def execute(self, context):
        context._pop_launch_configurations()


class GroupAction(Action):
    def __init__(self, actions, *, scoped=True, forwarding=True, launch_configurations=None, **rest):
        super().__init__(**rest)
        self._actions, self._scoped = list(actions), scoped

    def execute(self, context):
        if self._scoped:
            return [PushLaunchConfigurations(), *self._actions, PopLaunchConfigurations()]
        return self._actions


class ExecuteProcess(Action):
    def __init__(self, *, cmd, prefix=None, name=None, additional_env=None, output="log", **rest):
        super().__init__(**rest)
        self._cmd = [normalize_to_list_of_substitutions(word) for word in cmd]
        self._prefix = LaunchConfiguration("launch-prefix", default="") if prefix is None else prefix
        self._name = name
        self.output = normalize_to_list_of_substitutions(os.environ.get("OVERRIDE_LAUNCH_PROCESS_OUTPUT", output))
        self.additional_env = None
        if additional_env is not None:
            pairs = additional_env.items()
            self.additional_env = [tuple(map(normalize_to_list_of_substitutions, pair)) for pair in pairs]
        self._completed = None

    @property
    def cmd(self):
        return self._cmd

    def execute(self, context):
        if context.is_shutdown:
            return
        prefix = perform_substitutions(context, normalize_to_list_of_substitutions(self._prefix))
        words = shlex.split(prefix) + [perform_substitutions(context, word) for word in self.cmd]
        name = self._name and perform_substitutions(context, normalize_to_list_of_substitutions(self._name))
        print(f"[INFO] [{name or os.path.basename(words[0])}-1]: process started with pid [0]")
        self._completed = context.asyncio_loop.create_task(self._run(words))

    async def _run(self, words):
        await (await asyncio.create_subprocess_exec(*words)).wait()

    def get_asyncio_future(self):
        return self._completed
