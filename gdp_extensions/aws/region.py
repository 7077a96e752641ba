"""Prerequisites of a region for machines: an image, a subnet and a security group.

I/O; queries EC2, and creates a security group if none fits.
The group's name encodes what it admits, so a group for other settings is never widened. Clusters with the same settings
share it. It is removed when the last cluster of a site is down, unless machines of another site use it.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Final

from fog.providers.cloud_config import AwsConfig
from gdp.errors import LocalError, StoreError
from gdp.intervals import POLL_S
from gdp_extensions.aws.clients import filters
from gdp_extensions.aws.core.run_request import Ground
from gdp_extensions.aws.errors import is_code

if TYPE_CHECKING:
    from types_boto3_ec2 import EC2Client
    from types_boto3_ec2.type_defs import ImageTypeDef, IpPermissionTypeDef

log = logging.getLogger(__name__)

_DESCRIPTION: Final = "machines of fog clusters"
_ENDED: Final = ("terminated",)
_ENDING: Final = ("shutting-down", "terminated")


def ground_of(client: EC2Client, region: str, config: AwsConfig) -> Ground:
    """Return the prerequisites of a region's machines.

    Raises:
        LocalError: no image fits, or there is no default VPC and no subnet is configured.
    """
    found = _image(client, region, config)
    groups = config.security_groups.get(region) or (_security_group(client, region, config),)
    return Ground(found["ImageId"], found.get("RootDeviceName") or "/dev/xvda", groups)


def _image(client: EC2Client, region: str, config: AwsConfig) -> ImageTypeDef:
    if chosen := config.images.get(region):
        found = client.describe_images(ImageIds=[chosen])["Images"]
    else:
        wanted = filters({"name": config.image_name, "architecture": "x86_64", "state": "available"})
        found = client.describe_images(Owners=[config.image_owner], Filters=wanted)["Images"]
    if not found:
        raise LocalError(f"aws: {region}: no image {config.image_name} of {config.image_owner}: set `aws.images`")
    return max(found, key=lambda each: each.get("CreationDate", ""))


def _security_group(client: EC2Client, region: str, config: AwsConfig) -> str:
    permissions = _permissions(config)
    letting_in = " ".join(
        f"{each['IpProtocol']}-{each['FromPort']}-from-{each['IpRanges'][0]['CidrIp']}" for each in permissions
    )
    name = f"fog: {letting_in or 'nothing'} in"
    vpc = _vpc(client, region, config)
    place = filters({"group-name": name, "vpc-id": vpc})
    found = client.describe_security_groups(Filters=place)["SecurityGroups"]
    group = found[0]["GroupId"] if found else _create(client, name, vpc)
    if not permissions or (found and found[0]["IpPermissions"]):
        return group
    try:
        client.authorize_security_group_ingress(GroupId=group, IpPermissions=permissions)
    except client.exceptions.ClientError as error:
        if not is_code(error, "InvalidPermission.Duplicate"):
            raise
    return group


def _create(client: EC2Client, name: str, vpc: str) -> str:
    try:
        return client.create_security_group(GroupName=name, Description=_DESCRIPTION, VpcId=vpc)["GroupId"]
    except client.exceptions.ClientError as error:
        if not is_code(error, "InvalidGroup.Duplicate"):  # else another launcher created it at the same time
            raise
    place = filters({"group-name": name, "vpc-id": vpc})
    return client.describe_security_groups(Filters=place)["SecurityGroups"][0]["GroupId"]


def remove_groups(client: EC2Client, region: str, patience_s: float) -> None:
    """Remove the groups that ``ground_of`` made in a region; a group of machines that do not end stays.

    Args:
        patience_s: how long to wait for machines that are shutting down; EC2 keeps their groups until then.

    Raises:
        StoreError: such machines have not ended in that time.
    """
    end_s = time.monotonic() + patience_s
    found = client.describe_security_groups(Filters=filters({"description": _DESCRIPTION}))["SecurityGroups"]
    for group in (each["GroupId"] for each in found):
        while True:
            states = _states_of_users(client, group)
            if any(each not in _ENDING for each in states):
                log.info("security group kept region=%s group=%s: machines use it", region, group)
                break
            if not states and _is_deleted(client, group):
                break
            if time.monotonic() >= end_s:
                raise StoreError(f"{region}: security group {group} is in use by machines that end: try again")
            time.sleep(POLL_S)  # EC2 reports no event when a machine has ended


def _states_of_users(client: EC2Client, group: str) -> list[str]:
    """Return the states of the instances with a security group, without those that have ended."""
    pages = client.get_paginator("describe_instances").paginate(Filters=filters({"instance.group-id": group}))
    each = (one["State"]["Name"] for page in pages for some in page["Reservations"] for one in some["Instances"])
    return [state for state in each if state not in _ENDED]


def _is_deleted(client: EC2Client, group: str) -> bool:
    try:
        client.delete_security_group(GroupId=group)
    except client.exceptions.ClientError as error:
        if is_code(error, "DependencyViolation"):  # a network interface is not yet released
            return False
        if not is_code(error, "InvalidGroup.NotFound"):  # else another site removed it at the same time
            raise
    return True


def _permissions(config: AwsConfig) -> list[IpPermissionTypeDef]:
    allowed: list[IpPermissionTypeDef] = []
    if config.ssh:
        allowed.append(_permission("tcp", 22, str(config.ssh.sources)))
    return allowed


def _permission(protocol: str, port: int, source: str) -> IpPermissionTypeDef:
    return {"IpProtocol": protocol, "FromPort": port, "ToPort": port, "IpRanges": [{"CidrIp": source}]}


def _vpc(client: EC2Client, region: str, config: AwsConfig) -> str:
    if subnet := config.subnets.get(region):
        return client.describe_subnets(SubnetIds=[subnet])["Subnets"][0]["VpcId"]
    found = client.describe_vpcs(Filters=filters({"is-default": "true"}))["Vpcs"]
    if not found:
        raise LocalError(f"aws: {region}: no default VPC: name a subnet in `aws.subnets`")
    return found[0]["VpcId"]
