"""TLS 1.3 channel in memory: ciphertext in and out, plaintext in and out.

Sans-I/O over ``ssl.SSLObject``. Source: RFC 8446. Both ends present their membership certificates. The library checks
that a trusted root signed them and that the other end has the key. Validity periods, revocations, roles and names are
the caller's part (``admission``), so that there is one rule for them in the project.
"""

from __future__ import annotations

import ssl
from typing import Final

from gdp.errors import GdpError

ALPN: Final = "gdp-relay/1"
RECORD_BYTES: Final = 16_384  # plaintext of one record at most; RFC 8446, section 5.1
_SENTENCES: Final = {
    "ALERT_UNKNOWN_CA": "the other end does not trust the domain of this node",
    "ALERT_CERTIFICATE_REQUIRED": "the other end requires a certificate",
    "ALERT_CERTIFICATE_EXPIRED": "the other end says that this node's certificate has expired",
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": "the other end presented no certificate",
    "CERTIFICATE_VERIFY_FAILED": "the certificate of the other end is not of a trusted domain",
    "NO_APPLICATION_PROTOCOL": "the other end is no relay of this version",
    "UNSUPPORTED_PROTOCOL": "the other end does not speak TLS 1.3",
    "ALERT_PROTOCOL_VERSION": "the other end does not speak TLS 1.3",
    "WRONG_VERSION_NUMBER": "the other end does not speak TLS",
    "HTTP_REQUEST": "the other end does not speak TLS",
}


class TlsError(GdpError):
    """The handshake or a record failed; the connection is over. The text is a sentence for people."""


class TlsChannel:
    """One end of a TLS connection.

    Args:
        context: TLS 1.3 only, with a certificate, and requiring one from the other end.
        host: the host name that a client dialled, for the server name indication; empty for an address.
    """

    def __init__(self, context: ssl.SSLContext, *, is_server: bool, host: str = "") -> None:
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(
            self._incoming, self._outgoing, server_side=is_server, server_hostname=None if is_server else host or None
        )
        self.is_established = False

    @property
    def certificate(self) -> bytes:
        """Return the other end's certificate, DER; empty before the handshake."""
        return self._tls.getpeercert(binary_form=True) or b""

    @property
    def waiting_bytes(self) -> int:
        """Return how many bytes of ciphertext are ready to be sent."""
        return self._outgoing.pending

    def receive_bytes(self, data: bytes) -> list[bytes]:
        """Take in ciphertext; return the plaintext that it completes, maybe after the end of the handshake.

        Raises:
            TlsError: the other end is not accepted, has ended the connection, or its bytes are wrong.
        """
        self._incoming.write(data)
        return self.read() if self.is_established or self.shake_hands() else []

    def shake_hands(self) -> bool:
        """Proceed with the handshake; return whether it is complete. A client calls it first.

        Raises:
            TlsError: as for ``receive_bytes``.
        """
        try:
            self._tls.do_handshake()
        except ssl.SSLWantReadError:
            return False
        except ssl.SSLError as error:
            raise TlsError(_sentence(error)) from error
        if self._tls.selected_alpn_protocol() != ALPN:
            raise TlsError(_SENTENCES["NO_APPLICATION_PROTOCOL"])
        self.is_established = True
        return True

    def read(self) -> list[bytes]:
        """Return the plaintext of the received records. Raises ``TlsError``: as for ``receive_bytes``."""
        plain: list[bytes] = []
        read = self._tls.read
        try:
            while data := read(RECORD_BYTES):
                plain.append(data)
        except ssl.SSLWantReadError:
            return plain
        except ssl.SSLError as error:
            raise TlsError(_sentence(error)) from error
        raise TlsError("the other end closed the connection")

    def write(self, plain: bytes) -> None:
        """Encrypt plaintext; ``data_to_send`` returns the records. The handshake is complete."""
        self._tls.write(plain)

    def data_to_send(self) -> bytes:
        """Return and remove the ciphertext that is ready to be sent."""
        return self._outgoing.read()


def _sentence(error: ssl.SSLError) -> str:
    """Return what went wrong, for people."""
    reason = error.reason or ""
    known = next((text for key, text in _SENTENCES.items() if reason.endswith(key)), None)
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"{_SENTENCES['CERTIFICATE_VERIFY_FAILED']} ({error.verify_message})"
    if isinstance(error, ssl.SSLZeroReturnError | ssl.SSLEOFError):
        return "the other end closed the connection"
    return known or f"TLS failed: {reason.replace('_', ' ').lower() or error}"
