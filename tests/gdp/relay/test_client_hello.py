"""Protocols of a ClientHello: as OpenSSL writes it, in pieces, and in arbitrary bytes."""

from __future__ import annotations

import ssl

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.relay.client_hello import HELLO_MAX_BYTES, ClientHello, read_client_hello


def hello(*protocols: str) -> bytes:
    """Return the first bytes that a client of the TLS library sends."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    if protocols:
        context.set_alpn_protocols(list(protocols))
    sent = ssl.MemoryBIO()
    with pytest.raises(ssl.SSLWantReadError):
        context.wrap_bio(ssl.MemoryBIO(), sent).do_handshake()
    return sent.read()


@pytest.mark.parametrize("protocols", [(), ("gdp-relay/1",), ("gdp-enrolment/1", "h2")])
def test_the_protocols_of_a_client_are_read(protocols: tuple[str, ...]) -> None:
    assert read_client_hello(hello(*protocols)) == ClientHello(0, tuple(each.encode() for each in protocols))


def test_a_hello_in_pieces_says_how_many_bytes_it_needs() -> None:
    whole = hello("gdp-enrolment/1")
    assert read_client_hello(b"") == read_client_hello(whole[:4]) == ClientHello(5)
    for size in range(5, len(whole)):
        assert read_client_hello(whole[:size]) == ClientHello(len(whole))


@given(st.binary(max_size=400) | st.binary(max_size=300).map(lambda body: hello("h2")[:3] + body))
def test_arbitrary_bytes_are_no_error(data: bytes) -> None:
    found = read_client_hello(data)
    assert found.needed_bytes <= HELLO_MAX_BYTES
    assert not found.needed_bytes or found.needed_bytes > len(data)


@given(at=st.integers(0, 150), octet=st.integers(0, 255))
def test_a_changed_hello_is_no_error(at: int, octet: int) -> None:
    changed = bytearray(hello("gdp-enrolment/1"))
    changed[at % len(changed)] = octet
    assert read_client_hello(bytes(changed)).needed_bytes <= HELLO_MAX_BYTES
