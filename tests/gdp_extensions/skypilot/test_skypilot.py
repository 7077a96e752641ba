"""Provider ``skypilot``: its requests to a stand-in for the package; the package itself with a seeded
catalogue and its own API server, in a process of its own, where it is installed.
"""

from __future__ import annotations

import enum
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest
from pydantic import ValidationError

from fog.hardware import Hardware, Offer
from fog.machine import MachineBundle, MachineSpec, MachineState, Program
from fog.providers.cloud_config import SkyPilotConfig
from gdp.errors import LocalError, StoreError
from gdp_extensions.skypilot.provider import SkyPilotProvider
from gdp_extensions.skypilot.record import cluster_name, labels_of

EAST = "aws/us-east-1"
OFFER = Offer("skypilot", EAST, "g4dn.xlarge", Hardware(4, 16.0, "T4", 1), is_spot=True, usd_per_hour=0.16)
SPEC = MachineSpec("a-demo", "m1", OFFER)
BOOT = MachineBundle({"keys/own.key": b"\x00\xff"}, (Program("switch", ("gdp-switch",)),))


class State(enum.Enum):
    INIT = "INIT"
    UP = "UP"
    STOPPED = "STOPPED"


class ClusterDoesNotExist(ValueError):  # noqa: N818
    pass


class NoCloudAccessError(Exception):
    pass


@dataclass
class Sky:
    """Stand-in for the package: the requests it got, and the machines that exist."""

    records: list[SimpleNamespace] = field(default_factory=list)
    requests: list[SimpleNamespace] = field(default_factory=list)
    asked: list[tuple[str, SimpleNamespace | str]] = field(default_factory=list)
    fails: Exception | None = None

    exceptions = SimpleNamespace(ClusterDoesNotExist=ClusterDoesNotExist, NoCloudAccessError=NoCloudAccessError)
    StatusRefreshMode = SimpleNamespace(AUTO="auto")

    def Resources(self, **wanted: object) -> dict[str, object]:  # noqa: N802
        return wanted

    def Task(self, name: str, **parts: object) -> SimpleNamespace:  # noqa: N802
        return SimpleNamespace(name=name, **parts)

    def launch(self, task: SimpleNamespace, cluster_name: str, dryrun: bool = False) -> str:
        if self.fails:
            raise self.fails
        self.asked.append(("dry run" if dryrun else "launch", task))
        self.requests.append(SimpleNamespace(name="sky.launch", cluster_name=cluster_name, created_at=5.0))
        return cluster_name

    def exec(self, task: SimpleNamespace, cluster_name: str) -> str:
        self.asked.append((task.run, cluster_name))
        return "done"

    def status(self, refresh: str) -> list[SimpleNamespace]:
        return self.records

    def api_status(self) -> list[SimpleNamespace]:
        return self.requests

    def down(self, name: str) -> str:
        self.asked.append(("down", name))
        return f"down {name}"

    def tail_logs(self, name: str, job: None, *, follow: bool, preload_content: bool) -> Iterator[str | None]:
        yield from ("host switch[7]: one\n", None, "host proxy[8]: two\n", "host switch[7]: three\n")

    def get(self, request: object) -> object:
        if request == "down fog-a-demo-gone":
            raise ClusterDoesNotExist(request)
        return request

    def record(self, spec: MachineSpec, state: State, **more: object) -> None:
        said = {"launched_at": 7, "labels": labels_of(spec), "init_kind": None, "init_status_reason": None}
        handle = SimpleNamespace(head_ip="192.0.2.1")
        said = {"name": cluster_name(spec), "status": state, "handle": handle, **said, **more}
        self.records.append(SimpleNamespace(**said))


@pytest.fixture
def sky() -> Sky:
    return Sky()


@pytest.fixture
def provider(sky: Sky) -> SkyPilotProvider:
    return SkyPilotProvider(SkyPilotConfig(), sky)  # type: ignore[arg-type]


def test_a_machine_is_asked_for_as_its_offer_says(sky: Sky, provider: SkyPilotProvider) -> None:
    assert provider.create(SPEC, BOOT) == "fog-a-demo-m1"
    ((what, task),) = sky.asked
    assert what == "launch"
    assert isinstance(task, SimpleNamespace)
    resources = task.resources
    assert (resources["infra"], resources["instance_type"], resources["use_spot"]) == (EAST, "g4dn.xlarge", True)
    assert resources["accelerators"] == "T4:1"
    assert "systemctl enable --now --no-block fog-machine" in task.setup


def test_a_machine_that_is_being_made_is_booting_until_there_is_a_record(sky: Sky, provider: SkyPilotProvider) -> None:
    provider.create(SPEC, BOOT)
    (machine,) = provider.describe("a-demo")
    assert (machine.id, machine.spec.name, machine.state) == ("fog-a-demo-m1", "m1", MachineState.BOOTING)
    sky.record(SPEC, State.UP)
    (machine,) = provider.describe("a-demo")
    assert (machine.spec, machine.state, machine.address) == (SPEC, MachineState.RUNNING, "192.0.2.1")


def test_only_the_clusters_own_machines_are_described(sky: Sky, provider: SkyPilotProvider) -> None:
    sky.record(SPEC, State.UP)
    provider.create(SPEC, BOOT)
    sky.records.append(SimpleNamespace(name="mine", labels=None))
    assert provider.describe("a") == []
    assert len(provider.describe("a-demo")) == 1


@pytest.mark.parametrize(
    ("state", "more", "expected"),
    [
        (State.INIT, {"init_kind": "launching"}, (MachineState.BOOTING, "")),
        (State.INIT, {"init_kind": "unhealthy", "init_status_reason": "taken"}, (MachineState.LEAVING, "taken")),
        (State.STOPPED, {}, (MachineState.LEAVING, "stopped")),
    ],
)
def test_states_are_those_of_a_machine(
    sky: Sky,
    provider: SkyPilotProvider,
    state: State,
    more: dict[str, object],
    expected: tuple[MachineState, str],
) -> None:
    sky.record(SPEC, state, **more)
    (machine,) = provider.describe("a-demo")
    assert (machine.state, machine.reason) == expected


def test_changed_labels_are_reported(sky: Sky, provider: SkyPilotProvider) -> None:
    sky.record(SPEC, State.UP, labels={"fog-cluster": b"a-demo".hex()})
    with pytest.raises(LocalError, match="labels make no sense"):
        provider.describe("a-demo")


def test_giving_back_what_is_gone_is_fine(sky: Sky, provider: SkyPilotProvider) -> None:
    provider.terminate(["fog-a-demo-gone", "fog-a-demo-m1"])
    assert sky.asked == [("down", "fog-a-demo-gone"), ("down", "fog-a-demo-m1")]


def test_a_machine_is_drained_by_a_signal_to_its_service(sky: Sky, provider: SkyPilotProvider) -> None:
    provider.drain("fog-a-demo-m1")
    assert "USR1 fog-machine" in str(sky.asked[0])


def test_the_last_lines_of_a_program_are_shown(provider: SkyPilotProvider) -> None:
    assert provider.log("fog-a-demo-m1", "switch", 1) == "host switch[7]: three"
    assert provider.log("fog-a-demo-m1", "switch", 9) == "host switch[7]: one\nhost switch[7]: three"
    assert provider.shell("fog-a-demo-m1") == ["ssh", "fog-a-demo-m1"]


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        (NoCloudAccessError("no cloud is enabled"), LocalError),
        (ValueError("infra: no such region"), LocalError),
        (RuntimeError("the API server is away"), StoreError),
    ],
)
def test_a_refusal_says_whether_it_may_be_asked_again(
    sky: Sky, provider: SkyPilotProvider, raised: Exception, expected: type[Exception]
) -> None:
    sky.fails = raised
    with pytest.raises(expected, match=str(raised)):
        provider.create(SPEC, BOOT)


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sky", None)
    with pytest.raises(LocalError, match="pip install"):
        SkyPilotProvider()


CATALOGUE = {
    "aws/vms.csv": """\
InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,GpuInfo,Price,SpotPrice,Region,AvailabilityZone,Arch,\
LocalDiskType,NVMeSupported,LocalDiskSize,LocalDiskCount,MaximumEfaInterfaces
m6i.4xlarge,,,16,64,,0.75,0.25,us-east-1,use1-az1,x86_64,,,,,
m6i.4xlarge,,,16,64,,0.75,0.2,us-west-2,usw2-az1,x86_64,,,,,
g4dn.xlarge,T4,1,4,16,"{'Gpus': [{'Name': 'T4', 'Count': 1.0, 'MemoryInfo': {'SizeInMiB': 16384}}]}",0.5,0.1,\
us-east-1,use1-az1,x86_64,,,,,
""",
    "aws/images.csv": """\
Tag,Region,OS,OSVersion,ImageId,CreationDate,BaseImageId
skypilot:custom-cpu-ubuntu,us-east-1,ubuntu,22.04,IMAGE,20260101,IMAGE
skypilot:custom-cpu-ubuntu,us-west-2,ubuntu,22.04,IMAGE,20260101,IMAGE
""",
    "aws/instance_quota_mapping.csv": "SpotInstanceCode,OnDemandInstanceCode,InstanceType\n",
    "common/accelerators.csv": "AcceleratorName,Clouds\nT4,[AWS]\n",
}
PYTHON = os.environ.get("FOG_SKYPILOT_PYTHON", sys.executable)  # SkyPilot may be in a virtual environment of its own


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Home folder with prices made up for this test, and programs whose presence alone SkyPilot checks."""
    if sys.executable == PYTHON and not importlib.util.find_spec("sky"):
        pytest.skip("the extra `skypilot` is not installed, and FOG_SKYPILOT_PYTHON names no interpreter that has it")
    for path, text in CATALOGUE.items():
        place = tmp_path / ".sky" / "catalogs" / "v8" / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)
    credentials = tmp_path / ".aws" / "credentials"
    credentials.parent.mkdir()
    credentials.write_text("[default]\naws_access_key_id = testing\naws_secret_access_key = testing\n")
    for program in ("aws", "rsync"):
        stub = tmp_path / "bin" / program
        stub.parent.mkdir(exist_ok=True)
        stub.write_text("#!/bin/sh\n")
        stub.chmod(0o755)
    return tmp_path


def an_image(region: str, endpoint: str) -> str:
    """Return an image that moto's EC2 has."""
    boto3 = pytest.importorskip("boto3", reason="the extra `aws` is not installed")
    keys = {"aws_access_key_id": "testing", "aws_secret_access_key": "testing"}
    client = boto3.client("ec2", region_name=region, endpoint_url=endpoint, **keys)
    found: str = client.describe_images(Owners=["099720109477"])["Images"][0]["ImageId"]
    client.close()
    return found


@pytest.mark.nightly
def test_the_real_package_takes_our_tasks_in_a_dry_run(home: Path) -> None:
    moto_server = pytest.importorskip("moto.server", reason="moto[ec2,server] of the extra `dev` is not installed")
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    images = home / ".sky" / "catalogs" / "v8" / "aws" / "images.csv"
    images.write_text(images.read_text().replace("IMAGE", an_image("us-west-2", endpoint)))
    environment = {
        "HOME": str(home),
        "PATH": f"{home / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": str(Path(__file__).parents[3]),
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_DEFAULT_REGION": "us-east-1",
        "SKYPILOT_DISABLE_USAGE_COLLECTION": "1",
    }
    try:
        done = subprocess.run(
            [PYTHON, "-m", "tests.gdp_extensions.skypilot.skypilot_child"],
            env=environment,
            cwd=home,
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
    finally:
        server.stop()
    assert done.returncode == 0, done.stderr
    reported = json.loads(done.stdout.splitlines()[-1])
    assert reported["enabled"] == [["AWS"]]
    assert [(each["region"], each["usd_per_hour"]) for each in reported["offers"]] == [
        ("aws/us-west-2", 0.2),
        (EAST, 0.25),
    ]
    assert reported["offers"][0]["hardware"] == {"cpus": 16, "memory_gib": 64.0, "gpu": "", "gpus": 0}
    assert (reported["gpu"], reported["none"]) == (["g4dn.xlarge"], [])
    assert reported["dry run"] == "None"
    assert reported["no such type"].startswith("LocalError")
    assert "nope.large" in reported["no such type"]
    assert reported["no such region"].startswith("LocalError")
    assert "nowhere" in reported["no such region"]
    assert (reported["machines"], reported["terminate"]) == ("[]", "None")
    task = reported["task"]
    assert task["types"] == ["m6i.4xlarge"]
    assert "systemctl enable --now --no-block fog-machine" in task["setup"]
    assert task["run"].startswith("sudo journalctl --follow --unit fog-machine")
    assert "sky-payload" in reported["printed by a server"], "the stand-in is none: SkyPilot prints such lines"
    assert reported["printed by a client"] == ""


@pytest.mark.parametrize("place", ["kubernetes", "k8s/kind-skypilot", "Kubernetes/lab", "ssh/pool"])
def test_places_with_pods_are_refused_before_anything_costs(place: str) -> None:
    with pytest.raises(ValidationError, match=r"is Kubernetes: its pods have no systemd and no CAP_NET_ADMIN"):
        SkyPilotConfig(places=(place,))


def test_names_too_long_for_a_label_are_refused() -> None:
    with pytest.raises(LocalError, match="too long"):
        labels_of(MachineSpec("c" * 40, "m1", OFFER))
