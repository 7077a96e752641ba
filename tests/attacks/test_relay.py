"""Attacks on the relay: ends that present no certificate, another's, an old one, or one of the wrong role."""

from __future__ import annotations

import ssl
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.keys import SoftwareKey
from gdp.crypto.statements import parse
from gdp.crypto.x509_profile import to_pem
from gdp.links.relay_context import tls_context
from gdp.relay.connection import ConnectionState, RelayConnection
from gdp.relay.framing import ControlMessage, ControlType
from gdp.relay.tls_channel import ALPN
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from gdp.trust.revocations import OPERATOR
from tests.gdp.relay.ends import DAY_S, NOW, Ends, at, domain, ends, exchange, member

OPEN, CLOSED = ConnectionState.OPEN, ConnectionState.CLOSED


def refused(both: Ends, client: RelayConnection | None = None) -> tuple[RelayConnection, RelayConnection]:
    """Return client and server after an attempt that both ends see fail, without an authenticated client."""
    client, server = client or both.client(), both.server()
    exchange(client, server)
    assert (client.state, server.state) == (CLOSED, CLOSED)
    assert server.peer is None
    return client, server


def accepted(both: Ends) -> bool:
    client, server = both.client(), both.server()
    exchange(client, server)
    return client.state is OPEN and server.state is OPEN


def bare_context() -> ssl.SSLContext:
    """Return a client's context that verifies nothing and has no certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.set_alpn_protocols([ALPN])
    return context


def unchecked(both: Ends, context: ssl.SSLContext) -> RelayConnection:
    """Return a client that accepts each server."""
    return both.client(context=context, authenticate=lambda *_: both.border.member)


def revoke(both: Ends, revoked: Identity, policy: Policy, key: SoftwareKey) -> None:
    root = policy.roots[policy.own]
    until_unix_s = revoked.member.not_after_unix_s
    wire = Revocation.make(key, root.signer, revoked.member.fingerprint, until_unix_s)
    policy.revoked.receive_revocation(parse(wire), OPERATOR, Timestamps(0.0, NOW), lambda _: False)


def test_a_client_without_a_certificate_is_refused() -> None:
    both = ends()
    client, server = refused(both, unchecked(both, bare_context()))
    assert client.reason == "the other end requires a certificate"
    assert server.reason == "the other end presented no certificate"


def test_a_client_of_another_domain_is_refused() -> None:
    client, server = refused(ends(joining=member(domain("other"), "member")))
    assert client.reason == "the other end does not trust the domain of this node"
    assert "not of a trusted domain" in server.reason


def test_a_domain_of_the_same_label_is_another_domain() -> None:
    refused(ends(domain("lab"), joining=member(domain("lab"), "member")))


def test_a_client_of_a_trusted_domain_is_accepted() -> None:
    lab, other = domain("lab"), domain("other")
    both = ends(lab, joining=member(other, "member"))
    assert accepted(replace(both, border_policy=Policy(lab.root, [other.root])))


def test_a_self_signed_certificate_is_refused(tmp_path: Path) -> None:
    own = domain("lab")
    assert isinstance(own.key, SoftwareKey)
    file = tmp_path / "own.pem"
    file.write_bytes(to_pem(own.root.wire) + own.key.to_pem())
    context = bare_context()
    context.load_cert_chain(file)
    both = ends()
    refused(both, unchecked(both, context))


def test_a_stolen_certificate_is_of_no_use_without_its_key(tmp_path: Path) -> None:
    both = ends()
    thief = member(domain("any"), "thief")
    assert isinstance(thief.key, SoftwareKey)
    file = tmp_path / "stolen.pem"
    file.write_bytes(to_pem(both.member.membership) + thief.key.to_pem())
    with pytest.raises(ssl.SSLError, match="MISMATCH"):
        bare_context().load_cert_chain(file)


@pytest.mark.parametrize(
    ("begins_s", "days"),
    [(NOW - 40 * DAY_S, 10), (NOW + 5 * DAY_S, 10)],
    ids=["expired", "of the future: a clock is off"],
)
def test_a_client_whose_certificate_is_not_valid_now_reads_why(begins_s: float, days: float) -> None:
    lab = domain("lab")
    client, server = refused(ends(lab, joining=member(lab, "member", begins_s=begins_s, days=days)))
    assert client.was_refused
    assert client.reason == server.reason
    assert "has it expired, or is a clock wrong?" in client.reason


def test_a_revoked_client_is_refused() -> None:
    lab = domain("lab")
    both = ends(lab)
    assert isinstance(lab.key, SoftwareKey)
    revoke(both, both.member, both.border_policy, lab.key)
    client, _ = refused(both)
    assert client.reason == "the membership of the other end was revoked"


def test_a_revoked_border_is_refused_by_the_client() -> None:
    lab = domain("lab")
    both = ends(lab)
    assert isinstance(lab.key, SoftwareKey)
    revoke(both, both.border, both.member_policy, lab.key)
    client, server = both.client(), both.server()
    exchange(client, server)
    assert client.state is CLOSED
    assert client.reason == "the membership of the other end was revoked"


@pytest.mark.parametrize("role", [Role.RIB, Role.PROXY])
def test_a_client_of_another_role_is_refused(role: Role) -> None:
    lab = domain("lab")
    client, _ = refused(ends(lab, joining=member(lab, "camera", role)))
    assert client.reason == f"camera is a {role.value}; only a switch or a leaf connects to a relay"


def test_a_leaf_is_accepted() -> None:
    lab = domain("lab")
    assert accepted(ends(lab, joining=member(lab, "robot", Role.LEAF)))


def test_a_server_that_is_another_switch_gets_no_byte_of_the_client() -> None:
    lab = domain("lab")
    both = ends(lab)
    impostor = replace(both, border=member(lab, "impostor"))
    client, server = both.client(), impostor.server()
    exchange(client, server)
    assert client.state is CLOSED
    assert "is switch impostor" in client.reason
    assert server.state is not OPEN


def test_a_server_of_another_domain_is_refused_by_the_client() -> None:
    both, other = ends(), ends()
    client, server = both.client(), other.server()
    exchange(client, server)
    assert client.state is CLOSED
    assert "not of a trusted domain" in client.reason


def test_a_member_that_the_border_does_not_relay_for_reads_why() -> None:
    client, _ = refused(ends(allow=frozenset({"another"})))
    assert client.reason == "the border does not relay for member (relay allow)"


def test_a_member_may_be_allowed_by_its_label() -> None:
    assert accepted(ends(allow=frozenset({"member"})))


def test_a_label_of_another_domain_is_not_allowed_by_the_own_label() -> None:
    lab, other = domain("lab"), domain("other")
    both = ends(lab, joining=member(other, "robot"), allow=frozenset({"robot"}))
    both = replace(both, border_policy=Policy(lab.root, [other.root]))
    refused(both)
    assert accepted(replace(both, allow=frozenset({both.member.name.to_text()})))


def test_a_border_with_all_its_clients_refuses_another() -> None:
    client, _ = refused(ends(clients_max=0))
    assert client.reason == "the border has its 0 clients already (relay clients_max)"


def test_an_old_version_of_tls_is_refused() -> None:
    both = ends()
    context = bare_context()
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    _, server = refused(both, unchecked(both, context))
    assert server.reason == "the other end does not speak TLS 1.3"


def test_another_protocol_on_the_port_is_refused() -> None:
    server = ends().server()
    server.receive_bytes(b"GET / HTTP/1.1\r\n\r\n", Timestamps(0.0, NOW))
    assert server.state is CLOSED
    assert server.reason == "the other end does not speak TLS"


def test_a_refusal_shows_no_control_characters_of_the_other_end() -> None:
    both = ends()
    client, server = both.client(), both.server()
    exchange(client, server)
    server.refuse("go \x1b[2J away")
    exchange(client, server)
    assert client.reason == "go ?[2J away"


class KeyUpdater:
    """A client that writes TLS records of its own: requests to change keys (RFC 8446, section 4.6.3)."""

    def __init__(self, both: Ends, folder: Path) -> None:
        context = tls_context(both.member, both.member_policy, is_server=False)
        context.keylog_filename = str(folder / "keys")
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing)
        self.server = both.server()
        while not self._is_established():
            self.server.receive_bytes(self._outgoing.read(), at(0.0))
            self._incoming.write(self.server.data_to_send(0.0))
        self.server.receive_bytes(self._outgoing.read(), at(0.0))
        lines = (line.split() for line in (folder / "keys").read_text().splitlines())
        (secret,) = (words[2] for words in lines if words[0] == "CLIENT_TRAFFIC_SECRET_0")
        self._secret, self._sequence = bytes.fromhex(secret), 0
        self.server.receive_bytes(self._record(ControlMessage.with_mtu(ControlType.OPEN, 1_350).to_wire(), 23), at(0.0))

    def _is_established(self) -> bool:
        try:
            self._tls.do_handshake()
        except ssl.SSLWantReadError:
            return False
        return True

    def update(self) -> bytes:
        """Return a record that requests new keys of the other end, and use new ones."""
        record = self._record(bytes([24, 0, 0, 1, 1]), 22)  # key_update, update_requested; a handshake message
        self._secret, self._sequence = self._expand(b"traffic upd", 48), 0
        return record

    def _record(self, content: bytes, kind: int) -> bytes:
        head = bytes([23, 3, 3]) + (len(content) + 17).to_bytes(2, "big")
        key, iv = self._expand(b"key", 32), self._expand(b"iv", 12)
        nonce = (int.from_bytes(iv, "big") ^ self._sequence).to_bytes(12, "big")
        self._sequence += 1
        return head + AESGCM(key).encrypt(nonce, content + bytes([kind]), head)

    def _expand(self, label: bytes, size: int) -> bytes:
        info = size.to_bytes(2, "big") + bytes([6 + len(label)]) + b"tls13 " + label + b"\0"
        return HKDFExpand(hashes.SHA384(), size, info).derive(self._secret)


def test_a94_a_client_that_requests_new_keys_and_does_not_read_costs_little_memory(tmp_path: Path) -> None:
    client = KeyUpdater(ends(), tmp_path)
    assert client.server.state is OPEN
    for _ in range(1_000):
        client.server.receive_bytes(b"".join(client.update() for _ in range(10)), at(0.0))
        if client.server.state is CLOSED:
            break
    assert client.server.state is CLOSED
    assert client.server.reason == "the other end requests more than it reads"
    assert len(client.server.data_to_send(0.0)) < 1 << 18
