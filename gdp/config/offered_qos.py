"""QoS that an exposed topic offers, as its machine states it to the machines that import it.

Section of a configuration file, and body of a mail.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

from pydantic import Field, ValidationError

from gdp.config.schema import Section, first_fault
from gdp.crypto.cbor import decode, encode
from gdp.crypto.schema import NAME, Keyed
from gdp.errors import DropReason, StatementError
from gdp.names import Name

OFFERED_DEPTH_MAX: Final = 1_000
_MAX_BYTES: Final = 1_024
_NAME: Final = Keyed("name", NAME)


class OfferedQos(Section):
    """Policies of one profile that all publishers of a topic fulfil, with ROS 2's names in lower case."""

    reliability: Literal["reliable", "best_effort"] = Field(description="Of the publishers.")
    durability: Literal["volatile", "transient_local"] = Field(description="Of the publishers.")
    depth: int = Field(ge=1, le=OFFERED_DEPTH_MAX, description="Messages.")

    @classmethod
    def from_fields(cls, fields: Mapping[str, object]) -> OfferedQos:
        """Return the policies among the fields. Raises ``StatementError``: one is missing or invalid."""
        try:
            return cls.model_validate({key: fields.get(key) for key in cls.model_fields})
        except ValidationError as error:
            raise StatementError(DropReason.MALFORMED, f"QoS of a topic: {first_fault(error)}") from error

    def to_wire(self, name: Name) -> bytes:
        """Return the body of a mail about a topic."""
        return encode({"name": name, **self.model_dump()})

    @classmethod
    def from_wire(cls, wire: bytes) -> tuple[Name, OfferedQos]:
        """Return a topic's name and QoS from a mail. Raises ``StatementError``: the mail is malformed."""
        value = decode(wire, _MAX_BYTES)
        received = value if isinstance(value, dict) else {}
        return _NAME.read(received), cls.from_fields(received)
