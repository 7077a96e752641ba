"""Description of a node for other machines: its entities, under the names that all sides know.

Sans-I/O. It travels sealed, as the description of a publisher; invalid bytes raise ``RemoteError``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from gdp.crypto.schema import FieldSet, Keyed, many, one_of, or_empty, row
from proxy.endpoints.core.endpoint import Role
from proxy.serial.channel import QOS, TEXT, Qos

ENTITIES_MAX: Final = 1_024


class NodeEntity(NamedTuple):
    """Publisher, subscription, server or client of a node; ``qos`` of topics only."""

    role: Role
    name: str
    type_name: str
    qos: Qos | None = None


_ENTITY: Final = row(NodeEntity, one_of(Role), TEXT, TEXT, or_empty(QOS, None))


@dataclass(frozen=True, slots=True)
class NodeDescription(FieldSet):
    """What a node has; the parts of its actions are among the topics and services."""

    MAX_BYTES = 512 << 10
    entities: Annotated[tuple[NodeEntity, ...], Keyed("e", many(_ENTITY, ENTITIES_MAX))]
