"""The tree of gateways between a robot and its machines: ``topology:`` in ``fog.yaml``.

Place: pure. A request travels once over each of its links, however many machines lie behind: copies are made where
branches part.
::

    topology:
      gateway: edge                   # the robot's uplink ends here
      children:
        - {gateway: west, regions: [us-west-1, us-west-2]}
        - {gateway: east, regions: [us-east-1]}

A region that no gateway names is served by the first one; without ``topology`` that serves all.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final

from pydantic import Field, model_validator

from gdp.nodes.schema import Section, Unique

__all__ = ["AUTOMATIC", "Gateway"]

_LABEL: Final = r"^[a-z0-9][a-z0-9-]{0,10}$"  # ``to-LABEL`` is a device's name
_GATEWAYS_MAX: Final = 64


class Gateway(Section):
    """A gateway, the regions whose machines are its neighbours, and the gateways behind it."""

    gateway: str = Field(pattern=_LABEL)
    regions: Annotated[tuple[str, ...], Unique] = ()
    children: tuple[Gateway, ...] = ()

    def walk(self) -> Iterator[Gateway]:
        """Yield this one and all behind it, each before its children."""
        yield self
        for child in self.children:
            yield from child.walk()

    def serving(self, region: str) -> Gateway:
        """Return the gateway next to the machines of a region."""
        return next((each for each in self.walk() if region in each.regions), self)

    @model_validator(mode="after")
    def _each_stands_once(self) -> Gateway:
        labels = [each.gateway for each in self.walk()]
        regions = [region for each in self.walk() for region in each.regions]
        for kind, found in (("gateway", labels), ("region", regions)):
            for index, word in enumerate(found):
                if word in found[:index]:
                    raise ValueError(f"{kind} {word} stands twice")
        if len(labels) > _GATEWAYS_MAX:
            raise ValueError(f"at most {_GATEWAYS_MAX} gateways")
        return self


AUTOMATIC: Final = Gateway(gateway="gateway")
