"""Owner of a tunnel device, a process that is confined as a switch is: it serves the device, and may be killed."""

from __future__ import annotations

import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gdp.config.config import SwitchConfig
from gdp.control.endpoints import Endpoint
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.nodes.rights import confine_switch
from gdp.ports.tunnel.devices import find_device
from gdp.ports.tunnel.path_mtu import route_mtu
from gdp.ports.tunnel.uapi import socket_path
from gdp.ports.tunnel.vxlan import make_vxlan, remove_link, set_link_mtu
from gdp.ports.tunnel.wireguard import WireGuardDevice, open_wireguard
from gdp.stores.issue import make_domain, make_node
from lab.machine import LabMachine
from lab.process import calling
from netns_tests.test_tunnels import is_alive, process_of, sites
from netns_tests.tunnel_sites import PATIENCE_S, PORT, Site, crosses, until

__all__ = ["sites"]  # a fixture

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about devices, no lease matters"),
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed"),
    pytest.mark.skipif(os.geteuid() != 0, reason="wireguard-go needs root for its control socket"),
]


def own_device(config: str, ifname: str, private_key: str, inner: str, alias: str) -> None:
    """Open a device, confine the process, and execute commands; a process of its own.

    It prints a JSON line with its state. Then each line of standard input is a JSON object with the words of a command.
    It prints a JSON line with the result, or with ``error``.
    """
    device = open_wireguard(
        ifname=ifname,
        private_key=bytes.fromhex(private_key),
        listen_port=0,
        inner=inner,
        mtu=1440,
        alias=alias,
        backend="wireguard-go",
    )
    confine_switch(SwitchConfig.load(Path(config)), "raw")
    try:
        subprocess.run(["/bin/true"], check=True)
    except OSError as error:
        say(confined=str(error), port=device.listen_port)
    with selectors.DefaultSelector() as selector:
        selector.register(sys.stdin, selectors.EVENT_READ)
        selector.register(device, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.fileobj is device:
                    device.handle_events()
                    continue
                line = sys.stdin.readline()
                if not line:
                    device.close()
                    return
                try:
                    say(result=act(device, alias, *json.loads(line)["words"]))
                except LocalError as error:
                    say(error=str(error))


def act(device: WireGuardDevice, alias: str, command: str, *words: str) -> object:
    """Run one command."""
    match command:
        case "set_peer":
            key, inner, address, port = words
            endpoint = Endpoint(address, int(port)) if address else None
            device.set_peer(bytes.fromhex(key), inner=inner, endpoint=endpoint, keepalive_s=25)
        case "remove_peer":
            device.remove_peer(bytes.fromhex(words[0]))
        case "retry":
            device.retry_handshake(bytes.fromhex(words[0]))
        case "peers":
            return {key.hex(): state.handshake_unix_s for key, state in device.peers().items()}
        case "link":
            ifname, local, remote = words
            make_vxlan(ifname=ifname, vni=77, local=local, remote=remote, underlay=device.ifname, mtu=1370, alias=alias)
        case "unlink":
            remove_link(words[0], alias)
        case "mtu":
            device.set_mtu(int(words[1]))
            set_link_mtu(words[0], int(words[1]) - 70)
        case "route":
            return route_mtu(Endpoint(words[0], int(words[1])))
    return None


def say(**fields: object) -> None:
    """Print one JSON line."""
    print(json.dumps(fields), flush=True)


class Owner:
    """The process of ``own_device`` at a site."""

    def __init__(self, site: Site, machine: LabMachine) -> None:
        words = [machine.folder / "switch.yaml", site.ifname, site.private_key.hex(), site.inner, site.alias]
        with site.entered():
            self.process = machine.launch(calling(own_device, *words), has_orders=True)
        self.confined = str(self.process.read(PATIENCE_S)["confined"])

    def ask(self, *words: str) -> object:
        """Return the result of a command."""
        return self.process.ask(words=words)["result"]


@pytest.fixture
def owner(sites: tuple[Site, Site], machine: LabMachine) -> Owner:
    home = machine.folder
    make_domain(home / "lab", "lab")
    make_node(home / "switch", Role.SWITCH, "lab", home / "lab")
    machine.write("switch", "switch", ports=[{"iface": "u0"}])
    return Owner(sites[1], machine)


def children(pid: int) -> list[int]:
    """Return the processes that a process started."""
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_a_confined_switch_still_serves_its_tunnels(sites: tuple[Site, Site], owner: Owner) -> None:
    one, two = sites
    assert "Permission denied" in owner.confined
    first = one.open()
    one.connect(first, two, is_dialling=False)
    owner.ask("set_peer", one.public_key.hex(), one.inner, one.address, str(PORT))
    owner.ask("link", two.link, two.inner, one.inner)
    receiving, sending = one.frames(), two.frames()
    until(crosses(sending, receiving), first)
    os.kill(process_of(two.ifname), signal.SIGKILL)
    until(crosses(sending, receiving), first)
    assert owner.ask("route", one.address, str(PORT)) == 1500
    owner.ask("mtu", two.link, "1400")
    with two.entered():
        device = find_device(two.link)
        assert device is not None
        assert device.mtu == 1330
    owner.ask("retry", one.public_key.hex())
    owner.ask("unlink", two.link)
    owner.ask("remove_peer", one.public_key.hex())
    assert owner.ask("peers") == {}
    assert not two.has(two.link)
    owner.ask("set_peer", one.public_key.hex(), one.inner, one.address, str(PORT))
    owner.ask("link", two.link, two.inner, one.inner)
    until(crosses(two.frames(), receiving), first)
    owner.process.close_orders()
    owner.process.output()
    assert not two.has(two.ifname)
    assert not two.has(two.link)


@pytest.mark.parametrize("whom", ["the owner", "the keeper", "all at once"])
def test_a_kill_leaves_no_device_no_process_and_no_socket(sites: tuple[Site, Site], owner: Owner, whom: str) -> None:
    one, two = sites
    owner.ask("set_peer", one.public_key.hex(), one.inner, one.address, str(PORT))
    owner.ask("link", two.link, two.inner, one.inner)
    (keeper,) = children(owner.process.pid)
    (program,) = children(keeper)
    victims = {"the owner": [owner.process.pid], "the keeper": [keeper]}.get(whom, [owner.process.pid, keeper, program])
    for pid in victims:
        os.kill(pid, signal.SIGKILL)
    begun_s = time.monotonic()
    until(lambda: not any(map(is_alive, (keeper, program))) and not two.has(two.ifname))
    assert not two.has(two.link)
    if whom != "all at once":  # no process is left that could remove it; the next start does
        until(lambda: not socket_path(two.ifname).exists())
    assert time.monotonic() - begun_s < 5.0
    device = two.open()
    assert device.listen_port == PORT
