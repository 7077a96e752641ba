"""Client's connection to an enrolment server: TLS 1.3, verified by the domain's root and not by any public authority.

I/O; blocking. No certificate authority of the system is asked. The server's certificate is read from TLS, which proves
its key, and is verified by the root; the root is verified by its fingerprint before the first byte is sent.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from gdp.closing import ClosedOnExit
from gdp.crypto.certificates import Root
from gdp.crypto.identity import Identity
from gdp.crypto.schema import FLAG, Keyed, text
from gdp.crypto.server_certificate import channel_binding, verify_server_certificate
from gdp.errors import StatementError
from gdp.host_port import split_host_port
from gdp.intervals import HOUR_S, TRY_S
from gdp.management.control_socket import connect_control
from gdp.relay.client_hello import ENROLMENT_ALPN
from gdp.trust.enrolment_wire import (
    CLOCKS_APART_MAX_S,
    LENGTH_BYTES,
    RESPONSE_MAX_BYTES,
    TEXT,
    EnrolmentError,
    Greeting,
    MemberProof,
    Message,
    Refusal,
    UnreachableError,
    encode_message,
    message_bytes,
    prove_member,
    read_message,
)
from gdp.trust.join_token import fingerprint_of

CONNECT_S: Final = 10.0
_GREETING_MAX_BYTES: Final = 64 << 10


def client_context() -> ssl.SSLContext:
    """Return the context of every client: TLS 1.3 only; ``connect`` verifies the certificate itself."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.set_alpn_protocols([ENROLMENT_ALPN])  # by which a relay at the same port knows whose connection it is
    return context


class Channel(ClosedOnExit):
    """A connection whose server has proved to be that of the domain.

    Attributes:
        root: the domain's, as the server sent it; its founder has the expected fingerprint.
        binding, nonce: what proofs of this connection's client are bound to.
        server: ``host:port``, or ``unix:`` and a path.
    """

    def __init__(self, peer: ssl.SSLSocket, root: Root, *, binding: bytes, nonce: bytes, server: str) -> None:
        self._peer = peer
        self.root = root
        self.binding = binding
        self.nonce = nonce
        self.server = server

    def close(self) -> None:
        """Close the connection; a second call has no effect."""
        self._peer.close()

    def interrupt(self) -> None:
        """End a request that another thread waits for; it raises ``UnreachableError`` there."""
        with contextlib.suppress(OSError):  # closed in the meantime
            socket.socket.shutdown(self._peer, socket.SHUT_RDWR)  # of the plain socket: TLS stays the waiter's

    def request(self, fields: Mapping[str, object], *, timeout_s: float = CONNECT_S) -> Message:
        """Send a request and return the response.

        Raises:
            EnrolmentError: the server refuses; ``code`` says why.
            UnreachableError: the connection broke, or no response came in time.
        """
        end_s = time.monotonic() + timeout_s
        try:
            self._peer.settimeout(timeout_s)
            self._peer.sendall(encode_message(fields))
            response = _receive(self._peer, end_s, RESPONSE_MAX_BYTES)
            if Keyed("ok", FLAG).read(response):
                return response
            code, words = Keyed("code", text(64)).read(response), Keyed("error", TEXT).read(response)
        except OSError as error:
            raise UnreachableError(f"{self.server}: the connection broke: {_reason(error)}") from error
        except StatementError as error:
            raise UnreachableError(f"{self.server}: a response that cannot be read: {error}") from error
        known = {each.value: each for each in Refusal}
        raise EnrolmentError(known.get(code), f"{self.server}: {words}")

    def identify(self, identity: Identity, instance: bytes) -> None:
        """Prove to be a member; later requests are this member's.

        Args:
            instance: ``INSTANCE_BYTES`` that are random for each start of this program.

        Raises:
            EnrolmentError: NO_MEMBER or TWO_MACHINES, or as ``request``.
        """
        proof = prove_member(identity.key, self.binding, self.nonce, instance)
        self.request({"op": "member", **MemberProof(identity.membership, proof, instance).to_fields()})


def connect_any(servers: Sequence[str], fingerprint: bytes, *, timeout_s: float = CONNECT_S) -> Channel:
    """Return a channel to the first server that can be reached.

    Raises:
        EnrolmentError: a server is not that of the domain, or the clocks differ.
        UnreachableError: none can be reached; the text names each with its reason.
    """
    reasons = []
    for number, each in enumerate(servers, 1):
        try:
            wait_s = timeout_s if number == len(servers) else min(timeout_s, TRY_S)
            return connect(each, fingerprint, timeout_s=wait_s)
        except UnreachableError as error:
            reasons.append(str(error))
    raise UnreachableError(
        f"the enrolment server is not reachable: {'; '.join(reasons)}; check the network, and that TCP to it is let"
        " through"
    )


def connect(
    server: str, fingerprint: bytes, *, timeout_s: float = CONNECT_S, clock: Callable[[], float] = time.time
) -> Channel:
    """Return a channel to a server of the domain with this fingerprint.

    Raises:
        EnrolmentError: the server is not that of the domain, or this machine's clock differs from the server's.
        UnreachableError: it cannot be reached within ``timeout_s``.
    """
    end_s = time.monotonic() + timeout_s
    with contextlib.ExitStack() as stack:
        try:
            plain = stack.enter_context(_connected(server, timeout_s))
            peer = stack.enter_context(client_context().wrap_socket(plain))
            greeting = Greeting.from_fields(_receive(peer, end_s, _GREETING_MAX_BYTES))
        except ssl.SSLError as error:
            raise UnreachableError(f"{server}: no TLS 1.3 of an enrolment server: {_reason(error)}") from error
        except OSError as error:
            raise UnreachableError(f"{server}: cannot be reached: {_reason(error)}") from error
        except StatementError as error:
            raise EnrolmentError(None, f"{server}: no enrolment server answers there: {error}") from error
        certificate = peer.getpeercert(binary_form=True) or b""
        channel = _verified(peer, certificate, greeting, fingerprint, server, clock())
        stack.pop_all()
        return channel


def _connected(server: str, timeout_s: float) -> socket.socket:
    if server.startswith("unix:"):
        return connect_control(Path(server.removeprefix("unix:")), timeout_s)
    peer = socket.create_connection(split_host_port(server), timeout=timeout_s)
    peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return peer


def _verified(
    peer: ssl.SSLSocket, certificate: bytes, greeting: Greeting, fingerprint: bytes, server: str, unix_s: float
) -> Channel:
    root = greeting.root
    if fingerprint_of(root) != fingerprint:
        raise EnrolmentError(
            None,
            f"{server}: this server belongs to another domain ({root.label!r}): the token is for another domain, or"
            " somebody stands between this machine and the server; nothing was sent",
        )
    apart_s = unix_s - greeting.unix_s
    if abs(apart_s) > CLOCKS_APART_MAX_S:
        amount = f"{abs(apart_s) / HOUR_S:.1f} hours {'ahead of' if apart_s > 0 else 'behind'}"
        raise EnrolmentError(None, f"this machine's clock is {amount} the server's: set the clock, then try again")
    try:
        verify_server_certificate(certificate, root, unix_s)
    except StatementError as error:
        raise EnrolmentError(
            None,
            f"{server}: the server shows the domain's root, but not its key ({error}): somebody stands between this"
            " machine and the server; nothing was sent",
        ) from error
    return Channel(peer, root, binding=channel_binding(certificate), nonce=greeting.nonce, server=server)


def _receive(peer: ssl.SSLSocket, end_s: float, maximum: int) -> Message:
    size = message_bytes(_exactly(peer, LENGTH_BYTES, end_s), maximum)
    return read_message(_exactly(peer, size, end_s))


def _exactly(peer: ssl.SSLSocket, size: int, end_s: float) -> bytes:
    pieces = bytearray()
    while len(pieces) < size:
        left_s = end_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("no response in time")
        peer.settimeout(left_s)
        piece = peer.recv(size - len(pieces))
        if not piece:
            raise ConnectionResetError("the server closed the connection")
        pieces += piece
    return bytes(pieces)


def _reason(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__
