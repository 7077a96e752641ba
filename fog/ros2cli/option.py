"""Option of ``ros2 launch``: every launch file may construct a ``FogCluster`` without returning it.

I/O; imported by ros2launch through the entry point ``ros2launch.option``, before it loads a launch file.
Source: ros2launch 0.26 (jazzy), ``ros2launch.option``.
"""

from __future__ import annotations

import argparse

from ros2launch.option import OptionExtension


class FogOption(OptionExtension):  # type: ignore[misc]  # ros2launch has no types
    """Adds no option."""

    def prestart(self, args: argparse.Namespace) -> None:  # noqa: ARG002  # their call
        """Watch launch files from now on."""
        from fog.launch.unreturned import watch_ros_launch

        watch_ros_launch()
