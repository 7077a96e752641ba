"""Settings of the providers ``aws`` and ``skypilot``: regions, image, network, logins, and the software of a machine.

Sans-I/O. boto3 finds the credentials.
Source: Debian's images are published by account 136693071363 (wiki.debian.org/Cloud/AmazonEC2Image).
"""

from __future__ import annotations

from collections.abc import Mapping
from ipaddress import IPv4Network
from pathlib import Path
from typing import Annotated, Final

from pydantic import AfterValidator, Field

from fog.providers.cloud_init import Setup
from gdp.config.schema import Section

_PODS: Final = ("kubernetes", "k8s", "ssh")  # SkyPilot's words for Kubernetes; its pools of ssh hosts run k3s


class Ssh(Section):
    """Settings of logins."""

    key_pair: str = Field(description="Name of EC2's key pair.")
    sources: IPv4Network = Field(description="Addresses for which port 22 is open.")
    key_file: Path | None = Field(default=None, description="Private key for `fog` itself.")
    user: str = Field(default="admin", description="User of the image.")


class AwsConfig(Section):
    """Section ``aws:`` of ``fog.yaml``."""

    regions: tuple[str, ...] = Field(
        default=(), description="Where machines are made and looked for. Empty: all that the account has enabled."
    )
    images: Mapping[str, str] = Field(
        default_factory=dict,
        description="Region: image id. Without one: the newest of `image_owner` that fits `image_name`.",
    )
    image_owner: str = Field(default="136693071363", description="Account of the images: Debian's.")
    image_name: str = Field(default="debian-12-amd64-*", description="x86-64 only.")
    disk_gib: int = Field(default=20, ge=8, le=16_384, description="Root disk (gp3), gone with the machine.")
    subnets: Mapping[str, str] = Field(
        default_factory=dict, description="Region: subnet id. Without one: the default VPC."
    )
    security_groups: Mapping[str, tuple[str, ...]] = Field(
        default_factory=dict, description="Region: group ids. Without one: one of our own, nothing in but `ssh`."
    )
    ssh: Ssh | None = Field(default=None, description="Logins. `null`: none.")
    setup: Setup = Field(default=Setup(), description="What a machine installs.")


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
