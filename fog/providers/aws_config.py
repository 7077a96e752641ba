"""Settings of provider ``aws``: regions, image, network and logins. boto3 finds the credentials.

Sans-I/O.
Source: Debian's images are published by account 136693071363 (wiki.debian.org/Cloud/AmazonEC2Image).
"""

from __future__ import annotations

from collections.abc import Mapping
from ipaddress import IPv4Network
from pathlib import Path

from pydantic import Field

from fog.providers.cloud_init import Setup
from gdp.config.schema import Section


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
