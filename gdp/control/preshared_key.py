"""Agreement of the two ends of a tunnel on WireGuard's preshared key, so that a recorded tunnel stays closed later.

Sans-I/O except for the randomness that the library draws. The messages travel in hellos between neighbours that are up,
so they are signed, and each end has echoed the other's session. The end with the lower name is the first::

    first                          second
    ephemeral KEM key    ----->
                         <-----    secret, sealed to it
    tag of the first     ----->    has the key
    has the key          <-----    tag of the second

A message is repeated in each hello until the other end's answer comes. An end that is no longer up at the other, or
says what does not fit, resets it: both ends then have no key and begin again. A KEM key is used for one agreement only,
so no key that a node keeps opens a recorded one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Final

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.crypto.kem import KEM_PUBLIC_BYTES, SEALING_BYTES, KemPrivateKey, KemPublicKey
from gdp.errors import DropReason, StatementError
from gdp.names import Name

_KEY_BYTES: Final = 32
_TAG_BYTES: Final = 16
_SEALED_BYTES: Final = SEALING_BYTES + _KEY_BYTES
_INFO: Final = b"gdp-tunnel-preshared-1"
SIZES: Final = (0, _TAG_BYTES, _SEALED_BYTES, KEM_PUBLIC_BYTES)  # of a message, which its size identifies
NO_KEY: Final = bytes(_KEY_BYTES)  # WireGuard's own word for none


class PresharedKeyAgreement:
    """One end of an agreement.

    Attributes:
        peer: the other end.
        message: what our hellos say; empty: nothing.
        key: 32 bytes; ``NO_KEY`` until both ends have it.
    """

    def __init__(self, me: Name, peer: Name, random_bytes: Callable[[int], bytes]) -> None:
        self.peer = peer
        self._is_first = me < peer
        self._random_bytes = random_bytes
        self._ends = b"", b""
        self.reset()

    def reset(self) -> None:
        """Begin again, because the other end is no neighbour any more."""
        self.message, self.key = b"", NO_KEY
        self._private: KemPrivateKey | None = None
        self._received = b""  # the message that ours answers
        self._agreed: tuple[bytes, bytes, bytes] | None = None  # key, tag of the first, tag of the second

    def receive(self, message: bytes, own: bytes, far: bytes) -> bool:
        """Process what a hello of the other end says; return whether ours says something else now.

        Args:
            own: session and name of this end.
            far: those of the other end.

        Raises:
            StatementError: MALFORMED: no KEM key; BAD_TAG: not sealed to our present one, perhaps to one before it.
        """
        before = self.message
        ends = (own, far) if self._is_first else (far, own)
        if ends != self._ends:
            self.reset()
            self._ends = ends
        if self._is_first:
            self._receive_at_first(message)
        else:
            self._receive_at_second(message)
        return self.message != before

    def _receive_at_first(self, message: bytes) -> None:
        if self._private is not None:
            if len(message) == _SEALED_BYTES:
                self._agree(self._private.open(message, self._info), message)
                self._private = None
        elif self._agreed is not None and message == self._agreed[2]:
            self.key = self._agreed[0]
        elif self._agreed is None or self.key != NO_KEY or message != self._received:
            self.reset()
            self._private = KemPrivateKey.generate()
            self.message = self._private.public.wire

    def _receive_at_second(self, message: bytes) -> None:
        if self._agreed is not None and message == self._agreed[1]:
            self.key, self.message = self._agreed[0], self._agreed[2]
        elif self._agreed is None or self.key != NO_KEY or message != self._received:
            self.reset()
            if len(message) == KEM_PUBLIC_BYTES:
                secret = self._random_bytes(_KEY_BYTES)
                sealed = KemPublicKey.from_wire(message).seal(secret, self._info)
                self._agree(secret, message)
                self.message = sealed

    def _agree(self, secret: bytes, received: bytes) -> None:
        made = HKDF(hashes.SHA256(), _KEY_BYTES + 2 * _TAG_BYTES, None, self._info).derive(secret)
        key, tags = made[:_KEY_BYTES], made[_KEY_BYTES:]
        self._agreed = key, tags[:_TAG_BYTES], tags[_TAG_BYTES:]
        self._received, self.message = received, tags[:_TAG_BYTES]

    @property
    def _info(self) -> bytes:
        return _INFO + b"".join(self._ends)


class PresharedKeys:
    """Preshared keys of one node's tunnels, by port; ``refused``: messages of an agreement, by reason."""

    def __init__(self, me: Name, random_bytes: Callable[[int], bytes]) -> None:
        self._me = me
        self._random_bytes = random_bytes
        self._agreements: dict[int, PresharedKeyAgreement] = {}
        self.refused: Counter[DropReason] = Counter()

    def agree(self, port: int, peer: Name) -> None:
        """Agree with a peer on the key of a tunnel, whose port this is, whenever it is up."""
        self._agreements[port] = PresharedKeyAgreement(self._me, peer, self._random_bytes)

    def key(self, port: int) -> bytes:
        """Return the key of a tunnel; ``NO_KEY`` unless its peer is up and has it, too."""
        agreement = self._agreements.get(port)
        return NO_KEY if agreement is None else agreement.key

    def message(self, port: int) -> bytes:
        """Return what hellos on a port say; empty: nothing."""
        agreement = self._agreements.get(port)
        return b"" if agreement is None else agreement.message

    def receive(self, port: int, peer: Name, message: bytes, own: bytes, far: bytes) -> bool:
        """Process what a hello of a neighbour that is up says; return whether ours says something else now.

        Args:
            own: session and name of this end.
            far: those of the other end.
        """
        agreement = self._agreements.get(port)
        if agreement is None or agreement.peer != peer:
            return False
        try:
            return agreement.receive(message, own, far)
        except StatementError as error:
            self.refused[error.reason] += 1
            return False

    def reset(self, port: int, peer: Name) -> None:
        """Begin an agreement again: its peer is not up any more. Nothing happens where this is not its peer."""
        agreement = self._agreements.get(port)
        if agreement is not None and agreement.peer == peer:
            agreement.reset()

    def remove(self, port: int) -> None:
        """Forget the key of a port."""
        self._agreements.pop(port, None)
