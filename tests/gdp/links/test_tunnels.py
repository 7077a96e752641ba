"""Tunnels of a switch: when the states of WireGuard peers are read, which costs a request for all peers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import pytest

from gdp.control.hello import NodeSettings
from gdp.control.preshared_key import NO_KEY
from gdp.control.tunnel_plan import TunnelId
from gdp.errors import LocalError
from gdp.links import tunnels as tunnels_module
from gdp.links.tunnels import Tunnel, Tunnels
from gdp.names import Name
from gdp.ports.tunnel.control import PeerState
from gdp.ports.tunnel.wireguard import WireGuardDevice
from gdp.runtime.runtime import Runtime
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from tests.gdp.control.members import POLICY, Nonces, at, node

KEY, PORT = bytes(32), 7
PEER = TunnelId(Name(bytes([1]) * 32), 0, 0)
LOOK_S = 0.1


@dataclass
class Device:
    """A device without a kernel, which counts the requests for the states of its peers."""

    ifname: str = "wg"
    reads: int = 0
    has_moved: bool = False
    preshared_key: bytes = NO_KEY
    is_refusing: bool = False

    def peers(self) -> dict[bytes, PeerState]:
        self.reads += 1
        return {}

    def poll(self) -> bool:
        self.reads += 1
        return False

    def known_peers(self) -> dict[bytes, PeerState]:
        return {}

    def poll_move(self) -> bool:
        return self.has_moved

    def set_preshared_key(self, key: bytes, preshared_key: bytes) -> bool:
        if self.is_refusing:
            raise LocalError("refused")
        is_new, self.preshared_key = self.preshared_key != preshared_key, preshared_key
        return is_new

    def remove_peer(self, key: bytes) -> None:
        self.preshared_key = NO_KEY


@dataclass
class Loop:
    """A runtime that calls when a test says so."""

    follow: list[Callable[[], None]] = field(default_factory=list)

    def watch(self, source: object, ready: Callable[[], None]) -> None:
        """Nothing becomes readable."""

    def after_receive(self, look: Callable[[], None]) -> None:
        self.follow.append(look)

    def remove_port(self, index: int) -> None:
        """There is no port."""


@dataclass
class Bed:
    """Tunnels of a switch with one peer."""

    device: Device = field(default_factory=Device)
    loop: Loop = field(default_factory=Loop)

    def __post_init__(self) -> None:
        identity = node("border")
        settings = NodeSettings(incarnation=0, first_sequence=0, random_bytes=Nonces(1))
        self.switch = SwitchCore(identity, POLICY, Table(), settings)
        underlays = (cast("WireGuardDevice", self.device),)
        runtime = cast("Runtime", self.loop)
        self.tunnels = Tunnels(
            identity=identity, switch=self.switch, runtime=runtime, underlays=underlays, relay_rate=None
        )
        self.tunnel = Tunnel(
            ifname="vx",
            inner="fd00::1",
            key=KEY,
            port=PORT,
            mtu=1_400,
            wireguard_mtu=1_400,
            keepalive_s=0,
            begun_s=0.0,
            is_direct=True,
        )
        self.tunnels._tunnels[PEER] = self.tunnel

    def look(self, count: int) -> int:
        """Look so often, ten times a second; return how often states were read."""
        before = self.device.reads
        for number in range(count):
            self.tunnels.handle_timer(at(number * LOOK_S))
        return self.device.reads - before


@pytest.fixture
def bed() -> Bed:
    return Bed()


def test_states_are_read_once_a_second_while_nothing_is_awaited(bed: Bed) -> None:
    assert bed.look(30) == 3


def test_states_are_read_at_each_look_after_a_handshake_was_requested(bed: Bed) -> None:
    bed.tunnel.dialled_s = 0.0
    assert bed.look(20) == 20


def test_states_are_read_at_once_when_a_peer_polls(bed: Bed) -> None:
    bed.look(1)
    reads = bed.device.reads
    for _ in range(3):  # a peer polls often while it waits
        bed.switch.hello_protocol.liveness.note_polled(PORT)
        bed.loop.follow[0]()
    assert bed.device.reads == reads + 1


def test_frames_without_a_poll_cost_no_read(bed: Bed) -> None:
    bed.loop.follow[0]()
    assert bed.device.reads == 0


def test_wireguard_has_the_key_while_both_ends_have_it_and_a_session_has_it_from_its_handshake_on(
    bed: Bed, monkeypatch: pytest.MonkeyPatch
) -> None:
    agreed = b"k" * 32
    key = agreed
    monkeypatch.setattr(bed.switch.hello_protocol.preshared_keys, "key", lambda port: key if port == PORT else NO_KEY)
    bed.look(1)
    assert bed.device.preshared_key == agreed
    assert not bed.tunnel.is_preshared  # the session is older than the key
    bed.tunnel.handshake_unix_s = bed.tunnel.preshared_unix_s + 1
    assert bed.tunnel.is_preshared
    key = NO_KEY
    bed.look(1)
    assert bed.device.preshared_key == NO_KEY
    assert not bed.tunnel.is_preshared


def test_a_tunnel_whose_key_wireguard_refuses_is_closed(bed: Bed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tunnels_module, "remove_link", lambda *_: None)
    bed.device.is_refusing = True
    bed.look(1)
    assert not bed.tunnels.all
