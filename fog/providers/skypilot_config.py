"""Settings of provider ``skypilot``: regions, and the software of a machine."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import AfterValidator, Field

from fog.providers.cloud_init import Setup
from gdp.config.schema import Section

_PODS: Final = ("kubernetes", "k8s", "ssh")  # SkyPilot's words for Kubernetes; its pools of ssh hosts run k3s


def _has_machines(place: str) -> str:
    """Return a place unchanged. Raises ``ValueError``: it has pods, where the programs of a machine cannot run."""
    if place.partition("/")[0].lower() in _PODS:
        raise ValueError(
            f"{place!r} is Kubernetes: its pods have no systemd and no CAP_NET_ADMIN, so no switch and no tunnel can"
            " run there; name a cloud with virtual machines"
        )
    return place


class SkyPilotConfig(Section):
    """Section ``skypilot:`` of ``fog.yaml``.

    Kubernetes, SkyPilot's local back end too, is refused.
    """

    places: tuple[Annotated[str, AfterValidator(_has_machines)], ...] = Field(
        default=("aws/us-east-1", "aws/us-west-2"),
        min_length=1,
        description="Regions, as SkyPilot's `infra` writes them.",
    )
    disk_gib: int = Field(default=50, ge=30, le=16_384, description="Root disk.")
    setup: Setup = Field(default=Setup(), description="What a machine installs.")
