"""Sealed messages of one writer, and a Reassembler for them."""

from __future__ import annotations

from os import urandom

from gdp.crypto.envelope import KeyContext, Opener, Sealer, Signer
from gdp.crypto.keys import SigningKey
from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import Kind, decode
from gdp.limits import JOIN_PATIENCE_S
from gdp.message.reassembly import ReassembledMessage, Reassembler
from gdp.message.reassembly_quota import ReassemblyQuota

SECRET = b"s" * 32
SOURCE = b"p" * 32
TOPIC = b"t" * 32
INCARNATION = 9
WRITER = SigningKey.generate()
OTHER = SigningKey.generate()
MTU = 300  # a fragment carries 188 bytes


def seal(
    number: int, message: bytes, *, signer: Signer = WRITER, mtu: int = MTU, secret: bytes = SECRET, flags: int = 0
) -> list[bytes]:
    return list(
        Sealer(
            secret=secret,
            epoch=1,
            context=KeyContext(Kind.DATA, SOURCE, INCARNATION, TOPIC),
            signer=signer,
            random_bytes=urandom,
        ).seal(number, flags, message, mtu)
    )


def opener_of(epoch: int) -> Opener:
    if epoch != 1:
        raise EnvelopeError(DropReason.UNKNOWN_EPOCH)
    return Opener(SECRET, Kind.DATA, SOURCE, INCARNATION, TOPIC)


def reassembler(budget: ReassemblyQuota | None = None, patience_s: float = JOIN_PATIENCE_S) -> Reassembler:
    return Reassembler(SOURCE, opener_of, WRITER.public, budget or ReassemblyQuota(), patience_s=patience_s)


def add(to: Reassembler, frame: bytes, now_s: float = 0.0) -> ReassembledMessage | None:
    return to.add(decode(frame), frame, now_s)


def add_all(to: Reassembler, frames: list[bytes], now_s: float = 0.0) -> list[ReassembledMessage]:
    return [joined for frame in frames if (joined := add(to, frame, now_s)) is not None]
