"""Netlink messages for WireGuard of the kernel, built and read by pyroute2; no kernel takes part."""

from __future__ import annotations

from base64 import b64decode, b64encode
from typing import Any

import pytest

from gdp.control.endpoints import Endpoint
from gdp.ports.tunnel.control import Change, PeerChange, PeerState
from gdp.ports.tunnel.kernel_control import KernelControl, parse_messages, peer_arguments

generic = pytest.importorskip("pyroute2.netlink.generic.wireguard")

KEY = bytes(range(32))


def decoded(peer: PeerChange) -> Any:
    """Return the message about a peer, after its way through bytes."""
    message = generic.wgmsg()
    message["cmd"] = generic.WG_CMD_SET_DEVICE
    message["attrs"].append(["WGDEVICE_A_IFNAME", "wg"])
    message["attrs"].append(["WGDEVICE_A_LISTEN_PORT", 51820])
    generic.AsyncWireGuard._wg_set_peer(_Checks(), message, peer_arguments(peer))
    message.encode()
    received = generic.wgmsg(message.data)
    received.decode()
    return received


class _Checks:
    _wg_test_key = generic.AsyncWireGuard._wg_test_key
    _wg_build_allowedips = generic.AsyncWireGuard._wg_build_allowedips


class Recorded:
    """Socket that stores what it is given."""

    def __init__(self) -> None:
        self.given: list[dict[str, object]] = []

    def set(self, ifname: str, **settings: object) -> None:
        assert ifname == "wg"
        self.given.append(settings)


@pytest.mark.parametrize("address", ["192.0.2.1", "2001:db8::1"])
def test_a_peer_survives_its_encoding(address: str) -> None:
    endpoint = Endpoint(address, 4000)
    message = decoded(PeerChange(public_key=KEY, inner="fd00::2", endpoint=endpoint, keepalive_s=25))
    assert parse_messages([message]).peers == {KEY: PeerState(endpoint, 0.0, 0, 0)}
    assert parse_messages([message]).listen_port == 51820
    (peer,) = message.get_attr("WGDEVICE_A_PEERS")
    assert peer.get_attr("WGPEER_A_FLAGS") == generic.WGPEER_F_REPLACE_ALLOWEDIPS
    assert peer.get_attr("WGPEER_A_PERSISTENT_KEEPALIVE_INTERVAL") == 25
    assert [each["addr"] for each in peer.get_attr("WGPEER_A_ALLOWEDIPS")] == ["fd00::2/128"]


def test_a_removed_peer_is_marked() -> None:
    (peer,) = decoded(PeerChange(public_key=KEY, is_removed=True)).get_attr("WGDEVICE_A_PEERS")
    assert peer.get_attr("WGPEER_A_FLAGS") == generic.WGPEER_F_REMOVE_ME


def test_a_device_is_set_before_its_peers() -> None:
    recorded = Recorded()
    control = object.__new__(KernelControl)
    control._ifname, control._wireguard = "wg", recorded
    peers = (PeerChange(public_key=KEY, is_removed=True), PeerChange(public_key=KEY, keepalive_s=0))
    control.apply(Change(private_key=KEY, listen_port=1, fwmark=0, peers=peers))
    text = b64encode(KEY).decode()
    assert recorded.given == [
        {"private_key": text, "listen_port": 1, "fwmark": 0},
        {"peer": {"public_key": text, "remove": True}},
        {"peer": {"public_key": text, "persistent_keepalive": 0}},
    ]


def test_a_preshared_key_survives_its_encoding() -> None:
    (peer,) = decoded(PeerChange(public_key=KEY, preshared_key=KEY)).get_attr("WGDEVICE_A_PEERS")
    assert b64decode(peer.get_attr("WGPEER_A_PRESHARED_KEY")) == KEY
    (peer,) = decoded(PeerChange(public_key=KEY, keepalive_s=0)).get_attr("WGDEVICE_A_PEERS")
    assert peer.get_attr("WGPEER_A_PRESHARED_KEY") is None
