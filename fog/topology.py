"""Tree of gateways between a robot and its machines: section ``topology:`` of ``fog.yaml``.

Sans-I/O. Source: FogROS2-FT, Figure 4. A request crosses each link once, for any number of machines behind it;
gateways copy it where branches separate.
::

    topology:
      gateway: edge                   # dedicated (Figure 4, left); the robot's uplink ends here
      children:
        - {gateway: west, regions: [us-west-1, us-west-2]}
        - {gateway: east, replica: true, regions: [us-east-1]}    # one of its machines (Figure 4, right)

The first gateway serves every region that no gateway lists. Without ``topology``, one dedicated gateway serves all
regions; with ``topology: replica``, one of the machines does.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final

from pydantic import BeforeValidator, Field, model_validator

from gdp.config.schema import Section, Unique

_LABEL: Final = r"^[a-z0-9][a-z0-9-]{0,10}$"  # ``to-LABEL`` is the name of a device
_GATEWAYS_MAX: Final = 64
_AUTOMATIC_LABEL: Final = "gateway"
_REPLICA: Final = "replica"


class Gateway(Section):
    """Gateway, the regions whose machines are its neighbours, and the gateways behind it."""

    gateway: str = Field(pattern=_LABEL, description="Name: up to 11 lower-case letters, digits and `-`.")
    replica: bool = Field(
        default=False, description="One of the machines is this gateway. `false`: a namespace with a switch of its own."
    )
    regions: Annotated[tuple[str, ...], Unique] = Field(
        default=(), description="Regions whose machines are next to it."
    )
    children: tuple[Gateway, ...] = Field(default=(), description="Gateways behind it; a replica has none.")

    def traverse(self) -> Iterator[Gateway]:
        """Yield this gateway and all gateways behind it, each before its children."""
        yield self
        for child in self.children:
            yield from child.traverse()

    def serving(self, region: str) -> Gateway:
        """Return the gateway of the machines of a region."""
        return next((each for each in self.traverse() if region in each.regions), self)

    @model_validator(mode="after")
    def _each_stands_once(self) -> Gateway:
        labels = [each.gateway for each in self.traverse()]
        regions = [region for each in self.traverse() for region in each.regions]
        for kind, found in (("gateway", labels), ("region", regions)):
            for index, word in enumerate(found):
                if word in found[:index]:
                    raise ValueError(f"{kind} {word} stands twice")
        if len(labels) > _GATEWAYS_MAX:
            raise ValueError(f"at most {_GATEWAYS_MAX} gateways")
        return self

    @model_validator(mode="after")
    def _replicas_are_leaves(self) -> Gateway:
        """Reject gateways behind a replica gateway: a machine that may be preempted carries only peer machines."""
        if self.replica and self.children:
            raise ValueError(
                f"gateway {self.gateway} is a replica and has children: only a dedicated gateway may have gateways"
                " behind it (remove 'replica: true', or move the children to the gateway above)"
            )
        for child in self.children:
            if child.replica and not child.regions:
                raise ValueError(
                    f"gateway {child.gateway} is a replica without regions: no machine could be this gateway; name"
                    " the regions of its machines"
                )
        return self


AUTOMATIC: Final = Gateway(gateway=_AUTOMATIC_LABEL)
AUTOMATIC_REPLICA: Final = Gateway(gateway=_AUTOMATIC_LABEL, replica=True)


def _read(value: object) -> object:
    """Return the gateway of the word ``replica``; other values are unchanged, except that lists become tuples.

    Pydantic does not treat the result of such a validator as JSON, so its strict mode refuses lists.
    """
    if value == _REPLICA:
        return AUTOMATIC_REPLICA
    if isinstance(value, str):
        raise ValueError(f"{value!r}: expected the word 'replica', or a mapping with the key 'gateway'")
    return _with_tuples(value)


def _with_tuples(value: object) -> object:
    if isinstance(value, dict):
        return {key: _with_tuples(each) for key, each in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


Topology = Annotated[Gateway, BeforeValidator(_read)]
