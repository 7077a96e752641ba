"""What a switch waits for before it can serve: neighbours on its ports, the rest of its domain, and a RIB.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Collection

from gdp.control.waiting import Wait, WaitReason, port_waits, stranger_waits
from gdp.crypto.certificates import Role
from gdp.switch.machine import Switch

__all__ = ["switch_waits"]


def switch_waits(switch: Switch, attachments: Collection[int], now_s: float) -> list[Wait]:
    """Return what a switch waits for; empty when nothing is missing.

    Args:
        attachments: ports made for nodes of the same host, which may start at any time: nobody there is no reason.
    """
    waits = list(stranger_waits(switch.greeter, now_s))
    refusing = {wait.port for wait in waits}
    for port in switch.greeter.ports.values():
        if port.index not in attachments:
            found = port_waits(port, tuple(Role))
            waits += (each for each in found if port.index not in refusing or each.reason is WaitReason.LINK_DOWN)
    if severed := switch.severed:
        waits.append(Wait(WaitReason.THROUGH_LEAF, name=min(severed)))
    if switch.rib is None:
        waits.append(Wait(WaitReason.NO_RIB))
    return waits
