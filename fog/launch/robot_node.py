"""Node of the robot's side, as a launch file describes it.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass

from fog.cluster import CloudNode

__all__ = ["RobotNode"]


@dataclass(frozen=True, slots=True)
class RobotNode:
    """Node of the robot's side.

    Args:
        output: destination of its output: ``screen``, ``both`` or ``log``.
    """

    node: CloudNode
    output: str = "screen"
