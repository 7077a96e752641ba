"""Actions that more than one package uses."""

import asyncio
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
                raise RuntimeError(f"Required launch argument '{self.name}' was not provided.")
            context.launch_configurations[self.name] = self.default_value


class GroupAction(Action):
    def __init__(self, actions, **rest):
        super().__init__(**rest)
        self.actions = actions

    def execute(self, context):
        return self.actions


class ExecuteProcess(Action):
    def __init__(self, *, cmd, prefix=None, additional_env=None, output="log", **rest):
        super().__init__(**rest)
        self.cmd = [normalize_to_list_of_substitutions(word) for word in cmd]
        self.prefix = LaunchConfiguration("launch-prefix", default="") if prefix is None else prefix
        self.additional_env = None
        if additional_env is not None:
            pairs = additional_env.items()
            self.additional_env = [tuple(map(normalize_to_list_of_substitutions, pair)) for pair in pairs]
        self.process = None

    def execute(self, context):
        prefix = perform_substitutions(context, normalize_to_list_of_substitutions(self.prefix))
        words = shlex.split(prefix) + [perform_substitutions(context, word) for word in self.cmd]
        self.process = context.asyncio_loop.create_task(self.run(words))

    async def run(self, words):
        return await (await asyncio.create_subprocess_exec(*words)).wait()

    def get_asyncio_future(self):
        return self.process
