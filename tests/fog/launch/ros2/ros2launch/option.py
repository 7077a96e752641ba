"""Questions of ``ros2 launch`` before it loads a launch file."""

from ros2cli.plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version


class OptionExtension:
    NAME = None

    def __init__(self):
        satisfies_version(PLUGIN_SYSTEM_VERSION, "^0.1")

    def prestart(self, args):
        return
