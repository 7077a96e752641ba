"""Current spot prices of a region.

I/O; queries EC2 and reads the clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Final, cast

if TYPE_CHECKING:
    from types_boto3_ec2 import EC2Client
    from types_boto3_ec2.literals import InstanceTypeType

__all__ = ["spot_prices"]

_LINUX: Final = ("Linux/UNIX", "Linux/UNIX (Amazon VPC)")


def spot_prices(client: EC2Client, type_names: Sequence[str]) -> dict[str, float]:
    """Return type -> US dollars per hour in its cheapest zone; types that are not sold there are omitted.

    Raises:
        ClientError, BotoCoreError: boto3's own.
    """
    cheapest: dict[str, float] = {}
    pages = client.get_paginator("describe_spot_price_history").paginate(
        InstanceTypes=[cast("InstanceTypeType", each) for each in type_names],
        ProductDescriptions=_LINUX,
        StartTime=datetime.now(timezone.utc),  # EC2 then returns the current price of each zone
    )
    for page in pages:
        for each in page["SpotPriceHistory"]:
            usd = float(each["SpotPrice"])
            cheapest[each["InstanceType"]] = min(usd, cheapest.get(each["InstanceType"], usd))
    return cheapest
