"""Questions of ``ros2 launch`` before it loads a launch file."""

from __future__ import annotations

import argparse

from ros2cli.plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version


class OptionExtension:
    NAME: str | None = None

    def __init__(self) -> None:
        satisfies_version(PLUGIN_SYSTEM_VERSION, "^0.1")

    def prestart(self, args: argparse.Namespace) -> None:
        pass
