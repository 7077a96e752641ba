"""TLS of doors: who trusts the domain's root connects to the host that the certificate names, and no one else does."""

from __future__ import annotations

import json
import ssl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("websockets")

from websockets.exceptions import InvalidHandshake
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from gdp.cli.gdp import main
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.keys import SigningKey
from gdp.crypto.server_certificate import issue_door_certificate, verify_server_certificate
from gdp.crypto.validity import Validity
from gdp.crypto.x509_profile import to_pem
from gdp.errors import LocalError, StatementError
from gdp.stores.issue import admit_node, issue_door, make_domain, make_node_keys
from gdp.stores.keyring import load_domain, load_identity, load_root
from gdp_extensions.doors.core.foxglove_protocol import SUBPROTOCOLS
from gdp_extensions.doors.core.foxglove_session import FoxgloveSession
from gdp_extensions.doors.endpoint import DoorEndpoint, DoorSettings
from gdp_extensions.doors.tls import DoorTls
from tests.gdp_extensions.doors.rights import Everything
from tests.gdp_extensions.doors.test_foxglove_door import free_port

HOSTS = ("localhost", "127.0.0.1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a domain and the node of a door, which has a certificate for this host."""
    made = tmp_path_factory.mktemp("door")
    make_domain(made / "lab", "lab")
    make_node_keys(made / "viewer", Role.PROXY, "viewer")
    admit_node(made / "lab", made / "viewer")
    write(made, *HOSTS)
    return made


def write(folder: Path, *hosts: str) -> None:
    """Issue a certificate for these hosts."""
    request = (folder / "viewer/node.csr").read_bytes()
    (folder / "door.crt").write_bytes(to_pem(issue_door(folder / "lab", request, hosts)))


def tls_of(folder: Path, file: str = "door.crt") -> DoorTls:
    return DoorTls(folder / file, load_identity(folder / "viewer", time.time()))


@contextmanager
def door_with(tls: DoorTls) -> Iterator[DoorEndpoint]:
    listen = f"127.0.0.1:{free_port()}"
    settings = DoorSettings(label="foxglove", listen=listen, subprotocols=SUBPROTOCOLS, tls=tls.context)
    door = DoorEndpoint(settings, lambda hub, number, queue: FoxgloveSession(hub, number, "test", queue), Everything)
    try:
        yield door
    finally:
        door.shut_down()


def trusting(folder: Path) -> ssl.SSLContext:
    """Return the context of a client that knows nothing but the domain's root."""
    return ssl.create_default_context(cafile=str(folder / "lab/root.crt"))


def open_client(door: DoorEndpoint, context: ssl.SSLContext, host: str) -> ClientConnection:
    url = f"wss://{host}:{door.address[1]}"
    return connect(url, ssl=context, subprotocols=[Subprotocol(SUBPROTOCOLS[0])])


@pytest.mark.parametrize("host", HOSTS)
def test_a_client_that_trusts_the_root_connects_by_name_and_by_address(folder: Path, host: str) -> None:
    with door_with(tls_of(folder)) as door, open_client(door, trusting(folder), host) as client:
        assert json.loads(client.recv(10))["op"] == "serverInfo"
        assert door.url == f"wss://127.0.0.1:{door.address[1]}"


def test_a_client_of_another_root_and_one_without_tls_are_refused(folder: Path, tmp_path: Path) -> None:
    make_domain(tmp_path / "lab", "other")
    with door_with(tls_of(folder)) as door:
        with pytest.raises(ssl.SSLCertVerificationError):
            open_client(door, trusting(tmp_path), "localhost")
        with pytest.raises((OSError, EOFError, InvalidHandshake)):
            connect(f"ws://localhost:{door.address[1]}", subprotocols=[Subprotocol(SUBPROTOCOLS[0])], open_timeout=5)
        assert door.clients == 0


def test_a_renewed_certificate_is_shown_to_the_next_client_and_its_hosts_alone_count(folder: Path) -> None:
    tls = tls_of(folder)
    with door_with(tls) as door:
        write(folder, "door.example")
        try:
            tls.read_certificate()
        finally:
            write(folder, *HOSTS)
        with pytest.raises(ssl.SSLCertVerificationError, match="localhost"):
            open_client(door, trusting(folder), "localhost")


def test_a_certificate_with_a_key_of_its_own_is_private(folder: Path, tmp_path: Path) -> None:
    key = SigningKey.generate()
    other = tmp_path / "other.pem"
    make_node_keys(tmp_path / "other", Role.PROXY, "other")
    request = (tmp_path / "other/node.csr").read_bytes()
    certificate = to_pem(issue_door(folder / "lab", request, HOSTS))
    other.write_bytes(certificate)
    with pytest.raises(LocalError, match="TLS library refuses"):  # the certificate of another node's key
        DoorTls(other, load_identity(folder / "viewer", time.time()))
    other.write_bytes(key.to_pem() + certificate)
    other.chmod(0o644)
    with pytest.raises(LocalError, match=r"other\.pem"):
        DoorTls(other, load_identity(folder / "viewer", time.time()))


def test_the_certificate_of_a_door_is_neither_a_membership_nor_that_of_a_server(folder: Path) -> None:
    root, now_s = load_root(folder / "lab/root.crt"), time.time()
    wire = issue_door(folder / "lab", (folder / "viewer/node.csr").read_bytes(), HOSTS)
    with pytest.raises(StatementError):
        Membership.from_wire(wire, root, now_s)
    with pytest.raises(StatementError, match="enrolment server"):
        verify_server_certificate(wire, root, now_s)


@pytest.mark.parametrize("host", ["", "a b", "*", "-a", "a..b", "http://a", "a" * 254, "gdp:00"])
def test_what_is_no_host_is_refused(folder: Path, host: str) -> None:
    authority = load_domain(folder / "lab")
    request = (folder / "viewer/node.csr").read_bytes()
    with pytest.raises(LocalError, match="the name or the address of a host"):
        issue_door_certificate(authority, request, [host], Validity.lasting(int(time.time()), 60))


def test_the_command_writes_the_certificate_and_replaces_none(folder: Path, tmp_path: Path) -> None:
    words = ["cert", "door", "--domain", str(folder / "lab"), "--request", str(folder / "viewer/node.csr")]
    words += ["--host", "localhost", "--host", "::1", "--out", str(tmp_path / "door.crt"), "--json"]
    for code in (0, 2):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert (ended.value.code or 0) == code
    assert (tmp_path / "door.crt").read_bytes().startswith(b"-----BEGIN CERTIFICATE")
