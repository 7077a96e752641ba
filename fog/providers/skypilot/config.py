"""The settings of provider ``skypilot``: where to look, and what a machine installs.

Sans-I/O.
"""

from __future__ import annotations

from pydantic import Field

from fog.providers.cloud_init import Setup
from gdp.nodes.schema import Section

__all__ = ["SkyPilotConfig"]


class SkyPilotConfig(Section):
    """``skypilot:`` of ``fog.yaml``. ``places`` are SkyPilot's ``infra``, a cloud and a region each: the regions of
    this provider. Clouds, credentials and images are SkyPilot's own affair (``sky check``).
    """

    places: tuple[str, ...] = Field(default=("aws/us-east-1", "aws/us-west-2"), min_length=1)
    disk_gib: int = Field(default=50, ge=30, le=16_384)
    setup: Setup = Setup()
