"""Settings of provider ``skypilot``: regions, and the software of a machine.

Sans-I/O.
"""

from __future__ import annotations

from pydantic import Field

from fog.providers.cloud_init import Setup
from gdp.nodes.schema import Section

__all__ = ["SkyPilotConfig"]


class SkyPilotConfig(Section):
    """Section ``skypilot:`` of ``fog.yaml``.

    ``places`` are SkyPilot's ``infra``, each a cloud and a region: the regions of this provider. SkyPilot manages
    clouds, credentials and images (``sky check``).
    """

    places: tuple[str, ...] = Field(default=("aws/us-east-1", "aws/us-west-2"), min_length=1)
    disk_gib: int = Field(default=50, ge=30, le=16_384)
    setup: Setup = Setup()
