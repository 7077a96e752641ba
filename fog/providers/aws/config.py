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

__all__ = ["AwsConfig", "Ssh"]


class Ssh(Section):
    """Settings of logins: ``key_pair`` is EC2's name, ``sources`` are the addresses for which port 22 is open."""

    key_pair: str
    sources: IPv4Network
    key_file: Path | None = None
    user: str = "admin"


class AwsConfig(Section):
    """Section ``aws:`` of ``fog.yaml``.

    Without ``regions``, all enabled regions of the account are used. ``images``, ``subnets`` and ``security_groups``
    map regions to values. Defaults are the newest image of that owner and name, the default VPC, and a new security
    group. The group admits only what ``ssh`` needs: machines dial out to the border.
    """

    regions: tuple[str, ...] = ()
    images: Mapping[str, str] = Field(default_factory=dict)
    image_owner: str = "136693071363"
    image_name: str = "debian-12-amd64-*"
    disk_gib: int = Field(default=20, ge=8, le=16_384)
    subnets: Mapping[str, str] = Field(default_factory=dict)
    security_groups: Mapping[str, tuple[str, ...]] = Field(default_factory=dict)
    ssh: Ssh | None = None
    setup: Setup = Setup()
