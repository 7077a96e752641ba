"""User data of EC2 machines: no secret is in it."""

from __future__ import annotations

import base64

from fog.host.bundle import JOIN_FILE
from gdp_extensions.aws.provider import AwsProvider
from tests.attacks.test_enrolment_tokens import desk, launchers_secrets, rented
from tests.fog.bootstrap.desk import Desk
from tests.gdp_extensions.aws.test_aws import Cloud, aws, cloud, spec

__all__ = ["aws", "cloud", "desk"]


def test_a52_ec2_receives_no_private_key(desk: Desk, cloud: Cloud, aws: AwsProvider) -> None:
    reported = cloud.user_data(aws.create(spec("enrolled"), rented()))
    paths = [each["path"] for each in reported["write_files"]]
    assert f"/var/lib/fog/{JOIN_FILE}" in paths
    assert not [path for path in paths if path.endswith(".key")]
    contents = [
        base64.b64decode(each["content"]) if "encoding" in each else each["content"].encode()
        for each in reported["write_files"]
    ]
    assert not [each for each in contents if b"PRIVATE KEY" in each]
    assert not [each for each in launchers_secrets(desk) if any(each in content for content in contents)]
