"""EC2 clients, one per region, created on first use; boto3 finds the credentials."""

from __future__ import annotations

from collections.abc import Mapping
from threading import Lock
from typing import TYPE_CHECKING

import boto3

from gdp.errors import LocalError
from gdp.intervals import CONNECT_S, SERVER_S
from gdp_extensions.aws.errors import asking

if TYPE_CHECKING:
    from types_boto3_ec2 import EC2Client
    from types_boto3_ec2.type_defs import FilterTypeDef

_ATTEMPTS = 4
_FIRST_REGION = "us-east-1"  # enabled in every account


class Clients:
    """Clients of all regions of an account, or of the chosen ones; thread-safe."""

    def __init__(self, chosen: tuple[str, ...] = ()) -> None:
        with asking("credentials"):
            self._session = boto3.session.Session()
        self._regions = chosen
        self._clients: dict[str, EC2Client] = {}
        self._lock = Lock()  # a session may create clients in one thread at a time only

    def __getitem__(self, region: str) -> EC2Client:
        """Return the client of a region.

        Raises:
            LocalError: the region does not exist, or is not among the chosen ones.
        """
        from botocore.config import Config

        if self._regions and region not in self._regions:
            raise LocalError(f"aws: region {region} is not among `aws.regions`: {', '.join(self._regions)}")
        with self._lock:
            if region not in self._clients:
                retries = Config(
                    connect_timeout=CONNECT_S,
                    read_timeout=SERVER_S,
                    retries={"mode": "standard", "max_attempts": _ATTEMPTS},
                )
                with asking(region):
                    self._clients[region] = self._session.client("ec2", region_name=region, config=retries)
            return self._clients[region]

    def regions(self) -> tuple[str, ...]:
        """Return the chosen regions, else those that the account has enabled.

        Raises:
            StoreError: EC2 cannot be reached now.
            LocalError: EC2 refuses the credentials.
        """
        if not self._regions:
            with asking("regions"):
                found = self[_FIRST_REGION].describe_regions()["Regions"]
            self._regions = tuple(sorted(each["RegionName"] for each in found))
        return self._regions

    def close(self) -> None:
        """Close the connections."""
        with self._lock:
            for client in self._clients.values():
                client.close()
            self._clients.clear()


def filters(wanted: Mapping[str, str]) -> list[FilterTypeDef]:
    """Return EC2's filter for the conjunction of these values."""
    return [{"Name": key, "Values": [value]} for key, value in wanted.items()]
