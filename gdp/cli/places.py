"""Members at which a name is advertised, as the switch of a node knows them.

I/O; over a control socket.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from gdp.errors import LocalError
from gdp.intervals import ANSWER_S
from gdp.management.control_client import NodeConnection
from gdp.names import Name

NOWHERE: Final = (
    "no RIB that answers knows a member that advertises it;"
    " is its publisher up, does it expose the name, and are the RIBs up?"
)

_REPLY_BYTES: Final = 4_000
_CARRIES: Final = ("publish", "serve")


@dataclass(frozen=True, slots=True)
class Place:
    """A member that advertises a name."""

    node: str  # 64 hex digits
    right: str
    cost: int | None = None  # of the path to a server


def find_places(connection: NodeConnection, name: Name) -> list[Place]:
    """Return the members that publish or serve a name, the nearest server first.

    A member's own name is where that member is.

    Raises:
        LocalError: the switch does not answer, or refuses.
    """
    found = connection.ask("resolve", name=name.to_text(), timeout_s=ANSWER_S, reply_bytes=_REPLY_BYTES)
    if found.get("state") != "answered":
        raise LocalError("the switch of this node does not answer; look at 'gdp show neighbors'")
    result = found.get("result")
    places = result.get("places", []) if isinstance(result, Mapping) else []
    known = [
        Place(str(each["node"]), str(each["right"]), each.get("cost")) for each in places if isinstance(each, Mapping)
    ]
    carrying = sorted([each for each in known if each.right in _CARRIES], key=lambda each: each.cost or 0)
    return carrying or [each for each in known if each.node == name.to_text()]
