"""Requests to EC2, as its API (moto's server) then reports them."""

from __future__ import annotations

import pytest

from fog.providers.cloud_config import AwsConfig
from gdp_extensions.aws.core.run_request import Ground, order
from gdp_extensions.aws.provider import AwsProvider
from tests.gdp_extensions.aws.test_aws import BOOT, EAST, Cloud, aws, cloud, spec

__all__ = ["aws", "cloud"]

GROUND = Ground("ami-1", "/dev/sda1", ("sg-1",))


def test_a52_only_the_machine_itself_reads_its_metadata(cloud: Cloud, aws: AwsProvider) -> None:
    options = cloud.instance(aws.create(spec("metadata"), BOOT))["MetadataOptions"]
    assert options["HttpTokens"] == "required"
    assert options["HttpPutResponseHopLimit"] == 1


def test_a52_the_disk_with_the_keys_is_encrypted(cloud: Cloud, aws: AwsProvider) -> None:
    instance = cloud.instance(aws.create(spec("disk"), BOOT))
    disks = [each["Ebs"]["VolumeId"] for each in instance["BlockDeviceMappings"]]
    volumes = cloud.client(EAST).describe_volumes(VolumeIds=disks)["Volumes"]
    assert volumes
    assert all(each["Encrypted"] for each in volumes)


@pytest.mark.parametrize("spot", [False, True])
def test_a52_a_spot_machine_is_asked_for_no_less(spot: bool) -> None:
    wanted = order(spec("x", spot=spot), GROUND, AwsConfig(), b"")
    assert wanted["MetadataOptions"]["HttpPutResponseHopLimit"] == 1
    assert wanted["BlockDeviceMappings"][0]["Ebs"]["Encrypted"] is True
