"""Provider of Amazon EC2 machines, on demand and spot.

I/O; queries EC2, several regions in parallel.
Source: EC2 API reference (RunInstances, "Ensuring idempotency"), EC2 user guide ("Spot Instance interruption notices").

All state that must survive a restart is in the tags of the instances. A spot machine is a one-time request that ends
with its instance. A machine that powers itself off is terminated.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Final, cast

from fog.catalog.prices import price_list
from fog.hardware import Hardware, Offer
from fog.host.bundle import pack
from fog.machine import Machine, MachineBundle, MachineSpec, Program
from fog.providers.cloud_config import AwsConfig
from fog.providers.cloud_init import lines_of, user_data
from fog.site import Site
from gdp.errors import LocalError
from gdp_extensions.aws.clients import Clients, filters
from gdp_extensions.aws.core.instances import CLUSTER, DRAIN, MACHINE, machine_of
from gdp_extensions.aws.core.run_request import order
from gdp_extensions.aws.errors import asking, is_code
from gdp_extensions.aws.region import ground_of, remove_groups

if TYPE_CHECKING:
    from types_boto3_ec2 import EC2Client
    from types_boto3_ec2.literals import InstanceTypeType
    from types_boto3_ec2.type_defs import FilterTypeDef, InstanceTypeDef, SpotInstanceRequestTypeDef

log = logging.getLogger(__name__)

WATCHER: Final = Program("notice", ("{python}", "-m", "gdp_extensions.aws.notice", "--home", "{home}"))
_AT_ONCE: Final = 8
_END_S: Final = 180.0  # a machine that is terminated takes about a minute to end
_LIVING: Final = ("pending", "running", "stopping", "stopped")
_LINUX: Final = ("Linux/UNIX", "Linux/UNIX (Amazon VPC)")


class AwsProvider:
    """Provider ``aws``; an id is ``region/instance``. Thread-safe.

    Args:
        prices: catalogue: (hardware, whether spot) -> lines of provider ``aws`` with enough hardware.

    Raises:
        LocalError: boto3 is not installed.
    """

    name: str = "aws"
    poll_s: float = 5.0

    def __init__(self, prices: Callable[[Hardware, bool], list[Offer]], config: AwsConfig | None = None) -> None:
        self._prices = prices
        self._config = config or AwsConfig()
        self._clients = Clients(self._config.regions)
        self._threads = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="aws")

    def offers(self, hardware: Hardware, *, spot: bool) -> list[Offer]:
        """Return the catalogue's lines; spot machines have the current price if EC2 reports it."""
        regions = self._clients.regions()
        lines = [each for each in self._prices(hardware, spot) if each.region in regions]
        if spot:
            by_region: dict[str, list[Offer]] = defaultdict(list)
            for line in lines:
                by_region[line.region].append(line)
            lines = [line for part in self._threads.map(self._priced, by_region.values()) for line in part]
        return sorted(lines, key=lambda each: each.usd_per_hour)

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        """Run one instance; a repeated request for the same machine returns the existing instance.

        Raises:
            StoreError: no capacity is available there now, or EC2 cannot be reached.
            LocalError: credentials, quota, type or settings are wrong, or the bundle is too large.
        """
        region = spec.offer.region
        client = self._clients[region]
        data = user_data(pack(replace(boot, programs=(*boot.programs, WATCHER))), self._config.setup)
        with asking(f"{region}: create {spec.name}"):
            wanted = filters({f"tag:{CLUSTER}": spec.cluster, f"tag:{MACHINE}": spec.name})
            living = [each for each in _instances(client, wanted) if each["State"]["Name"] in _LIVING]
            if living:
                return f"{region}/{living[0]['InstanceId']}"
            ground = ground_of(client, region, self._config)
            made = client.run_instances(**order(spec, ground, self._config, data))["Instances"]
            return f"{region}/{made[0]['InstanceId']}"

    def describe(self, cluster: str) -> list[Machine]:
        """Return the machines with this cluster's tag, of all regions.

        Raises:
            StoreError: a region cannot be reached now; a partial result would look like machines that are gone.
            LocalError: EC2 refuses the credentials.
        """
        regions = self._clients.regions()
        parts = self._threads.map(lambda region: self._found(region, cluster), regions)
        return sorted((each for part in parts for each in part), key=lambda each: each.started_unix_s)

    def terminate(self, ids: Sequence[str]) -> None:
        """Terminate instances; their disks and spot requests end with them."""
        by_region: dict[str, list[str]] = defaultdict(list)
        for each in ids:
            region, instance = _split(each)
            by_region[region].append(instance)
        for region, instances in by_region.items():
            client = self._clients[region]
            with asking(f"{region}: terminate {', '.join(instances)}"):
                # by a filter, because EC2 refuses a whole request with one unknown id
                found = _instances(client, [{"Name": "instance-id", "Values": instances}])
                known = [each["InstanceId"] for each in found]
                if known:
                    client.terminate_instances(InstanceIds=known)

    def clear_account(self) -> None:
        """Delete the security groups that this provider made; disks and spot requests end with their machines.

        Raises:
            StoreError: EC2 cannot be reached now, or machines take longer than usual to end.
            LocalError: EC2 refuses the credentials.
        """
        for region in self._clients.regions():
            with asking(f"{region}: delete security groups"):
                remove_groups(self._clients[region], region, _END_S)

    def drain(self, machine: str) -> None:
        """Tag the instance; its watcher reads the tag in the metadata within seconds and drains."""
        region, instance = _split(machine)
        with asking(f"{region}: drain {instance}"):
            self._clients[region].create_tags(Resources=[instance], Tags=[{"Key": DRAIN, "Value": "1"}])

    def log(self, machine: str, program: str, lines: int) -> str:
        """Return the last lines of a program in the instance's console, which EC2 updates a minute or more late."""
        region, instance = _split(machine)
        with asking(f"{region}: console of {instance}"):
            output = self._clients[region].get_console_output(InstanceId=instance).get("Output", "")
        return lines_of(output.splitlines(), program, lines)

    def shell(self, machine: str) -> list[str]:
        """Return an ssh command line.

        Raises:
            StoreError: EC2 cannot be reached now.
            LocalError: ``aws.ssh`` is not configured, or the machine has no address.
        """
        region, instance = _split(machine)
        ssh = self._config.ssh
        if ssh is None:
            raise LocalError("aws: no login is allowed: set `aws.ssh` (key_pair, sources) before machines are made")
        with asking(f"{region}: address of {instance}"):
            found = _instances(self._clients[region], filters({"instance-id": instance}))
        address = next((each.get("PublicIpAddress") or each.get("PrivateIpAddress") for each in found), None)
        if not address:
            raise LocalError(f"aws: {machine} has no address")
        key = ["-i", str(ssh.key_file.expanduser())] if ssh.key_file else []
        return ["ssh", "-o", "StrictHostKeyChecking=accept-new", *key, f"{ssh.user}@{address}"]

    def close(self) -> None:
        """Close connections and threads; machines continue."""
        self._threads.shutdown(cancel_futures=True)
        self._clients.close()

    def _found(self, region: str, cluster: str) -> list[Machine]:
        client = self._clients[region]
        with asking(f"{region}: machines of {cluster}"):
            found = _instances(client, filters({f"tag:{CLUSTER}": cluster}))
            has_spot = any(each.get("InstanceLifecycle") == "spot" for each in found)
            requests = _spot_requests(client, cluster) if has_spot else {}
        return [machine_of(region, each, requests.get(each["InstanceId"])) for each in found]

    def _priced(self, lines: Sequence[Offer]) -> list[Offer]:
        region = lines[0].region
        with asking(f"{region}: spot prices"):
            try:
                now = spot_prices(self._clients[region], [each.type_name for each in lines])
            except self._clients[region].exceptions.ClientError as error:
                if not is_code(error, "UnauthorizedOperation"):
                    raise
                log.info("spot prices not allowed region=%s: the catalogue's hold", region)
                return list(lines)
        return [replace(each, usd_per_hour=now.get(each.type_name, each.usd_per_hour)) for each in lines]


def _instances(client: EC2Client, wanted: list[FilterTypeDef]) -> list[InstanceTypeDef]:
    pages = client.get_paginator("describe_instances").paginate(Filters=wanted)
    return [each for page in pages for reservation in page["Reservations"] for each in reservation["Instances"]]


def _spot_requests(client: EC2Client, cluster: str) -> dict[str, SpotInstanceRequestTypeDef]:
    wanted = filters({f"tag:{CLUSTER}": cluster})
    pages = client.get_paginator("describe_spot_instance_requests").paginate(Filters=wanted)
    return {each["InstanceId"]: each for page in pages for each in page["SpotInstanceRequests"] if "InstanceId" in each}


def _split(machine: str) -> tuple[str, str]:
    region, slash, instance = machine.partition("/")
    if not slash or not instance.startswith("i-"):
        raise LocalError(f"aws: {machine!r} is no machine of EC2: expected region/i-...")
    return region, instance


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


def open_aws(site: Site) -> AwsProvider:
    """Return the provider of a site."""
    return AwsProvider(lambda hardware, spot: price_list("aws", hardware, spot=spot), site.config.aws)
