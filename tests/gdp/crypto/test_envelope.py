"""Sealing and opening: the published vectors, and inputs that must not open."""

from __future__ import annotations

import hashlib
import json
from os import urandom
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from hypothesis import given
from hypothesis import strategies as st

from gdp.burst.cipher import SALT_BYTES
from gdp.crypto.envelope import (
    SEAL_BYTES,
    SIGNATURE_BYTES,
    KeyContext,
    MessageKeys,
    Opener,
    Sealer,
    fragment_capacity,
    seal_key,
)
from gdp.crypto.keys import PublicKey, SigningKey
from gdp.errors import DropReason, EnvelopeError, LocalError, StatementError
from gdp.frame.codec import HEADER_BYTES, HOPS_AT, Flag, Kind, authenticated, decode
from gdp.limits import FRAME_MAX_BYTES, HOPS_MAX, MESSAGE_MAX_BYTES, SEQUENCE_BYTES
from tests.gdp.message.sealed import INCARNATION, MTU, SECRET, SOURCE, TOPIC, WRITER, opener_of, seal

FILE = json.loads((Path(__file__).parents[2] / "vectors" / "envelope.json").read_text())
VECTORS: list[dict[str, object]] = FILE["messages"]


def text(vector: dict[str, object], key: str) -> str:
    value = vector[key]
    assert isinstance(value, str)
    return value


def texts(vector: dict[str, object], key: str) -> list[str]:
    value = vector[key]
    assert isinstance(value, list)
    return [str(each) for each in value]


def of(vector: dict[str, object], key: str) -> bytes:
    return bytes.fromhex(text(vector, key))


def number(vector: dict[str, object], key: str) -> int:
    return int(str(vector[key]))


def key_of(vector: dict[str, object]) -> bytes:
    incarnation, kind = number(vector, "incarnation"), number(vector, "kind")
    return seal_key(of(vector, "secret"), kind, of(vector, "source"), incarnation, of(vector, "destination"))


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: str(vector["what"]))
def test_a_published_message_is_sealed_again_to_the_byte_up_to_its_signature(vector: dict[str, object]) -> None:
    incarnation, kind = number(vector, "incarnation"), number(vector, "kind")
    source, destination, epoch = of(vector, "source"), of(vector, "destination"), number(vector, "epoch")
    signer = SigningKey.from_pem(FILE["writer"]["private"].encode())
    salt = of(vector, "salt")
    sealer = Sealer(
        secret=of(vector, "secret"),
        epoch=epoch,
        context=KeyContext(kind, source, incarnation, destination),
        signer=signer,
        random_bytes=lambda _: salt,
    )
    published = [bytes.fromhex(each) for each in texts(vector, "frames")]
    message = of(vector, "message")
    frames = list(sealer.seal(number(vector, "number"), number(vector, "flags"), message, number(vector, "mtu")))
    assert frames[:-1] == published[:-1]
    assert frames[-1][:-SIGNATURE_BYTES] == published[-1][:-SIGNATURE_BYTES]


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: str(vector["what"]))
def test_every_step_of_a_published_message_comes_out(vector: dict[str, object]) -> None:
    frames = [bytes.fromhex(each) for each in texts(vector, "frames")]
    aead, salt = AESGCM(of(vector, "message_key")), of(vector, "salt")
    assert key_of(vector) == of(vector, "key")
    assert len(salt) == SALT_BYTES
    hashed = of(vector, "hash_head")
    message = b""
    for part, frame in enumerate(frames):
        header = decode(frame)
        end = HEADER_BYTES + header.length - (SIGNATURE_BYTES if part == len(frames) - 1 else 0)
        nonce, aad = bytes.fromhex(texts(vector, "nonces")[part]), bytes.fromhex(texts(vector, "aads")[part])
        assert nonce == header.number.to_bytes(8, "big") + part.to_bytes(4, "big")
        assert aad == authenticated(frame)
        assert frame[HEADER_BYTES : HEADER_BYTES + SALT_BYTES] == salt
        sealed = frame[HEADER_BYTES + SALT_BYTES : end]
        message += aead.decrypt(nonce, sealed, aad)
        hashed += sealed
    assert message == of(vector, "message")
    assert hashlib.sha256(hashed).digest() == of(vector, "digest")


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: str(vector["what"]))
def test_the_published_signature_verifies(vector: dict[str, object]) -> None:
    writer = PublicKey.from_compressed(bytes.fromhex(FILE["writer"]["public"]))
    last = bytes.fromhex(texts(vector, "frames")[-1])
    writer.verify_digest(last[-SIGNATURE_BYTES:], of(vector, "digest"))
    with pytest.raises(StatementError):
        writer.verify_digest(last[-SIGNATURE_BYTES:], bytes(32))


@given(st.binary(max_size=2_000), st.sampled_from([300, 576, 1500, 65_535]))
def test_what_was_sealed_opens_and_no_frame_passes_the_mtu(message: bytes, mtu: int) -> None:
    frames = seal(1, message, mtu=mtu)
    assert all(len(frame) <= mtu for frame in frames)
    assert b"".join(opener_of(1).open(decode(frame), frame)[0] for frame in frames) == message


@pytest.mark.parametrize("beyond", [-1, 0, 1])
def test_the_signature_gets_a_part_of_its_own_only_where_it_must(beyond: int) -> None:
    fits = fragment_capacity(MTU) - SIGNATURE_BYTES
    frames = seal(1, bytes(fits + beyond))
    assert len(frames) == (2 if beyond > 0 else 1)
    assert [bool(decode(frame).flags & Flag.LAST) for frame in frames] == [False] * (len(frames) - 1) + [True]


def test_all_parts_but_the_last_two_are_full() -> None:
    frames = seal(1, bytes(5_000))
    assert {len(frame) for frame in frames[:-2]} == {MTU}


def test_ethernet_padding_behind_the_payload_does_not_count() -> None:
    (frame,) = seal(1, b"x")
    assert opener_of(1).open(decode(frame), frame + bytes(30))[0] == b"x"


def test_only_hops_left_may_change_on_the_way() -> None:
    (frame,) = seal(1, b"short")
    for at in range(len(frame) - SIGNATURE_BYTES):
        changed = bytearray(frame)
        changed[at] ^= 0x01
        header = decode(frame)._replace(number=int.from_bytes(changed[8:16], "big"), flags=changed[2])
        if at == HOPS_AT:
            assert opener_of(1).open(header, bytes(changed))[0] == b"short"
        else:
            with pytest.raises(EnvelopeError):
                opener_of(1).open(header, bytes(changed))


@pytest.mark.parametrize("length", [0, SEAL_BYTES - 1, SIGNATURE_BYTES + SEAL_BYTES - 1])
def test_a_fragment_too_short_for_a_tag_is_truncated(length: int) -> None:
    (frame,) = seal(1, b"short")
    with pytest.raises(EnvelopeError) as caught:
        opener_of(1).open(decode(frame)._replace(length=length), frame)
    assert caught.value.reason is DropReason.TRUNCATED


def test_another_source_incarnation_kind_destination_or_secret_is_another_key() -> None:
    base = (SECRET, Kind.DATA, SOURCE, INCARNATION, TOPIC)
    others = [
        (b"S" * 32, *base[1:]),
        (SECRET, Kind.HEARTBEAT, *base[2:]),
        (*base[:2], b"q" * 32, *base[3:]),
        (*base[:3], INCARNATION + 1, TOPIC),
        (*base[:4], b"u" * 32),
    ]
    keys = {seal_key(*each) for each in [base, *others]}
    assert len(keys) == 6
    (frame,) = seal(1, b"x")
    for each in others:
        with pytest.raises(EnvelopeError):
            Opener(*each).open(decode(frame), frame)


def test_a_number_is_sealed_once() -> None:
    sealer = Sealer(
        secret=SECRET,
        epoch=1,
        context=KeyContext(Kind.DATA, SOURCE, INCARNATION, TOPIC),
        signer=WRITER,
        random_bytes=urandom,
    )
    list(sealer.seal(5, 0, b"x", MTU))
    for again in (5, 4):
        with pytest.raises(LocalError):
            list(sealer.seal(again, 0, b"y", MTU))


def test_what_is_above_the_limits_is_refused_before_a_number_is_spent() -> None:
    sealer = Sealer(
        secret=SECRET,
        epoch=1,
        context=KeyContext(Kind.DATA, SOURCE, INCARNATION, TOPIC),
        signer=WRITER,
        random_bytes=urandom,
    )
    with pytest.raises(LocalError):
        list(sealer.seal(1, 0, bytes(MESSAGE_MAX_BYTES + SEQUENCE_BYTES + 1), FRAME_MAX_BYTES))
    with pytest.raises(LocalError):
        list(sealer.seal(1, 0, b"", HEADER_BYTES + SEAL_BYTES + SIGNATURE_BYTES))
    assert decode(sealer.seal(1, 0, b"", MTU)[0]).hops_left == HOPS_MAX


def test_message_keys_are_those_of_xaes_256_gcm() -> None:
    sealed = AESGCM(MessageKeys(b"\x01" * 32).of(b"ABCDEFGHIJKL")).encrypt(b"MNOPQRSTUVWX", b"XAES-256-GCM", b"")
    assert sealed.hex() == "ce546ef63c9cc60765923609b33a9a1974e96e52daf2fcf7075e2271"  # C2SP, XAES-256-GCM


def test_two_copies_of_one_sealer_share_no_key_under_one_number() -> None:
    copies = [
        Sealer(
            secret=SECRET,
            epoch=1,
            context=KeyContext(Kind.DATA, SOURCE, INCARNATION, TOPIC),
            signer=WRITER,
            random_bytes=urandom,
        )
        for _ in range(2)
    ]
    (first,), (second,) = (list(each.seal(1, 0, b"a message", MTU)) for each in copies)
    salt = slice(HEADER_BYTES, HEADER_BYTES + SALT_BYTES)
    assert first[: salt.start] == second[: salt.start]
    assert first[salt] != second[salt]
    assert first[salt.stop : salt.stop + 9] != second[salt.stop : salt.stop + 9]


def test_a_secret_has_thirty_two_bytes() -> None:
    with pytest.raises(LocalError):
        seal_key(bytes(31), Kind.DATA, SOURCE, 1, TOPIC)
