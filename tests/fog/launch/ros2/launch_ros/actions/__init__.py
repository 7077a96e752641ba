"""Actions of ``launch_ros``."""

from .node import Node

__all__ = ["Node"]
