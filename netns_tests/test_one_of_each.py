"""Real switches, RIBs and proxies of one host: a second one is refused, and one that cannot work logs the reason."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.host.single_instance import lock_directory
from netns_tests.spaces import Space
from netns_tests.test_pairs import devices

pytestmark = pytest.mark.netns

_PATIENCE_S = 60.0
_MACS = bytes.fromhex("020000000001"), bytes.fromhex("020000000002")
_PROXY = "identity: proxy\ndomain: {root: proxy/root.crt}\ndelegations: proxy/delegations\niface: proxy0\n"
_OTHER_HOST = (
    "unshare",
    "--mount",
    "sh",
    "-c",
    'mount -t tmpfs -o mode=700 locks "$0" && exec "$@"',
    str(lock_directory()),
)
_PROGRAMS = {"switch": "gdp.cli.switch", "rib": "gdp.cli.rib", "proxy": "proxy.cli.proxy"}


class Node:
    """Running command; its output is collected as it arrives."""

    def __init__(self, argv: list[str]) -> None:
        self.process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.said: list[str] = []
        self._news = threading.Condition()
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._news:
                self.said.append(line)
                self._news.notify_all()

    def says(self, *words: str) -> str:
        """Return the first line with all these words when it arrives."""

        def found() -> str | None:
            return next((line for line in self.said if all(word in line for word in words)), None)

        with self._news:
            self._news.wait_for(found, _PATIENCE_S)
            line = found()
        assert line is not None, f"{words} not in {self.said}"
        return line

    def end(self, how: signal.Signals = signal.SIGINT) -> int:
        """End it, if it still runs; return its exit code."""
        self.process.send_signal(how)
        code = self.process.wait(_PATIENCE_S)
        self._reading.join(_PATIENCE_S)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code


Start = Callable[..., Node]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Factory of nodes of the lab ``robot`` and ``server`` in the thread's namespace; running nodes are ended."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["lab", "robot", "server"])
    Path("robot/proxy.yaml").write_text(_PROXY)
    nodes: list[Node] = []

    def begin(host: str, what: str, *options: str, on_another_host: bool = False) -> Node:
        argv = [sys.executable, "-m", _PROGRAMS[what], "--config", f"{host}/{what}.yaml", *options]
        nodes.append(Node([*(_OTHER_HOST if on_another_host else ()), *argv]))
        return nodes[-1]

    yield begin
    for node in nodes:
        node.end(signal.SIGKILL)


def test_a_second_switch_is_refused_and_leaves_the_first_ones_devices_alone(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    first = start("robot", "switch")
    first.says(" is up")
    rib = start("robot", "rib")
    rib.says(" is up")
    before = devices()
    second = start("robot", "switch", "--iface", "far0")
    second.says("error: this switch already runs, pid", str(first.process.pid), "robot/switch.yaml", "stop it first")
    assert second.process.wait(_PATIENCE_S) == 2
    assert devices() == before
    second_rib = start("robot", "rib")
    second_rib.says("error: this RIB already runs, pid", str(rib.process.pid))
    assert second_rib.process.wait(_PATIENCE_S) == 2
    assert (first.process.poll(), rib.process.poll()) == (None, None)


def test_another_switch_on_the_same_device_is_refused(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    first = start("robot", "switch")
    first.says(" is up")
    second = start("server", "switch")
    second.says("error: eth0 is in use by another node, pid", str(first.process.pid))
    assert second.process.wait(_PATIENCE_S) == 2


def test_the_same_identity_is_refused_in_another_network_namespace_and_from_a_copied_folder(
    space: Space, start: Start
) -> None:
    space.veth("eth0", "far0", *_MACS)
    start("robot", "switch").says(" is up")
    subprocess.run(["cp", "-rp", "robot", "copy"], check=True)
    with Space() as other:
        other.veth("eth0", "far0", *_MACS)
        second = start("copy", "switch")
    second.says("error: this switch already runs, pid")
    assert second.process.wait(_PATIENCE_S) == 2


def test_of_two_switches_with_one_identity_on_two_hosts_the_older_one_stays_and_both_say_so(
    space: Space, start: Start
) -> None:
    space.veth("eth0", "far0", *_MACS)
    space.veth("eth1", "far1", bytes.fromhex("020000000003"), bytes.fromhex("020000000004"))
    subprocess.run(["cp", "-rp", "robot", "copy"], check=True)
    head = Path("robot/switch.yaml").read_text().split("ports:")[0]
    for host, ports in (("robot", "eth0"), ("copy", "eth1"), ("server", "far0}, {iface: far1")):
        Path(host, "switch.yaml").write_text(f"{head}ports: [{{iface: {ports}}}]\n")
    start("server", "switch").says(" is up")
    first = start("robot", "switch")
    first.says("neighbour up port=eth0")
    second = start("copy", "switch", on_another_host=True)
    second.says("waiting: another node with this identity")
    first.says("another node with this identity is alive")
    first.end(signal.SIGKILL)
    second.says("neighbour up port=eth1")


def test_a_second_proxy_is_refused_and_a_killed_one_can_be_started_at_once(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    start("robot", "switch").says(" is up")
    start("robot", "rib").says(" is up")
    first = start("robot", "proxy")
    first.says(" is attached")
    second = start("robot", "proxy")
    second.says("error: this proxy already runs, pid", str(first.process.pid))
    assert second.process.wait(_PATIENCE_S) == 2
    first.end(signal.SIGKILL)
    start("robot", "proxy").says(" is attached")


def test_a_proxy_says_that_its_device_comes_with_a_switch(space: Space, start: Start) -> None:
    start("robot", "proxy").says("error: proxy0: no such device; start gdp-switch with attach: [proxy0] first")


def test_a_switch_reports_that_its_link_is_down_and_then_that_no_neighbour_answers(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    space.ip("set", "far0", "down")
    switch = start("robot", "switch")
    switch.says("WARNING", "waiting: link down on eth0")
    switch.says("WARNING", "waiting: no RIB of this domain can be reached")
    space.ip("set", "far0", "up")
    switch.says("WARNING", "waiting: no neighbour on eth0: no answer there")
    assert sum("link down" in line for line in switch.said) == 1


def test_a_proxy_without_a_rib_says_so_and_is_attached_when_there_is_one(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    start("robot", "switch").says(" is up")
    proxy = start("robot", "proxy", "--json")
    proxy.says('"waiting"', '"no-rib"', "no RIB answers the switch")
    start("robot", "rib").says(" is up")
    proxy.says('"ready"')


def test_switches_of_two_domains_that_do_not_trust_each_other_say_so(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    with pytest.raises(SystemExit):
        main(["lab", "other", "--domain", "stranger", "--iface", "far0"])
    file = Path("other/switch.yaml")
    file.write_text("".join(line for line in file.read_text().splitlines(True) if not line.startswith("attach")))
    one, other = start("robot", "switch", "-v"), start("other", "switch")
    one.says("WARNING", "neighbour on eth0 of domain stranger, which is not trusted here")
    other.says("WARNING", "neighbour on far0 of domain lab, which is not trusted here")
    assert not any("pyroute2" in line for line in one.said)
