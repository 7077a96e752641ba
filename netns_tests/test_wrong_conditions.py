"""Wrong conditions of ``gdp join`` and ``gdp domain create``: one sentence with what to do, exit code 2, no remains."""

from __future__ import annotations

import os
import shlex
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from gdp.host.run_registry import RunRegistry
from lab.internet.access import Access
from lab.internet.fresh_machine import FreshMachine
from lab.internet.laboratory import Laboratory

pytestmark = [
    pytest.mark.netns,
    pytest.mark.skipif(os.geteuid() != 0, reason="only root mounts"),
    pytest.mark.skipif(
        shutil.which("wireguard-go") is None or not os.access("/dev/net/tun", os.R_OK | os.W_OK),
        reason="needs wireguard-go and /dev/net/tun",
    ),
]

PATIENCE_S = 60.0
JOIN = "gdp join --label robot"
_HOLD = "echo mounted && exec sleep infinity"
HOURS_OFF = "import time; true = time.time; time.time = lambda: true() - 10_800"
LISTEN = "import socket, time; bound = socket.{}; print('bound', flush=True); time.sleep(600)"


@dataclass
class Field:
    """A border with a running domain, and a fresh robot and a fresh second border."""

    border: FreshMachine
    robot: FreshMachine
    second: FreshMachine
    blocked: FreshMachine
    tokens: list[str] = field(default_factory=list)

    def refusal(self, machine: FreshMachine, command: str, mounts: str = "") -> str:
        """Return the sentence with which a command ends; it must leave nothing behind.

        Args:
            mounts: a shell command that changes what this command sees of the machine's files.
        """
        with ExitStack() as stack:
            inside = ""
            if mounts:
                argv = ["unshare", "--mount", "--propagation", "private", "--", "sh", "-c", f"{mounts} && {_HOLD}"]
                holder = stack.enter_context(machine.launch(argv))
                holder.read_until("mounted")
                inside = f"nsenter --mount=/proc/{holder.pid}/ns/mnt -- "
            shell = machine.type(inside + command, self.tokens[-1])
            shell.reap(PATIENCE_S)
            assert shell.code == 2, shell.logged
            assert len(shell.logged.splitlines()) == 1, shell.logged
            for look in ("ls -A /var/lib", f"{inside}find /var/lib -mindepth 1 -not -path /var/lib/gdp"):
                left = machine.type(look)
                left.output(PATIENCE_S)
                assert left.logged == ""
        return shell.logged


@pytest.fixture(scope="module")
def site() -> Iterator[Field]:
    runs = RunRegistry(Path(tempfile.gettempdir()) / f"gdp-conditions-{os.getuid()}")
    runs.sweep()
    run = runs.start()
    try:
        with Laboratory(run) as laboratory, ExitStack() as stack:

            def add(label: str, access: Access) -> FreshMachine:
                host = laboratory.add_host(label, laboratory.add_site(f"at-{label}", access))
                return stack.enter_context(FreshMachine(host, run.directory))

            border, second = add("border", Access.PUBLIC), add("second", Access.PUBLIC)
            robot, blocked = add("robot", Access.PORT_RESTRICTED), add("blocked", Access.UDP_BLOCKED)
            made = Field(border, robot, second, blocked)
            address = border.host.lease().address.partition("/")[0]
            created = border.type(f"gdp domain create lab --public {address} --tokens 2")
            created.until_logged("listening on TCP port", patience_s=PATIENCE_S)
            made.tokens += [line for line in created.logged.splitlines() if line.startswith("gdp1")]
            yield made
    finally:
        run.end()


def test_without_wireguard_a_machine_does_not_join(site: Field) -> None:
    hidden = "mount --bind /dev/null $(command -v wireguard-go)"
    assert "install --no-install-recommends wireguard-go" in site.refusal(site.robot, JOIN, hidden)


def test_without_a_tun_device_a_machine_does_not_join(site: Field) -> None:
    text = site.refusal(site.robot, JOIN, "mount --bind /var/lib /dev/net")
    assert "needs /dev/net/tun, which does not exist; modprobe tun" in text


def test_without_the_right_to_make_devices_a_machine_does_not_join(site: Field) -> None:
    text = site.refusal(site.robot, f"setpriv --bounding-set=-net_admin -- {JOIN}")
    assert "not permitted; run this as root" in text


def test_a_machine_whose_clock_is_hours_off_does_not_join(site: Field) -> None:
    words = JOIN.split()[1:]
    command = f"python -c {shlex.quote(f'{HOURS_OFF}; from gdp.cli.gdp import main; main({words})')}"
    assert "clock is 3.0 hours behind the server's: set the clock" in site.refusal(site.robot, command)


def test_a_machine_that_does_not_reach_the_border_does_not_join(site: Field) -> None:
    site.border.host.unplug()
    try:
        text = site.refusal(site.robot, JOIN)
    finally:
        site.border.host.plug()
    assert "the enrolment server is not reachable" in text
    assert "check the network, and that TCP to it is let through" in text


@pytest.mark.parametrize("command", ["join", pytest.param("create", marks=pytest.mark.nightly)])
def test_on_a_full_disk_no_directory_is_left_and_no_token_used(site: Field, command: str) -> None:
    words = JOIN if command == "join" else "gdp domain create lab --public 192.0.2.1 --listen 51821 --relay-port 0"
    text = site.refusal(site.robot, words, "mount -t tmpfs -o size=512k tmpfs /var/lib")
    assert "No space left on device" in text
    assert "free some space, then run the command again" in text


@pytest.mark.parametrize(
    ("bound", "text"),
    [
        *(
            pytest.param(f"create_server(('', {port}))", f"TCP port {port} is in use", marks=pytest.mark.nightly)
            for port in (51_820, 443)
        ),
        ("socket(type=socket.SOCK_DGRAM); bound.bind(('', 51820))", "UDP port 51820 is in use"),
    ],
)
def test_a_border_whose_port_is_taken_creates_no_domain(site: Field, bound: str, text: str) -> None:
    user = site.second.type(f"python -c {shlex.quote(LISTEN.format(bound))}")
    user.until_logged("bound", patience_s=PATIENCE_S)
    said = site.refusal(site.second, "gdp domain create lab --public 192.0.2.1")
    user.close()
    assert text in said
    assert "end that one, or state another port with --" in said


def test_a_machine_whose_network_lets_only_tcp_443_through_joins(site: Field) -> None:
    joined = site.blocked.type("gdp join --label blocked", site.tokens[0])
    joined.until_logged("joined the domain lab as blocked", patience_s=PATIENCE_S)
    joined.until_logged("frames pass through TLS at the border", patience_s=PATIENCE_S)


def test_after_all_refusals_the_same_token_is_good(site: Field) -> None:
    joined = site.robot.type(JOIN, site.tokens[-1])
    joined.until_logged("tunnels are up: border", patience_s=PATIENCE_S)
