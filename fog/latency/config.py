"""Section ``latency:`` of ``fog.yaml``: the endpoint to probe for each region.

Sans-I/O.
::

    latency:
      endpoints:
        us-west-1: probe.example.org:7            # TCP
        us-east-1: udp://probe.example.org:7      # a UDP echo service (RFC 862)
        "*": "ec2.{region}.amazonaws.com:443"     # every other region
      lifetime_s: 3600
      timeout_s: 1.0
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal, cast

from pydantic import AfterValidator, Field

from gdp.config.schema import Section

_FORM: Final = re.compile(r"(?:(tcp|udp)://)?(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._{}-]+):(\d{1,5})")
_EVERY: Final = "*"
_AWS: Final = {_EVERY: "ec2.{region}.amazonaws.com:443"}  # every region's public endpoint


@dataclass(frozen=True, slots=True)
class ProbeEndpoint:
    """Endpoint of a probe.

    Args:
        protocol: ``tcp``: time to connect; ``udp``: time until an echo service returns a datagram.
    """

    protocol: Literal["tcp", "udp"]
    host: str
    port: int

    @classmethod
    def from_text(cls, text: str) -> ProbeEndpoint:
        """Read ``HOST:PORT``, ``tcp://HOST:PORT`` or ``udp://HOST:PORT``.

        Raises:
            ValueError: the text has another form.
        """
        match = _FORM.fullmatch(text)
        if match is None or not 0 < int(match[3]) < 65_536:
            raise ValueError(f"{text!r}: expected HOST:PORT, or udp://HOST:PORT of an echo service")
        return cls(cast("Literal['tcp', 'udp']", match[1] or "tcp"), match[2].strip("[]"), int(match[3]))

    def to_text(self) -> str:
        """Return the form that ``from_text`` reads, including the protocol."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.protocol}://{host}:{self.port}"


def _readable(text: str) -> str:
    ProbeEndpoint.from_text(text.replace("{region}", "region"))
    return text


class LatencyConfig(Section):
    """Section ``latency:`` of ``fog.yaml``."""

    endpoints: Mapping[str, Annotated[str, AfterValidator(_readable)]] = Field(
        default_factory=dict,
        description="Region or `*`: `HOST:PORT` (TCP) or `udp://HOST:PORT` (echo); `{region}` is its name.",
    )
    lifetime_s: float = Field(
        default=3_600.0,
        gt=0,
        le=86_400,
        description="Seconds for which a measurement holds; repeated after half of that.",
    )
    timeout_s: float = Field(default=1.0, gt=0, le=30, description="Seconds that one of the five tries may take.")

    def for_aws(self) -> LatencyConfig:
        """Return the section with EC2's public endpoint of each region, unless endpoints are stated."""
        return self if self.endpoints else self.model_copy(update={"endpoints": _AWS})

    def endpoint(self, region: str) -> ProbeEndpoint | None:
        """Return the endpoint of a region; None: there is none."""
        text = self.endpoints.get(region, self.endpoints.get(_EVERY))
        return None if text is None else ProbeEndpoint.from_text(text.replace("{region}", region))
