"""Provider ``aws`` against moto's EC2, over HTTP on a loopback port."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from fog.hardware import Hardware, Offer
from fog.machine import MachineBundle, MachineSpec, MachineState, Program
from fog.providers.cloud_config import AwsConfig, Ssh
from fog.providers.cloud_init import Setup
from gdp.errors import LocalError, StoreError
from gdp_extensions.aws.provider import AwsProvider

if TYPE_CHECKING:
    from moto.ec2.models import EC2Backend
    from types_boto3_ec2 import EC2Client
    from types_boto3_ec2.type_defs import InstanceTypeDef, TagSpecificationTypeDef, TagTypeDef

boto3 = pytest.importorskip("boto3", reason="the extra `aws` is not installed")
moto_server = pytest.importorskip("moto.server", reason="moto[ec2,server] of the extra `dev` is not installed")

EAST, WEST = "us-east-1", "us-west-1"
UBUNTU = "099720109477"  # moto's account has none of Debian's
OFFER = Offer("aws", EAST, "c5.xlarge", Hardware(4, 8.0), is_spot=False, usd_per_hour=0.17)
BOOT = MachineBundle({"keys/own.key": b"\x00\xff", "proxy.yaml": b"rules: []\n"}, (Program("switch", ("gdp-switch",)),))


@dataclass(frozen=True)
class Cloud:
    """Simulated EC2, seen from behind its API."""

    def client(self, region: str = EAST) -> EC2Client:
        client: EC2Client = boto3.client("ec2", region_name=region)
        return client

    def backend(self, region: str = EAST) -> EC2Backend:
        from moto.core.models import DEFAULT_ACCOUNT_ID
        from moto.ec2.models import ec2_backends

        return ec2_backends[DEFAULT_ACCOUNT_ID][region]

    def refuse(self, monkeypatch: pytest.MonkeyPatch, code: str, asked: str = "run_instances") -> None:
        from moto.ec2.exceptions import EC2ClientError

        def refuse(*args: object, **kwargs: object) -> None:
            raise EC2ClientError(code, "not today")

        monkeypatch.setattr(self.backend(), asked, refuse)

    def instance(self, machine: str) -> InstanceTypeDef:
        region, instance = machine.split("/")
        found = self.client(region).describe_instances(InstanceIds=[instance])
        return found["Reservations"][0]["Instances"][0]

    def user_data(self, machine: str) -> dict[str, Any]:
        region, instance = machine.split("/")
        reported = self.client(region).describe_instance_attribute(InstanceId=instance, Attribute="userData")
        packed = base64.b64decode(reported["UserData"]["Value"])
        config: dict[str, Any] = yaml.safe_load(gzip.decompress(packed))
        return config


def prices(hardware: Hardware, spot: bool) -> list[Offer]:
    lines = [
        replace(OFFER, is_spot=spot),
        replace(OFFER, type_name="m5.large", hardware=Hardware(2, 8.0), usd_per_hour=0.1, is_spot=spot),
        replace(OFFER, region="eu-west-1", is_spot=spot),
    ]
    return [line for line in lines if hardware.fits(line.hardware)]


def provider(ssh: Ssh | None = None, setup: Setup | None = None) -> AwsProvider:
    config = AwsConfig(
        regions=(EAST, WEST), image_owner=UBUNTU, image_name="ubuntu/images/*", ssh=ssh, setup=setup or Setup()
    )
    return AwsProvider(prices, config)


def spec(cluster: str, name: str = "m1", region: str = EAST, *, spot: bool = False) -> MachineSpec:
    return MachineSpec(cluster, name, replace(OFFER, region=region, is_spot=spot))


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cloud]:
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    absent = str(tmp_path_factory.mktemp("aws") / "absent")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "testing")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
        patch.setenv("AWS_CONFIG_FILE", absent)
        patch.setenv("AWS_SHARED_CREDENTIALS_FILE", absent)
        patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        patch.delenv("AWS_PROFILE", raising=False)
        yield Cloud()
    server.stop()


@pytest.fixture(scope="module")
def aws(cloud: Cloud) -> Iterator[AwsProvider]:
    made = provider()
    yield made
    made.close()


def test_a_machine_is_made_described_and_given_back(cloud: Cloud, aws: AwsProvider) -> None:
    made = aws.create(spec("life"), BOOT)
    (machine,) = aws.describe("life")
    assert machine.id == made
    assert machine.spec == spec("life")
    assert machine.state in (MachineState.BOOTING, MachineState.RUNNING)
    assert machine.address
    aws.terminate([made])
    (machine,) = aws.describe("life")
    assert machine.state is MachineState.GONE
    assert "user" in machine.reason.lower()


def test_a_provider_after_a_restart_finds_the_machines_of_all_regions(cloud: Cloud, aws: AwsProvider) -> None:
    made = {aws.create(spec("found", "m1"), BOOT), aws.create(spec("found", "m2", WEST, spot=True), BOOT)}
    aws.create(spec("another"), BOOT)
    again = provider()
    found = again.describe("found")
    again.close()
    assert {machine.id for machine in found} == made
    assert {(each.spec.name, each.spec.offer.region, each.spec.offer.is_spot) for each in found} == {
        ("m1", EAST, False),
        ("m2", WEST, True),
    }


def test_asking_twice_for_a_machine_makes_one(cloud: Cloud, aws: AwsProvider) -> None:
    assert aws.create(spec("twice"), BOOT) == aws.create(spec("twice"), BOOT)
    assert len(aws.describe("twice")) == 1


def test_a_clusters_name_may_come_again(cloud: Cloud, aws: AwsProvider) -> None:
    first = aws.create(spec("again"), BOOT)
    aws.terminate([first])
    assert aws.create(spec("again"), BOOT) != first


def test_a_machine_gets_its_boot_and_the_watcher(cloud: Cloud, aws: AwsProvider) -> None:
    reported = cloud.user_data(aws.create(spec("boot"), BOOT))
    written = {each["path"]: each for each in reported["write_files"]}
    assert written["/var/lib/fog/proxy.yaml"] == {
        "path": "/var/lib/fog/proxy.yaml",
        "permissions": "0600",
        "content": "rules: []\n",
    }
    assert base64.b64decode(written["/var/lib/fog/keys/own.key"]["content"]) == b"\x00\xff"
    assert "gdp_extensions.aws.notice" in written["/var/lib/fog/boot.json"]["content"]


def test_a_spot_machine_is_a_spot_machine_and_locked_down(cloud: Cloud, aws: AwsProvider) -> None:
    instance = cloud.instance(aws.create(spec("spot", spot=True), BOOT))
    assert instance["InstanceLifecycle"] == "spot"
    assert instance["MetadataOptions"]["HttpTokens"] == "required"
    group = cloud.client().describe_security_groups(GroupIds=[instance["SecurityGroups"][0]["GroupId"]])
    assert group["SecurityGroups"][0]["IpPermissions"] == []


def login(sources: str, key_pair: str = "operator") -> Ssh:
    """Return settings of logins from some addresses; a security group of their own belongs to them."""
    return Ssh.model_validate({"key_pair": key_pair, "sources": sources, "key_file": "/keys/operator"})


def test_only_what_is_asked_for_is_let_in(cloud: Cloud) -> None:
    cloud.client().create_key_pair(KeyName="operator")
    open_ = provider(ssh=login("203.0.113.0/24"))
    made = open_.create(spec("open"), BOOT)
    assert open_.create(spec("open", "m2"), BOOT) != made
    groups = cloud.instance(made)["SecurityGroups"]
    assert len(groups) == 1
    (group,) = cloud.client().describe_security_groups(GroupIds=[groups[0]["GroupId"]])["SecurityGroups"]
    let_in = {(each["FromPort"], each["IpRanges"][0]["CidrIp"]) for each in group["IpPermissions"]}
    assert let_in == {(22, "203.0.113.0/24")}
    address = open_.describe("open")[0].address
    assert open_.shell(made)[-3:] == ["-i", "/keys/operator", f"admin@{address}"]
    open_.close()


def test_a_machine_without_ssh_settings_has_no_shell(cloud: Cloud, aws: AwsProvider) -> None:
    with pytest.raises(LocalError, match=r"aws\.ssh"):
        aws.shell(aws.create(spec("closed"), BOOT))


def test_an_interruption_notice_is_seen(cloud: Cloud, aws: AwsProvider) -> None:
    cluster: list[TagTypeDef] = [{"Key": "fog-cluster", "Value": "notice"}, {"Key": "fog-machine", "Value": "m1"}]
    tags: list[TagSpecificationTypeDef] = [
        {"ResourceType": "spot-instances-request", "Tags": cluster},
        {"ResourceType": "instance", "Tags": cluster},
    ]
    asked = cloud.client().request_spot_instances(
        LaunchSpecification={"ImageId": "ami-1", "InstanceType": "c5.xlarge"},
        TagSpecifications=tags,
    )["SpotInstanceRequests"][0]
    assert aws.describe("notice")[0].state is MachineState.RUNNING
    request = cloud.backend().spot_instance_requests[asked["SpotInstanceRequestId"]]
    request._status_code = "marked-for-termination"
    (machine,) = aws.describe("notice")
    assert (machine.state, machine.reason) == (MachineState.LEAVING, "marked-for-termination")
    assert machine.leaves_at_unix_s is not None
    request._status_code = "instance-terminated-by-price"
    cloud.client().terminate_instances(InstanceIds=[asked["InstanceId"]])
    (machine,) = aws.describe("notice")
    assert (machine.state, machine.reason) == (MachineState.GONE, "instance-terminated-by-price")


def test_draining_leaves_a_word_that_the_machine_reads(cloud: Cloud, aws: AwsProvider) -> None:
    made = aws.create(spec("drain"), BOOT)
    aws.drain(made)
    (machine,) = aws.describe("drain")
    assert (machine.state, machine.reason) == (MachineState.LEAVING, "drained")


def test_giving_back_what_is_gone_is_fine(cloud: Cloud, aws: AwsProvider) -> None:
    made = aws.create(spec("gone"), BOOT)
    aws.terminate([made, f"{EAST}/i-0123456789abcdef0"])
    aws.terminate([made])
    assert aws.describe("gone")[0].state is MachineState.GONE


def test_spot_machines_cost_what_the_market_says(cloud: Cloud, aws: AwsProvider) -> None:
    assert {line.usd_per_hour for line in aws.offers(Hardware(2), spot=True)} == {0.00001}
    assert [line.type_name for line in aws.offers(Hardware(2), spot=False)] == ["m5.large", "c5.xlarge"]


def test_where_the_market_may_not_be_asked_the_catalogue_holds(
    cloud: Cloud, aws: AwsProvider, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud.refuse(monkeypatch, "UnauthorizedOperation", "describe_spot_price_history")
    assert [line.usd_per_hour for line in aws.offers(Hardware(4), spot=True)] == [0.17]


@pytest.mark.parametrize(
    ("code", "expected", "reported"),
    [
        ("InsufficientInstanceCapacity", StoreError, "to be had there now"),
        ("SpotMaxPriceTooLow", StoreError, "spot price"),
        ("UnauthorizedOperation", LocalError, "permission"),
        ("VcpuLimitExceeded", LocalError, "Service Quotas"),
        ("InvalidParameterValue", LocalError, "not today"),
    ],
)
def test_a_refusal_says_what_may_be_done(
    cloud: Cloud,
    aws: AwsProvider,
    monkeypatch: pytest.MonkeyPatch,
    code: str,
    expected: type[Exception],
    reported: str,
) -> None:
    cloud.refuse(monkeypatch, code)
    with pytest.raises(expected, match=reported):
        aws.create(spec("refused"), BOOT)


def test_an_ec2_that_is_not_there_may_be_asked_again(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr("gdp_extensions.aws.clients._ATTEMPTS", 1)
    away = provider()
    with pytest.raises(StoreError, match="machines of unknown"):
        away.describe("unknown")
    away.close()


def test_missing_credentials_are_named(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    stranger = provider()
    with pytest.raises(LocalError, match="credentials"):
        stranger.describe("unknown")
    stranger.close()


def test_a_region_without_image_says_what_to_set(cloud: Cloud) -> None:
    bare = AwsProvider(prices, AwsConfig(regions=(EAST,)))
    with pytest.raises(LocalError, match=r"aws\.images"):
        bare.create(spec("bare"), BOOT)
    with pytest.raises(LocalError, match="not among"):
        bare.create(spec("bare", region=WEST), BOOT)
    bare.close()


def test_without_chosen_regions_all_of_the_account_are_taken(cloud: Cloud) -> None:
    everywhere = AwsProvider(prices, AwsConfig())
    assert {line.region for line in everywhere.offers(Hardware(4), spot=False)} == {EAST, "eu-west-1"}
    everywhere.close()


def test_a_programs_lines_are_found_in_the_console(
    cloud: Cloud, aws: AwsProvider, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported = "[1.0] switch[7]: up\n[1.1] proxy[8]: up\n[1.2] kernel: up\n[1.3] fog-machine[5]: ends\n"
    monkeypatch.setattr("moto.ec2.responses.general.SAMPLE_CONSOLE_OUTPUT", reported)
    made = aws.create(spec("console"), BOOT)
    assert aws.log(made, "switch", 5) == "[1.0] switch[7]: up"
    assert aws.log(made, "", 5) == "[1.3] fog-machine[5]: ends"
    with pytest.raises(LocalError, match="no machine of EC2"):
        aws.log("elsewhere", "", 1)


def groups(cloud: Cloud) -> set[str]:
    """Return the security groups of both regions."""
    return {
        each["GroupId"]
        for region in (EAST, WEST)
        for each in cloud.client(region).describe_security_groups()["SecurityGroups"]
    }


def test_a_cleared_account_has_no_security_group_of_ours(cloud: Cloud) -> None:
    for region in (EAST, WEST):
        cloud.client(region).create_key_pair(KeyName="cleared")
    own = provider(ssh=login("203.0.113.9/32", "cleared"))
    own.clear_account()  # those of the other tests
    before = groups(cloud)
    made = [own.create(spec("cleared", "m1"), BOOT), own.create(spec("cleared", "m2", WEST), BOOT)]
    assert len(groups(cloud)) == len(before) + 2
    own.terminate(made)
    own.clear_account()
    assert groups(cloud) == before
    own.close()


def test_a_group_of_machines_that_run_stays(cloud: Cloud, aws: AwsProvider) -> None:
    made = aws.create(spec("stays"), BOOT)
    (group,) = cloud.instance(made)["SecurityGroups"]
    aws.clear_account()
    assert group["GroupId"] in groups(cloud)
    aws.terminate([made])


def test_a_group_is_kept_until_its_machines_have_ended(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    cloud.client().create_key_pair(KeyName="ending")
    own = provider(ssh=login("203.0.113.10/32", "ending"))
    own.terminate([own.create(spec("ending"), BOOT)])
    cloud.refuse(monkeypatch, "DependencyViolation", "delete_security_group")
    monkeypatch.setattr("gdp_extensions.aws.provider._END_S", 0.0)
    with pytest.raises(StoreError, match="try again"):
        own.clear_account()
    own.close()
