"""RunInstances request for one machine.

Sans-I/O.
Source: EC2 API reference, RunInstances and "Ensuring idempotency"; EC2 user guide, "Configure the instance metadata
service" (IMDSv2 and its hop limit) and "Amazon EBS encryption".
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from typing import TYPE_CHECKING, cast

from fog.machine import MachineSpec
from fog.providers.cloud_config import AwsConfig
from gdp_extensions.aws.core.instances import tags_of

if TYPE_CHECKING:
    from types_boto3_ec2.literals import InstanceTypeType, ResourceTypeType
    from types_boto3_ec2.type_defs import RunInstancesRequestTypeDef, TagTypeDef


@dataclass(frozen=True, slots=True)
class Ground:
    """Prerequisites of a region's machines; ``root_device``: name under which the image expects its disk."""

    image: str
    root_device: str
    security_groups: tuple[str, ...]


def order(spec: MachineSpec, ground: Ground, config: AwsConfig, data: bytes) -> RunInstancesRequestTypeDef:
    """Return the parameters of ``run_instances``; ``data``: user data, not in base64."""
    # includes the data, which has new keys for each machine, because names of clusters and machines may be reused
    token = sha256(b"\0".join([spec.cluster.encode(), spec.name.encode(), data])).hexdigest()
    kinds: list[ResourceTypeType] = ["instance", "volume"]
    wanted: RunInstancesRequestTypeDef = {
        "ImageId": ground.image,
        "InstanceType": cast("InstanceTypeType", spec.offer.type_name),
        "MinCount": 1,
        "MaxCount": 1,
        "ClientToken": token,
        "UserData": cast("str", data),  # boto3 accepts bytes, but its stubs do not
        "InstanceInitiatedShutdownBehavior": "terminate",
        "MetadataOptions": {
            "HttpTokens": "required",
            "HttpEndpoint": "enabled",
            "HttpPutResponseHopLimit": 1,  # token requests of containers or forwarders get no response
            "InstanceMetadataTags": "enabled",
        },
        "BlockDeviceMappings": [
            {
                "DeviceName": ground.root_device,
                "Ebs": {
                    "VolumeSize": config.disk_gib,
                    "VolumeType": "gp3",
                    "DeleteOnTermination": True,
                    "Encrypted": True,  # it stores keys and delegations
                },
            }
        ],
        "SecurityGroupIds": list(ground.security_groups),
    }
    if subnet := config.subnets.get(spec.offer.region):
        wanted["SubnetId"] = subnet
    if config.ssh:
        wanted["KeyName"] = config.ssh.key_pair
    if spec.offer.is_spot:
        kinds.append("spot-instances-request")
        wanted["InstanceMarketOptions"] = {
            "MarketType": "spot",
            "SpotOptions": {"SpotInstanceType": "one-time", "InstanceInterruptionBehavior": "terminate"},
        }
    tags: list[TagTypeDef] = [{"Key": key, "Value": value} for key, value in tags_of(spec).items()]
    wanted["TagSpecifications"] = [{"ResourceType": kind, "Tags": tags} for kind in kinds]
    return wanted
