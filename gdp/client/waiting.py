"""What an attached node (a proxy, a RIB) waits for before it can work.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Iterator

from gdp.client.attachment import Attachment
from gdp.control.waiting import Wait, WaitReason, port_waits, stranger_waits
from gdp.crypto.certificates import Role

__all__ = ["attachment_waits"]


def attachment_waits(attachment: Attachment, now_s: float) -> list[Wait]:
    """Return what keeps a node from being attached with all it advertises; empty when nothing does."""
    if attachment.switch is None:
        ports = attachment.greeter.ports.values()
        of_ports = [wait for port in ports for wait in port_waits(port, (Role.SWITCH, Role.LEAF))]
        strangers = list(stranger_waits(attachment.greeter, now_s))
        refusing = {wait.port for wait in strangers}
        return [*strangers, *(w for w in of_ports if w.port not in refusing or w.reason is WaitReason.LINK_DOWN)]
    return list(_claim_waits(attachment))


def _claim_waits(attachment: Attachment) -> Iterator[Wait]:
    claims = attachment.claims
    if attachment.is_in_use:
        yield Wait(WaitReason.IN_USE)
        return
    if any(not each.is_judged for each in claims):
        yield Wait(WaitReason.NO_RIB)
    for each in claims:
        if each.refused is not None:
            yield Wait(WaitReason.REFUSED, name=each.subject.name, refused=each.refused)
