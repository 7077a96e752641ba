"""Attacks on a border's relay server: by its clients, by members of other domains, and by strangers."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import pytest
import yaml

from gdp.config.relay_config import RelayConfig
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.intervals import Rate
from gdp.links import relay_server as relay_server_module
from gdp.links.relay_context import RelayContext, tls_context
from gdp.links.relay_link import RelayLink, RelayPort, prepare_socket
from gdp.links.relay_loop import RelayLoop
from gdp.links.relay_server import BorderServer, listen_tls
from gdp.ports.tap import TapDevice
from gdp.relay.admission import verified_border
from gdp.relay.connection import ConnectionSettings, RelayConnection
from gdp.stores.issue import make_domain, make_node
from gdp.stores.keyring import load_root
from gdp.trust.domain import Policy
from tests.gdp.links.test_relay_link import Device, run
from tests.gdp.relay.test_frame_queue import frame

DEAD_S = 60.0  # a busy machine is no dead path
RATE = 100_000
BURST_BYTES = 64 << 10  # above that of the rate, and what one read takes in


class Border:
    """A border's relay server on loopback, with devices in the hands of the test, and clients in the same loop."""

    def __init__(self, home: Path, loop: RelayLoop, patch: pytest.MonkeyPatch, **server: object) -> None:
        self.home, self.loop = home, loop
        self.taps: list[Device] = []
        self.trusted = make_domain(home / "other", "other")
        make_domain(home / "lab", "lab")
        self.identity = make_node(home / "border", Role.SWITCH, "border", home / "lab")
        config = {
            "identity": "border",
            "domain": {"root": "lab/root.crt", "trusts": ["other/root.crt"]},
            "server": {"port": free_port(), "address": "127.0.0.1", **server},
            "dead_ms": int(1_000 * DEAD_S),
        }
        (home / "relay.yaml").write_text(yaml.safe_dump(config))
        self.config = RelayConfig.load(home / "relay.yaml")
        assert self.config.server is not None
        patch.setattr(relay_server_module, "TapDevice", self._device)
        roots = [load_root(home / each / "root.crt") for each in ("lab", "other")]
        self.policy = Policy(roots[0], roots[1:])
        context = RelayContext(config=self.config, identity=self.identity, policy=self.policy, loop=loop)
        self.server = BorderServer(self.config, self.config.server, listen_tls(self.config.server), context)
        self.clients: list[Client] = []

    def _device(self, *_: object) -> TapDevice:
        self.taps.append(Device())
        return cast(TapDevice, self.taps[-1])

    def member(self, label: str, domain: str = "lab") -> Identity:
        return make_node(self.home / f"{domain}-{label}", Role.LEAF, label, self.home / domain)

    def dial(self, identity: Identity, source: str = "127.0.0.1") -> Client:
        self.clients.append(Client(self, identity, source))
        return self.clients[-1]

    def connect(self, source: str) -> socket.socket:
        """Return the connection of a stranger that says nothing."""
        return socket.create_connection(("127.0.0.1", self.server.listening_port), source_address=(source, 0))

    def close(self) -> None:
        for each in self.clients:
            each.close()
        self.server.close()


class Client:
    """A connection of one member to the border."""

    def __init__(self, border: Border, identity: Identity, source: str) -> None:
        self.device = Device()
        self.port = RelayPort(border.loop, cast(TapDevice, self.device))
        opened = border.connect(source)
        prepare_socket(opened, 60_000)
        settings = ConnectionSettings(mtu=1_350, keepalive_s=0.25, dead_s=DEAD_S, queue_bytes=1 << 20)
        connection = RelayConnection(
            context=tls_context(identity, border.policy, is_server=False),
            is_server=False,
            settings=settings,
            authenticate=lambda wire, at: verified_border(
                wire, border.identity.name, border.policy.verify_membership, at.unix_s
            ),
            now_s=time.monotonic(),
        )
        self.link = RelayLink(
            loop=border.loop, connected=opened, connection=connection, opened=self._opened, closed=lambda _: None
        )

    @property
    def is_up(self) -> bool:
        return self.device.carrier

    @property
    def reason(self) -> str:
        return self.link.connection.reason

    def _opened(self, link: RelayLink) -> RelayPort:
        self.port.attach(link)
        return self.port

    def close(self) -> None:
        if not self.link.is_ended:
            self.link.end("the test ends")
        self.port.close()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


Start = Callable[..., Border]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    loop = RelayLoop()
    started: list[Border] = []

    def begin(**server: object) -> Border:
        started.append(Border(tmp_path, loop, monkeypatch, **server))
        return started[-1]

    yield begin
    for each in started:
        each.close()
    loop.close()


def test_a82_a_client_that_connects_again_and_again_is_relayed_no_more_than_its_rate(start: Start) -> None:
    border = start(rate=RATE)
    mallory = border.member("mallory")
    begun_s, received = time.monotonic(), 0
    for _ in range(6):
        client = border.dial(mallory)
        run(border.loop, lambda client=client: client.is_up)  # type: ignore[misc]
        (tap,) = border.taps
        for number in range(60):
            client.link.connection.queue_frame(frame(number, size=1_364))
        client.link.flush()
        end_s = time.monotonic() + 0.05
        while time.monotonic() < end_s:
            border.loop.wake_at(end_s)
            border.loop.step()
            while tap_read(tap):
                received += 1_364
        client.close()
        border.clients.remove(client)
    assert received <= RATE * (time.monotonic() - begun_s) + BURST_BYTES
    assert received > 0


def tap_read(tap: Device) -> bytes:
    try:
        return tap.host.recv(10_000)
    except BlockingIOError:
        return b""


def test_a83_the_connections_of_one_address_leave_handshakes_for_others(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay_server_module, "CONNECTIONS_RATE", Rate(2.0, burst=2.0))
    monkeypatch.setattr(relay_server_module, "ADDRESS_CONNECTIONS_RATE", Rate(1.0, burst=1.0))
    border = start()
    member = border.member("member")
    strangers = [border.connect("127.0.0.2") for _ in range(100)]
    try:
        client = border.dial(member, "127.0.0.3")
        run(border.loop, lambda: client.is_up)
        assert border.server.status(time.monotonic())["turned_away"]
    finally:
        for each in strangers:
            each.close()


def test_a84_members_of_other_domains_leave_half_of_a_relay_to_its_own(start: Start) -> None:
    border = start(clients_max=4)
    foreign = [border.dial(border.member(f"foreign-{number}", "other")) for number in range(2)]
    run(border.loop, lambda: all(each.is_up for each in foreign))
    third = border.dial(border.member("foreign-3", "other"))
    run(border.loop, lambda: third.link.is_ended)
    assert third.reason == "the border has its 2 clients of other domains already (relay clients_max)"
    own = [border.dial(border.member(f"own-{number}")) for number in range(2)]
    run(border.loop, lambda: all(each.is_up for each in own))
