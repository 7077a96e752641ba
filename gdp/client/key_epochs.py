"""Key epochs of a topic: at its writer the newest seals, and the previous one still opens reports for a while; its
readers open what is sealed under any of them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: epochs of DTLS 1.3 (RFC 9147).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from gdp.client.identities import WriterIdentity
from gdp.crypto.envelope import KeyContext, Opener, Sealer
from gdp.crypto.parity_seal import ParityOpener, ParitySealer
from gdp.errors import DropReason, EnvelopeError, LocalError
from gdp.frame.codec import Kind
from gdp.limits import EPOCH_GRACE_S
from gdp.names import Name

Secrets = Mapping[int, bytes]  # key epoch -> topic secret, 32 bytes

_NEVER: Final = float("-inf")


class KeyEpochs:
    """Secrets of one topic, and the sealers under the newest of them.

    Args:
        topic: the name that the keys are derived from.
        address: destination of the frames; None: the topic.

    Attributes:
        epoch: the newest.
        secret: its secret.
        data: seals messages.
        status: seals Heartbeats.

    Raises:
        LocalError: there is no secret.
    """

    def __init__(self, topic: Name, writer: WriterIdentity, secrets: Secrets, address: Name | None = None) -> None:
        self._topic = topic
        self._writer = writer
        self._address = address
        self.secret = b""
        self._former = (-1, b"", _NEVER)  # the epoch before, its secret, and until when readers use it
        self._use(_checked(secrets))

    def renew(self, secrets: Secrets, now_s: float) -> bool:
        """Replace the secrets; return whether there is a new epoch, which seals from now on.

        Raises:
            LocalError: there is no secret.
        """
        former = self.epoch, self.secret, now_s + EPOCH_GRACE_S
        if max(_checked(secrets)) == self.epoch:
            self.secret = secrets[self.epoch]
            return False
        self._former = former
        self._use(secrets)
        return True

    def secret_of(self, epoch: int, now_s: float) -> bytes:
        """Return the secret under which reports of an epoch are accepted now.

        Raises:
            EnvelopeError: UNKNOWN_EPOCH.
        """
        if epoch == self.epoch:
            return self.secret
        former, secret, until_s = self._former
        if epoch != former or now_s >= until_s:
            raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(epoch))
        return secret

    def _use(self, secrets: Secrets) -> None:
        self.epoch = max(secrets)
        self.secret = secrets[self.epoch]
        self.data = self._sealer(Kind.DATA)
        self.status = self._sealer(Kind.HEARTBEAT)
        self._parity: ParitySealer | None = None

    @property
    def parity(self) -> ParitySealer:
        """Return what seals parity frames under the newest epoch."""
        if self._parity is None:
            writer = self._writer
            self._parity = ParitySealer(
                secret=self.secret, epoch=self.epoch, source=writer.name, incarnation=writer.incarnation,
                destination=self._topic, address=self._address,
            )  # fmt: skip
        return self._parity

    def _sealer(self, kind: Kind) -> Sealer:
        writer = self._writer
        return Sealer(
            secret=self.secret,
            epoch=self.epoch,
            context=KeyContext(kind, writer.name, writer.incarnation, self._topic),
            signer=writer.signer,
            random_bytes=writer.random_bytes,
            address=self._address,
        )


class Openers:
    """Openers of what one incarnation of a writer seals; ``is_signed``: its messages have signatures."""

    def __init__(self, secrets: Secrets, publisher: Name, incarnation: int, topic: Name, *, is_signed: bool) -> None:
        self._secrets = secrets
        self._ends = publisher, incarnation, topic
        self._is_signed = is_signed
        self._openers: dict[tuple[int, int], Opener] = {}
        self._parity: dict[int, ParityOpener] = {}

    def renew(self, secrets: Secrets) -> None:
        """Replace the topic's secrets; an epoch that is still among them opens as before."""
        self._secrets = secrets
        self._openers.clear()
        self._parity.clear()

    def opener(self, kind: Kind, epoch: int) -> Opener:
        """Return the opener of messages or Heartbeats. Raises ``EnvelopeError``: UNKNOWN_EPOCH."""
        if (kind, epoch) not in self._openers:
            secret = self._secret(epoch)
            self._openers[kind, epoch] = Opener(secret, kind, *self._ends, is_signed=self._is_signed)
        return self._openers[kind, epoch]

    def parity(self, epoch: int) -> ParityOpener:
        """Return the opener of parity frames. Raises ``EnvelopeError``: UNKNOWN_EPOCH."""
        opener = self._parity.get(epoch)
        if opener is None:
            opener = self._parity[epoch] = ParityOpener(self._secret(epoch), *self._ends)
        return opener

    def _secret(self, epoch: int) -> bytes:
        secret = self._secrets.get(epoch)
        if secret is None:
            raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(epoch))
        return secret


def _checked(secrets: Secrets) -> Secrets:
    if not secrets:
        raise LocalError("a publisher needs a topic secret")
    return secrets
