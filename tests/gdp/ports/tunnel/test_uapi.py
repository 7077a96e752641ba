"""Texts of the userspace interface of WireGuard; a Unix socket of the test plays ``wireguard-go``."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.ports.tunnel import uapi
from gdp.ports.tunnel.control import Change, ControlLostError, PeerChange, PeerState
from gdp.ports.tunnel.uapi import UserspaceControl, parse_state, request_text

KEY = bytes(range(32))
INNER = "fd00::2"


def test_a_change_of_a_device_is_written_with_the_key_last() -> None:
    text = request_text(Change(private_key=KEY, listen_port=51820, fwmark=7))
    assert text == f"set=1\nfwmark=7\nlisten_port=51820\nprivate_key={KEY.hex()}\n\n"


def test_a_peer_is_limited_to_its_inner_address() -> None:
    peer = PeerChange(public_key=KEY, inner=INNER, endpoint=Endpoint("2001:db8::1", 51820), keepalive_s=25)
    assert request_text(Change(peers=(peer,))).splitlines() == [
        "set=1",
        f"public_key={KEY.hex()}",
        "endpoint=[2001:db8::1]:51820",
        "persistent_keepalive_interval=25",
        "replace_allowed_ips=true",
        "allowed_ip=fd00::2/128",
        "",
    ]


def test_an_endpoint_that_is_not_given_is_not_written() -> None:
    assert "endpoint" not in request_text(Change(peers=(PeerChange(public_key=KEY, inner=INNER),)))


def test_a_removed_peer_has_no_other_line() -> None:
    text = request_text(Change(peers=(PeerChange(public_key=KEY, inner=INNER, is_removed=True),)))
    assert text == f"set=1\npublic_key={KEY.hex()}\nremove=true\n\n"


def test_a_preshared_key_is_written_only_when_it_changes() -> None:
    changed = PeerChange(public_key=KEY, preshared_key=bytes(32))
    assert f"preshared_key={'00' * 32}" in request_text(Change(peers=(changed,))).splitlines()
    assert "preshared" not in request_text(Change(peers=(PeerChange(public_key=KEY),)))
    assert "7777" not in repr(PeerChange(public_key=KEY, preshared_key=b"7" * 32))


def test_a_key_is_not_shown() -> None:
    assert KEY.hex() not in repr(Change(private_key=KEY))
    assert repr(KEY) not in repr(Change(private_key=KEY))


def test_the_state_of_each_peer_is_read() -> None:
    text = (
        f"private_key={'00' * 32}\nlisten_port=51820\npublic_key={KEY.hex()}\npreshared_key={'00' * 32}\n"
        "protocol_version=1\nendpoint=192.0.2.1:4000\nlast_handshake_time_sec=1700000000\n"
        "last_handshake_time_nsec=500000000\ntx_bytes=20\nrx_bytes=10\npersistent_keepalive_interval=25\n"
        f"allowed_ip=fd00::2/128\npublic_key={bytes(32).hex()}\nlast_handshake_time_sec=0\nlast_handshake_time_nsec=0"
    )
    lines = [(key, value) for key, _, value in (line.partition("=") for line in text.splitlines())]
    state = parse_state(lines)
    assert state.listen_port == 51820
    assert state.peers == {
        KEY: PeerState(Endpoint("192.0.2.1", 4000), 1_700_000_000.5, 10, 20),
        bytes(32): PeerState(None, 0.0, 0, 0),
    }


def test_an_endpoint_of_another_form_counts_as_unknown() -> None:
    state = parse_state([("public_key", KEY.hex()), ("endpoint", "relay#4")])
    assert state.peers[KEY].endpoint is None


@contextlib.contextmanager
def replying(folder: Path, monkeypatch: pytest.MonkeyPatch, reply: bytes | None) -> Iterator[list[bytes]]:
    """Serve requests with this reply; None: serve one, and never reply."""
    monkeypatch.setattr(uapi, "SOCKET_FOLDER", folder)
    monkeypatch.setattr(uapi, "ANSWER_S", 0.2)
    heard: list[bytes] = []
    end = threading.Event()

    def serve() -> None:
        while True:
            connection, _ = listener.accept()
            with connection:
                request = connection.recv(4096)
                if not request:  # the test is over
                    return
                heard.append(request)
                if reply is None:
                    end.wait()
                    return
                connection.sendall(reply)

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(folder / "wg.sock"))
        listener.listen()
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield heard
        finally:
            end.set()
            if reply is not None:
                with socket.socket(socket.AF_UNIX) as last:
                    last.connect(str(folder / "wg.sock"))
            thread.join()


@pytest.mark.parametrize(
    ("reply", "text"),
    [
        (b"errno=98\n\n", "UDP port 51820 is in use; state another"),
        (b"errno=-98\n\n", "UDP port 51820 is in use; state another"),
        (b"errno=1\n\n", "wireguard-go refused a change: Operation not permitted"),
    ],
)
def test_an_errno_becomes_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reply: bytes, text: str) -> None:
    with replying(tmp_path, monkeypatch, reply), pytest.raises(LocalError, match=text):
        UserspaceControl("wg").apply(Change(listen_port=51820))


def test_a_port_that_is_taken_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with replying(tmp_path, monkeypatch, b"errno=98\n\n") as heard, pytest.raises(LocalError):
        UserspaceControl("wg").apply(Change(listen_port=51820))
    assert len(heard) > 1


@pytest.mark.parametrize("reply", [b"", b"listen_port=1\n", None], ids=["nothing", "half a reply", "too late"])
def test_a_process_that_does_not_reply_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reply: bytes | None
) -> None:
    with replying(tmp_path, monkeypatch, reply), pytest.raises(ControlLostError):
        UserspaceControl("wg").state()


def test_a_process_that_hangs_is_not_asked_again_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    control = UserspaceControl("wg")
    with replying(tmp_path, monkeypatch, None), pytest.raises(ControlLostError):
        control.state()
    with pytest.raises(ControlLostError, match="did not respond"):
        control.state()


def test_a_missing_process_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uapi, "SOCKET_FOLDER", tmp_path)
    with pytest.raises(ControlLostError, match="does not respond"):
        UserspaceControl("wg").state()


def test_a_change_is_sent_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with replying(tmp_path, monkeypatch, b"errno=0\n\n") as heard:
        UserspaceControl("wg").apply(Change(fwmark=3))
    assert heard == [b"set=1\nfwmark=3\n\n"]
