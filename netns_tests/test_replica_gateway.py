"""Gateway machine of a group: its switch forwards to the others, and the role moves when the machine is lost.

::

    [robot, RIB] === fog0 === bridge === up [m1] eth0 === segment === eth0 [m2]  eth0 [m3]
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
from pyroute2 import IPRoute

from fog.providers.local import fault_injection
from fog.providers.local.machine_handle import find
from fog.providers.local.netlinks import UP, exists
from fog.providers.local.provider import LocalProvider
from fog.site import open_site
from fog.supervisor import background
from fog.supervisor.infrastructure import local_provider
from fog.supervisor.journal import Journal
from fog.topology import AUTOMATIC_REPLICA, Gateway
from gdp.errors import LocalError
from gdp.host import netns_files
from gdp.intervals import SERVER
from gdp.metadata import Metadata
from lab.namespaces import Space
from lab.process import until
from netns_tests.local_site import (
    PATIENCE_S,
    Domain,
    is_running,
    leftovers,
    machine_of,
    plain_gateway,
    spec,
    ticking,
)
from netns_tests.test_fog import Fog, fog
from netns_tests.test_uplink import BYTES, OVERHEAD_BYTES, PARTS, REQUESTS, tell
from tests.pages import ROOT

__all__ = ["fog"]  # a fixture

pytestmark = pytest.mark.netns
needs_ros2 = pytest.mark.skipif(find_spec("rclpy") is None, reason="rclpy is not installed: scripts/setup.sh --ros2")

SERVICE = Metadata({"kind": "service", "name": "/plan", "type": "std_srvs/srv/SetBool"})
ECHO = ROOT / "examples" / "echo.launch.py"


@pytest.fixture
def provider(tmp_path: Path, space: Space) -> Iterator[LocalProvider]:
    folder = tmp_path / "local"
    made = LocalProvider(folder, plain_gateway, AUTOMATIC_REPLICA)
    made.open_network()
    yield made
    runs = [record.run for record in made.runs.all()]
    made.terminate([each.id for each in made.describe("test")])
    made.close_network()
    assert leftovers(folder, runs) == []
    assert not exists(None, "fog0")


def received_bytes(machine: str, provider: LocalProvider) -> int:
    """Return the traffic out of the robot's uplink at its far end: the device of the gateway's namespace."""

    def look() -> int:
        with IPRoute() as ipr:
            (link,) = ipr.get_links(ifname=UP)
            return int(link.get_attr("IFLA_STATS64")["rx_bytes"])

    return netns_files.inside(find(provider.runs, machine).gateway, look)


@pytest.mark.nightly
def test_a_group_without_machines_stands_until_it_is_closed(provider: LocalProvider) -> None:
    (network,) = provider.runs.all()
    assert provider.sweep() == []
    provider.open_network()
    assert [each.run for each in provider.runs.all()] == [network.run]


def test_the_uplink_moves_from_machine_to_machine(provider: LocalProvider) -> None:
    first, second = (provider.create(spec(name), ticking()) for name in ("m1", "m2"))
    provider.attach_uplink(first)
    provider.attach_uplink(first)
    assert machine_of(provider, first).is_gateway
    assert exists(find(provider.runs, first).netns_path, UP)
    provider.attach_uplink(second)
    provider.detach_uplink(first)
    provider.detach_uplink(first)
    assert [machine_of(provider, each).is_gateway for each in (first, second)] == [False, True]
    assert not exists(find(provider.runs, first).netns_path, UP)
    lost = find(provider.runs, second)
    fault_injection.kill(provider.runs, second)
    assert not exists(lost.gateway, lost.uplink_plug)
    assert exists(lost.gateway, UP)


@pytest.mark.nightly
def test_behind_a_dedicated_gateway_no_machine_is_one(tmp_path: Path, space: Space) -> None:
    west = Gateway(gateway="west", replica=True, regions=("us-west-1",))
    provider = LocalProvider(tmp_path / "local", plain_gateway, Gateway(gateway="edge", children=(west,)))
    provider.open_network()
    try:
        outside, behind = (provider.create(spec(name, region), ticking()) for name, region in
                          (("m1", "mars-1"), ("m2", "us-west-1")))  # fmt: skip
        with pytest.raises(LocalError, match="mars-1 is dedicated"):
            provider.attach_uplink(outside)
        provider.attach_uplink(behind)
        assert (provider.replica_gateway("mars-1"), provider.replica_gateway("us-west-1")) == ("", "west")
    finally:
        provider.terminate([each.id for each in provider.describe("test")])
        provider.close_network()


@pytest.mark.nightly
def test_the_uplink_carries_one_copy_of_a_request_whichever_machine_is_the_gateway(
    provider: LocalProvider, tmp_path: Path
) -> None:
    domain = Domain(tmp_path)
    domain.start_robot("fog0", "client0")
    try:
        machines = [provider.create(spec(name), domain.replica(name, SERVICE)) for name in ("m1", "m2", "m3")]
        provider.attach_uplink(machines[0])
        for each in machines:
            until(partial(is_running, provider, each), "running")
        client = domain.start_client("client0", SERVICE, REQUESTS, BYTES)
        once = REQUESTS * (BYTES + PARTS * OVERHEAD_BYTES)
        for gateway, before in ((machines[0], None), (machines[1], machines[0])):
            provider.attach_uplink(gateway)
            if before is not None:
                provider.detach_uplink(before)
            tell(client, len(machines))
            for _ in range(2):  # while the trees follow the moved uplink, some requests are sent twice
                tell(client, "go")
            sent = received_bytes(gateway, provider)
            tell(client, "go")
            assert once < received_bytes(gateway, provider) - sent < 1.5 * once  # two copies are 2.0 or more
    finally:
        domain.close()


@pytest.mark.nightly
@needs_ros2
def test_calls_go_on_when_the_machine_that_is_the_gateway_is_killed(fog: Fog) -> None:
    fog.run("launch", str(ECHO), "--gateway", "replica", "--detach")
    fog.run("scale", "up")
    fog.until(lambda: len(fog.serving()) == 3 and all(each.up_unix_s for each in fog.living()), "three replicas serve")
    caller = fog.start_caller(20.0, "depth:=1000")
    while not caller.read(PATIENCE_S)["answered"]:
        pass
    (lost,) = (each for each in fog.living() if each.gateway)
    host = find(local_provider(open_site(None, fog.state)).runs, lost.id).host
    assert host is not None
    moves, looks = (fog.events().count(each) for each in ("gateway", "reconciled"))
    os.kill(fog.status()["supervisor_pid"], signal.SIGKILL)
    fog.until(lambda: not background.is_running(open_site(None, fog.state)), "the supervisor has gone")
    (known,) = (each["name"] for each in fog.status()["members"] if each["gateway"])  # starts another supervisor
    assert known == lost.name
    fog.until(lambda: fog.events().count("reconciled") > looks, "the other supervisor has looked")
    assert fog.events().count("gateway") == moves
    os.kill(host.pid, signal.SIGKILL)  # the kernel ends its programs; its devices stay
    fog.until(lambda: {each.name for each in fog.living() if each.gateway} - {lost.name}, "the role moves")
    fog.until(lambda: len({*fog.serving()} - {lost.name}) == 3, "the killed machine is replaced")
    (now,) = (each.name for each in fog.living() if each.gateway)
    lines = [json.loads(line) for line in caller.finish(signal.SIGUSR1).splitlines()]
    last, silence_s = lines[-1], max(each["silence_ms"] for each in lines) / 1e3
    counts = {key: last[key] for key in ("calls", "answered", "failed", "wrong", "unserved")}
    print(f"silence {silence_s:.2f} s, {counts}")  # visible with pytest -s: the cost of a lost gateway
    assert last["answered"] + last["failed"] == last["calls"]
    if silence_s < SERVER.lease_s:  # on a busy machine the hand-over may take longer; then servers count as gone
        assert last["failed"] == last["wrong"] == last["unserved"] == 0
    assert lines[-2]["answered"] < last["answered"]
    assert now in fog.run("status")
    with closing(Journal(fog.state / "journal.sqlite3")) as journal:
        moved = [(each.machine, each.detail) for each in journal.events("echo") if each.what == "gateway"]
    assert moved[moves:] == [(now, f"of gateway: {lost.name} is gone: killed")]
