"""Rented machines that boot: EC2 of moto, a minimal Debian, and cloud-init with the user data of the provider."""

from __future__ import annotations

import gzip
import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from fog.supervisor.core.record import Record
from gdp.host.run_registry import Run, RunRegistry
from lab.cloud_site import CloudSite, launch_file, start_echo
from lab.datacenter import Router
from lab.debian import BootedMachine, why_not
from lab.machine import LabMachine
from lab.namespaces import Space
from lab.process import calling, until
from netns_tests.local_site import leftovers

if TYPE_CHECKING:
    from lab.ec2 import DataCenter

pytest.importorskip("boto3", reason="the extra `aws` is not installed")
pytest.importorskip("moto.server", reason="moto[ec2,server] of the extra `dev` is not installed")
pytest.importorskip("rclpy", reason="needs the extra ros2")
pytestmark = [pytest.mark.netns, pytest.mark.skipif(bool(why_not()), reason=why_not() or "it can")]

NEAR, FAR = "us-west-1", "us-east-1"
_MACHINE_S = 400.0  # one boots here in about 30 s; a loaded host takes much longer
_ANSWER_S = 30.0


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    made = RunRegistry(tmp_path / "runs").start()
    yield made
    made.end()


def account() -> dict[str, list[str]]:
    """Return what costs or stays in the account, by kind; machines that have ended are no part of it."""
    import boto3

    found: dict[str, list[str]] = {}
    for region in (NEAR, FAR):
        client = boto3.client("ec2", region_name=region)
        instances = [
            each["InstanceId"]
            for some in client.describe_instances()["Reservations"]
            for each in some["Instances"]
            if each["State"]["Name"] != "terminated"
        ]
        found[f"{region} instances"] = instances
        found[f"{region} groups"] = [each["GroupName"] for each in client.describe_security_groups()["SecurityGroups"]]
        found[f"{region} volumes"] = [each["VolumeId"] for each in client.describe_volumes()["Volumes"]]
        found[f"{region} keys"] = [each["KeyName"] for each in client.describe_key_pairs()["KeyPairs"]]
        templates = client.describe_launch_templates()["LaunchTemplates"]
        found[f"{region} templates"] = [each["LaunchTemplateName"] for each in templates]
        found[f"{region} addresses"] = [each["PublicIp"] for each in client.describe_addresses()["Addresses"]]
        requests = client.describe_spot_instance_requests()["SpotInstanceRequests"]
        found[f"{region} requests"] = [each["SpotInstanceRequestId"] for each in requests if each["State"] == "open"]
    return found


@pytest.mark.nightly
def test_a_booted_replica_answers_the_robot_and_is_replaced_when_it_is_preempted(
    image: Path, wheels: Path, run: Run, space: Space, tmp_path: Path
) -> None:
    from lab.ec2 import DataCenter, serving_ec2

    space.ip("link", "set", "lo", "up")
    endpoints = {NEAR: start_echo(0.0), FAR: start_echo(0.05)}
    site = CloudSite(run, wheels, {each: f"udp://127.0.0.1:{port}" for each, port in endpoints.items()})
    center = DataCenter(run, image)
    try:
        with serving_ec2(center, tmp_path / "absent"):
            before = account()
            site.environment |= {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
            site.start_border()
            site.start_caller(5.0, "report_s:=0.5", heard=False)
            site.run("launch", str(launch_file(tmp_path)), "--detach", "--wait", str(_MACHINE_S))
            (first,) = site.serving("echo")
            assert first.spec.offer.region == NEAR
            center.until(lambda: answering(site) == {first.name}, "the replica answers the robot", _ANSWER_S)
            assert inbound_rules() == []
            assert copies_of_the_token(center, first) == ""
            assert f"echo-{first.name}" in site.tunnels()
            center.interrupt(first.id.partition("/")[2], 2.0)

            def replaced() -> bool:
                return any(each.name != first.name for each in site.serving("echo"))

            center.until(replaced, "a preempted machine is replaced", _MACHINE_S)
            (second,) = site.serving("echo")
            center.until(lambda: second.name in answering(site), "its replacement answers the robot", _ANSWER_S)
            assert site.members()[f"echo-{first.name}"] == "revoked"
            assert f"echo-{first.name}" not in site.tunnels()
            assert "cloud-init" in center.machines[second.id.partition("/")[2]].console
            site.run("down", "--all")
            assert account() == before
            assert {label for label, state in site.members().items() if state != "revoked"} == {"border"}
            assert site.tunnels() == []
            assert not any(each.is_up for each in center.machines.values())
    finally:
        center.close()
        site.close()
    run.end()
    assert not leftovers(tmp_path, [run.id])


def boot(runs: str, image: str) -> None:
    """Boot a machine, print the id of its run, and wait; a process of its own."""
    run = RunRegistry(Path(runs)).start()
    booted = BootedMachine(run, "m1", Path(image), Router(run).add("m1"))
    until(lambda: "systemd" in booted.console)
    print(run.id, flush=True)
    signal.pause()


@pytest.mark.nightly
def test_a_machine_goes_also_when_its_creator_was_killed(image: Path, machine: LabMachine, space: Space) -> None:
    runs = machine.folder / "runs"
    child = machine.launch(calling(boot, runs, image))
    made = child.read_line(_MACHINE_S).decode()
    assert leftovers(machine.folder, [made])
    machine.kill(child)
    assert RunRegistry(runs).sweep() == [made]
    assert not leftovers(machine.folder, [made])


def inbound_rules() -> list[str]:
    """Return what security groups of the account let in, but those that each region has from the start."""
    import boto3

    groups = [
        each
        for region in (NEAR, FAR)
        for each in boto3.client("ec2", region_name=region).describe_security_groups()["SecurityGroups"]
        if each["GroupName"] != "default"
    ]
    assert groups
    return [str(rule) for each in groups for rule in each["IpPermissions"]]


def copies_of_the_token(center: DataCenter, machine: Record) -> str:
    """Return the files of a machine, one a line, that hold the token with which it has joined."""
    identifier = machine.id.partition("/")[2]
    data = gzip.decompress(center.document(identifier).user_data).decode()
    (token,) = set(re.findall(r"gdp1[a-z2-7]+", data))
    folders = ["/etc", "/opt/fog-software", "/root", "/run", "/tmp", "/var/lib/cloud", "/var/lib/fog", "/var/log"]
    search = f"grep -rlsF {token} {' '.join(folders)} || true"
    return center.machines[identifier].run("sh", "-c", search)


def answering(site: CloudSite) -> frozenset[str]:
    """Return the machines that have answered the robot's node until now."""
    logged = (site.folder / "caller.log").read_text().splitlines(keepends=True)
    whole = [line for line in logged if line.startswith("{") and line.endswith("\n")]
    return frozenset(json.loads(whole[-1])["by_machine"]) if whole else frozenset()
