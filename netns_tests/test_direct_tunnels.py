"""Direct tunnels between the switches of two sites behind NATs, through real NATs and WireGuard, by one border."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from gdp.control.endpoints import Endpoint
from gdp.crypto.certificates import Role
from gdp.errors import GdpError
from gdp.links.endpoint_files import own_record, public_candidates
from gdp.management.control_client import ask_node
from gdp.state.control_protocol import Command
from gdp.stores.issue import make_domain, make_node
from gdp.stores.keyring import load_identity
from internet.access import Access
from internet.host import Host
from internet.laboratory import Laboratory
from tests.pages import ROOT
from tests.waiting import until

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about tunnels, no lease of a name matters"),
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed"),
    pytest.mark.skipif(os.geteuid() != 0, reason="wireguard-go needs root for its control socket"),
]

PATIENCE_S = 150.0
PORT = 51_820
BORDER, ONE, OTHER = "border", "one", "other"


class Sites:
    """A border with a RIB, and two switches that know the border only."""

    def __init__(self, laboratory: Laboratory, folder: Path, one: Access, other: Access) -> None:
        self._folder = folder
        self._children: list[subprocess.Popen[bytes]] = []
        self.hosts: dict[str, Host] = {}
        make_domain(folder / "lab", "lab")
        for label, access in ((BORDER, Access.PUBLIC), (ONE, one), (OTHER, other)):
            make_node(folder / label / "switch", Role.SWITCH, label, folder / "lab")
            (folder / label / "peers").mkdir()
            self.hosts[label] = laboratory.add_host(label, laboratory.add_site(f"of-{label}", access))
        make_node(folder / BORDER / "rib", Role.RIB, "rib", folder / "lab")
        public = Endpoint(self.hosts[BORDER].lease().address.split("/")[0], PORT)
        for label in (ONE, OTHER):
            self._introduce(BORDER, to=label, public=[public])
            self._introduce(label, to=BORDER)
        for label in self.hosts:
            self._start_switch(label, f", public: ['{public.to_text()}']" if label == BORDER else "")
        self._wait_for(lambda: all(self.status(label) for label in self.hosts), "a switch that answers")
        config = folder / BORDER / "rib.yaml"
        config.write_text("identity: rib\ndomain: {root: rib/root.crt}\niface: rib0\n")
        self._start(BORDER, "gdp.cli.rib", config)

    def _introduce(self, label: str, *, to: str, public: Sequence[Endpoint] = ()) -> None:
        """Give the record of a switch to another one."""
        identity = load_identity(self._folder / label / "switch", time.time())
        record = own_record(identity, 1, public_candidates(public))
        (self._folder / to / "peers" / f"{label}.endpoints").write_bytes(record.wire)

    def _start_switch(self, label: str, more: str) -> None:
        folder = self._folder / label
        config = folder / "switch.yaml"
        config.write_text(
            f"identity: switch\ndomain: {{root: switch/root.crt}}\ncontrol_socket: {folder}/control\n"
            f"attach: [{'rib0' if label == BORDER else 'p-' + label}]\n"
            f"links: {{listen: {PORT}, peers: peers, backend: wireguard-go{more}}}\n"
        )
        self._start(label, "gdp.cli.switch", config)

    def _start(self, label: str, module: str, config: Path) -> None:
        command = self.hosts[label].command([sys.executable, "-m", module, "--config", str(config)])
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        self._children.append(subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL))

    def status(self, label: str) -> Mapping[str, object]:
        """Return the status of a switch; nothing while it does not answer."""
        try:
            return ask_node(self._folder / label / "control", Command.STATUS, 2.0).result
        except GdpError:
            return {}

    def direct_endpoint(self, label: str) -> str | None:
        """Return the endpoint of the peer behind a direct tunnel that is up, or None."""
        links = self.status(label).get("links", ())
        assert isinstance(links, Sequence)
        return next((str(each["endpoint"]) for each in links if each["direct"] and each["up"]), None)

    def wait_until_direct(self, address: str = "") -> None:
        """Return when both switches have a direct tunnel; the second one's leads to this address, if given."""
        self._wait_for(
            lambda: self.direct_endpoint(ONE) is not None and address in (self.direct_endpoint(OTHER) or "-"),
            "a direct tunnel",
        )

    def _wait_for(self, is_true: Callable[[], bool], what: str) -> None:
        def are_alive() -> bool:
            assert all(child.poll() is None for child in self._children), "a node ended"
            return True

        until(
            lambda: are_alive() and is_true(),
            lambda: f"{what}: {[self.status(label).get('links') for label in self.hosts]}",
            PATIENCE_S,
        )

    def close(self) -> None:
        """End the nodes."""
        for child in self._children:
            child.terminate()
        for child in self._children:
            child.wait(PATIENCE_S)


@pytest.fixture
def make_sites(laboratory: Laboratory, tmp_path: Path) -> Iterator[Callable[[Access, Access], Sites]]:
    made: list[Sites] = []

    def make(one: Access, other: Access) -> Sites:
        made.append(Sites(laboratory, tmp_path, one, other))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.mark.parametrize("other", [Access.FULL_CONE])
def test_a_symmetric_nat_reaches_one_that_filters_nothing(
    make_sites: Callable[[Access, Access], Sites], other: Access
) -> None:
    make_sites(Access.SYMMETRIC, other).wait_until_direct()


def test_a_site_behind_a_nat_that_gets_another_address_has_a_direct_tunnel_again(
    make_sites: Callable[[Access, Access], Sites],
) -> None:
    sites = make_sites(Access.PORT_RESTRICTED, Access.PORT_RESTRICTED)
    sites.wait_until_direct()
    site = sites.hosts[ONE].site()
    site.renumber()
    sites.wait_until_direct(site.address)
