"""Prerequisites of a region for machines: an image, a subnet and a security group.

I/O; queries EC2, and creates a security group if none fits.
The group's name encodes what it admits, so a group for other settings is never widened. The group belongs to no run and
is not removed: it is free of charge, and the next cluster uses it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog.providers.aws.clients import filters
from fog.providers.aws.config import AwsConfig
from fog.providers.aws.errors import is_code
from fog.providers.aws.run_request import Ground
from fog.providers.cloud_init import VXLAN_PORT
from gdp.errors import LocalError

if TYPE_CHECKING:
    from types_boto3_ec2 import EC2Client
    from types_boto3_ec2.type_defs import ImageTypeDef, IpPermissionTypeDef

__all__ = ["ground_of"]


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
    what = "machines of fog clusters"
    try:
        return client.create_security_group(GroupName=name, Description=what, VpcId=vpc)["GroupId"]
    except client.exceptions.ClientError as error:
        if not is_code(error, "InvalidGroup.Duplicate"):  # else another launcher created it at the same time
            raise
    place = filters({"group-name": name, "vpc-id": vpc})
    return client.describe_security_groups(Filters=place)["SecurityGroups"][0]["GroupId"]


def _permissions(config: AwsConfig) -> list[IpPermissionTypeDef]:
    allowed: list[IpPermissionTypeDef] = []
    if config.ssh:
        allowed.append(_permission("tcp", 22, str(config.ssh.sources)))
    if vxlan := config.setup.vxlan:
        if vxlan.remote.version != 4:
            raise LocalError("aws: vxlan.remote is an IPv4 address; for IPv6 configure `aws.security_groups`")
        allowed.append(_permission("udp", VXLAN_PORT, f"{vxlan.remote}/32"))
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
