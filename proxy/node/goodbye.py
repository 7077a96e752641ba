"""Goodbye of a node with a bridge: its last messages arrive first, then the overlay learns that it leaves."""

from __future__ import annotations

import time
from typing import Final

from proxy.bridge.bridge import Bridge
from proxy.node.node import ProxyNode

__all__ = ["say_goodbye"]

_CONFIRM_S: Final = 1.0  # in which readers may confirm the last messages; what is not confirmed then is reported


def say_goodbye(node: ProxyNode, bridge: Bridge) -> None:
    """End all flows, and leave the overlay, also after a signal; a second signal ends each wait."""
    bridge.finish()
    node.runtime.linger(time.monotonic() + _CONFIRM_S, lambda: bridge.is_finished)
    bridge.close()
    node.leave()
