"""Shared memory of the benches' machines: used within one, and never between two."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "scripts" / "bench"))


from gdp.host.run_registry import RunRegistry
from lab.dds import ros_environment
from lab.machine import LabMachine
from lab.machines import Lab
from lab.process import ROOT, calling, new_run, python_path
from lab.topology import chain
from tests.proxy.endpoints.ros2_net import Peer, needs

needs("std_msgs")

pytestmark = pytest.mark.netns

DOMAIN = 144
IMAGE_BYTES = 900_000
IMAGES = 20
QUIET_S = 0.3  # shared memory takes less than a millisecond
OCTETS = "sum(int(line.split()[1]) for line in open('/proc/net/dev').read().splitlines()[2:])"


@pytest.fixture
def lab() -> Iterator[Lab]:
    """Machines s1 and s2 at the ends of a cable with IPv4."""
    with new_run() as run:
        made = Lab(run, chain(2), own_shared_memory=("s1", "s2"))
        for node, device, address in (("s1", "s2", "10.97.0.1"), ("s2", "s1", "10.97.0.2")):
            made.namespaces[node].configure([f"addr add {address}/24 dev {device}"])
        yield made


@contextmanager
def peers(lab: Lab, topic: str, talks: str, listens: str) -> Iterator[tuple[Peer, Peer]]:
    """Start a talker and a listener on two machines, which have met; their Fast DDS has shared memory and UDP."""
    with ExitStack() as stack:
        talker, listener = (
            Peer(name, lab.command(node, [], ros_environment(lab.directory, DOMAIN, shared_memory=True)), {})
            for name, node in (("talker", talks), ("listener", listens))
        )
        for peer in (talker, listener):
            stack.callback(peer.end)
            peer.tell("!from std_msgs.msg import String")
        listener.tell(f"!listen(String, {topic!r})")
        talker.tell(f"!out = talk(String, {topic!r})")
        talker.waits_for("out.get_subscription_count()", 1)
        yield talker, listener


@pytest.mark.nightly
def test_nothing_crosses_between_machines_while_their_cable_is_cut(lab: Lab) -> None:
    with peers(lab, "/news", "s1", "s2") as (talker, listener):
        talker.tell("out.publish(String(data='before'))")
        listener.waits_for("len(heard['/news'])", 1)
        lab.namespaces.cut("s1", "s2")
        talker.tell("out.publish(String(data='while cut'))")
        time.sleep(QUIET_S)  # no event says that nothing arrives
        assert listener.tell("len(heard['/news'])") == 1
        lab.namespaces.restore_link("s1", "s2")
        listener.waits_for("len(heard['/news'])", 2)


def test_nodes_of_one_machine_exchange_large_messages_through_shared_memory(lab: Lab) -> None:
    with peers(lab, "/images", "s1", "s1") as (talker, listener):
        before = int(str(talker.tell(OCTETS)))
        for number in range(1, IMAGES + 1):
            talker.tell(f"out.publish(String(data='x' * {IMAGE_BYTES}))")
            listener.waits_for("len(heard['/images'])", number)
        assert int(str(talker.tell(OCTETS))) - before < IMAGE_BYTES  # discovery and acknowledgements


@pytest.mark.nightly
def test_files_in_shared_memory_appear_on_their_machine_alone(lab: Lab) -> None:
    write = "import pathlib; pathlib.Path('/dev/shm/gdp-test').touch()"
    look = "import os; print('gdp-test' in os.listdir('/dev/shm'))"
    subprocess.run(lab.command("s1", [sys.executable, "-c", write]), check=True)
    found = [
        subprocess.run(lab.command(node, [sys.executable, "-c", look]), check=True, capture_output=True, text=True)
        for node in ("s1", "s2")
    ]
    assert [each.stdout.strip() for each in found] == ["True", "False"]
    assert not Path("/dev/shm/gdp-test").exists()


def keep_memory(folder: str) -> None:
    """Make a machine with shared memory of its own, print its folder, and wait; a process of its own."""
    tempfile.tempdir = folder
    lab = Lab(RunRegistry(Path(folder) / "runs").start(), chain(1), own_shared_memory=("s1",))
    print(lab.directory, flush=True)
    signal.pause()


@pytest.mark.nightly
def test_the_memory_of_a_killed_run_is_swept_by_the_next(machine: LabMachine, tmp_path: Path) -> None:
    machine.environment["PYTHONPATH"] = python_path(ROOT / "scripts" / "bench")
    process = machine.launch(calling(keep_memory, tmp_path))
    directory = process.read_line(20.0).decode()
    machine.kill(process)
    assert directory in Path("/proc/self/mounts").read_text(encoding="utf-8")
    assert len(RunRegistry(tmp_path / "runs").sweep()) == 1
    assert directory not in Path("/proc/self/mounts").read_text(encoding="utf-8")
    assert not Path(directory).exists()
