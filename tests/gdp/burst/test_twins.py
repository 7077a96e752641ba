"""Burst core: the compiled twin and the one in Python return the same for the same bytes, refusals included."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path
from random import Random
from types import ModuleType
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp import burst
from gdp.burst import slots
from gdp.burst.cipher import BODY_AT, TAG_BYTES, MessageCipher, Plaintext
from gdp.crypto.envelope import SEAL_BYTES, SIGNATURE_BYTES, KeyContext, Opener, Sealer
from gdp.errors import DROP_COUNTERS, DropReason, EnvelopeError, FrameError, StatementError
from gdp.frame.codec import ETHERTYPE, HOPS_AT, Header, Kind, decode, encode
from gdp.message.reassembly import Reassembler
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.ports.mmsg import CompiledBatch, MmsgBatch
from gdp.sansio import ReceivedFrame
from tests.gdp.message.sealed import INCARNATION, SECRET, SOURCE, TOPIC
from tests.gdp.message.test_run import take

if TYPE_CHECKING:
    from hashlib import _Hash

Digest = Callable[[bytes], "_Hash"]
compiled: ModuleType = pytest.importorskip("gdp.burst.core", reason="no compiler built the burst core here")
CIPHERS: tuple[type[MessageCipher], ...] = (MessageCipher, compiled.MessageCipher)
PLAINTEXTS: tuple[type[Plaintext], ...] = (Plaintext, compiled.Plaintext)
DIGESTS: tuple[Digest, ...] = (sha256, compiled.RunningDigest)
TWINS = {"CIPHER": CIPHERS, "PLAINTEXT": PLAINTEXTS, "DIGEST": DIGESTS}
CORPUS = Path(__file__).parents[2] / "corpus"
KEY = bytes(range(32))
ETHER = bytes(12) + ETHERTYPE.to_bytes(2, "big")


def head_of(parts: int, number: int = 7, flags: int = 2) -> bytes:
    """Return the head of a message."""
    return encode(Header(1, flags, 16, 3, 0, number, 0, parts, 9, b"d" * 32, b"s" * 32)) + b"the salt"


def parts_of(size: int, capacity: int, signature_bytes: int) -> int:
    """Return the parts of a message, as the envelope counts them."""
    return max(-(-(size + signature_bytes) // capacity), 1)


def arrivals_of(frames: Sequence[bytes]) -> list[ReceivedFrame]:
    """Return frames as they come."""
    return [ReceivedFrame(0, bytes(6), frame) for frame in frames]


def use(patch: pytest.MonkeyPatch, twin: int) -> None:
    """Let what is made from now on use a twin: 0 is that in Python."""
    for name, twins in TWINS.items():
        patch.setattr(burst, name, twins[twin])


@given(
    st.integers(0, 400),
    st.integers(65, 130),
    st.integers(0, 65),
    st.sampled_from([0, SIGNATURE_BYTES]),
    st.integers(0, (1 << 64) - 1),
    st.lists(st.integers(0, 9), max_size=4),
)
def test_both_seal_the_same_in_any_pieces(
    size: int, capacity: int, before: int, signature_bytes: int, number: int, pieces: list[int]
) -> None:
    whole, parts = Random(size).randbytes(before + size), parts_of(before + size, capacity, signature_bytes)
    head, signs = head_of(parts, number), (capacity, signature_bytes)
    found: list[tuple[list[bytes], bytes]] = []
    for each, digest in zip(CIPHERS, DIGESTS, strict=True):
        for text in ((b"", whole), (whole[:before], whole[before:])):
            running, cipher, frames = digest(b"first"), each(KEY), list[bytes]()
            ends = sorted({min(end, parts) for end in pieces} | {parts}) if text[0] else [parts]
            for first, end in zip([0, *ends], ends, strict=False):
                frames += cipher.seal(head, first, end, *text, *signs, running)
            found.append((frames, running.digest()))
            assert cipher.seal(head, 0, parts, *text, *signs, None) == frames
    assert all(each == found[0] for each in found)
    payloads = b"".join(frame[BODY_AT:] for frame in found[0][0])
    assert found[0][1] == sha256(b"first" + payloads).digest()


@given(st.data())
def test_both_open_the_same_run_of_damaged_frames(data: st.DataObject) -> None:
    chance = Random(data.draw(st.integers(0, 1 << 32)))
    capacity, parts = chance.randint(1, 90), chance.randint(3, 150)
    plain = chance.randbytes(capacity * parts)
    frames = MessageCipher(KEY).seal(head_of(parts), 0, parts - 2, b"", plain, capacity, 0, None)
    for _ in range(chance.choice([0, 0, 1, 3])):
        at = chance.randrange(len(frames))
        frame = bytearray(frames[at])
        damage = chance.choice(["bit", "short", "padded", "hops", "double", "swap", "gone"])
        if damage == "bit":
            frame[chance.randrange(len(frame))] ^= 1 << chance.randrange(8)
        elif damage == "short":
            del frame[chance.randrange(len(frame)) :]
        elif damage == "padded":
            frame += bytes(chance.randint(1, 20))
        elif damage == "hops":
            frame[HOPS_AT] -= 1
        frames[at] = bytes(frame)
        if damage == "double":
            frames.insert(at, frames[at])
        elif damage == "swap":
            frames[at - 1], frames[at] = frames[at], frames[at - 1]
        elif damage == "gone" and len(frames) > 1:
            del frames[at]
    first = chance.choice([0, 0, chance.randrange(parts)])
    at = chance.choice([first, first, chance.randrange(len(frames) + 1)])
    count, length = chance.randint(0, 160), capacity + SEAL_BYTES + chance.choice([0] * 9 + [1])
    given_, found = (head_of(parts), length, first, count, arrivals_of(frames), at), list[tuple[int, bytes, bytes]]()
    for cipher, buffer, digest in zip(CIPHERS, PLAINTEXTS, DIGESTS, strict=True):
        running, plaintext = digest(b"first"), buffer(chance.choice([0, 1, 99, 10_000]))
        plaintext.append(b"before")
        taken = cipher(KEY).open_run(*given_, running, plaintext)
        assert cipher(KEY).open_run(*given_, None, plaintext) == taken
        opened = plaintext.collect()
        assert plaintext.collect() == b""
        assert len(opened) == len(b"before") + 2 * taken * (length - SEAL_BYTES)
        found.append((taken, running.digest(), opened))
    assert found[0] == found[1]


@given(st.binary(max_size=200), st.integers(0, 300), st.integers(0, 7))
def test_both_open_or_refuse_one_frame(message: bytes, at: int, bit: int) -> None:
    frames = MessageCipher(KEY).seal(head_of(1), 0, 1, b"", message, 300, 0, None)
    altered = bytearray(frames[0])
    altered[at % len(altered)] ^= 1 << bit
    for frame in (frames[0], bytes(altered), frames[0][:-1]):
        plains = [each(KEY).open(frame, len(frames[0])) for each in CIPHERS]
        assert plains[0] == plains[1]
        if frame == frames[0]:
            assert plains[0] == (message, frame[BODY_AT:])


@given(st.lists(st.binary(max_size=80), max_size=9), st.integers(0, 1 << 31), st.floats(0, 9))
def test_both_make_the_same_received_frames(frames: list[bytes], port: int, waited_s: float) -> None:
    slot_bytes, chance = 100, Random(port)
    filled = [chance.randbytes(14) + frame for frame in frames]
    pool = bytearray(b"".join(each.ljust(slot_bytes, b"?") for each in filled)) + bytes(2 * slot_bytes)
    given_ = pool, slot_bytes, [*map(len, frames)], port, waited_s
    by_python, by_c = slots.received(*given_), compiled.received(*given_)
    assert by_python == by_c
    assert [(each.mac, each.frame) for each in by_c] == [(each[6:12], each[14:]) for each in filled]
    assert {type(each) for each in by_c} <= {ReceivedFrame}


@given(st.integers(0, 1 << 32), st.integers(0, 20))
def test_both_forward_the_same_runs(seed: int, count: int) -> None:
    chance, slot_bytes, frames = Random(seed), 300, list[bytes]()
    for _ in range(count):
        length = chance.randint(0, 100)
        header = Header(
            chance.choice([1, 1, 1, 5, 0x80]), 0, chance.choice([16, 16, 16, 144, 1, 129]), 1, length, 7, 0, 1, 9,
            chance.choice([b"d", b"d", b"e"]) * 32, chance.choice([b"s", b"s", b"t"]) * 32,
        )  # fmt: skip
        frame = bytearray(encode(header) + chance.randbytes(length))
        frame[0] = chance.choice([1, 1, 1, 1, 2])
        frames.append(ETHER + frame[: chance.choice([None, None, None, -1, 95])])
    done = []
    for kind in (MmsgBatch, CompiledBatch):
        (one, source), (sink, end) = (socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2))
        calls = list[object]()

        def route(key: bytes, largest: int, calls: list[object] = calls, sink: socket.socket = sink) -> Any:
            calls.append((key, largest))
            return [(sink.fileno(), bytes(12))] * (key[0] == ord("d"))

        with one, source, sink, end:
            for each in frames:
                one.send(each)
            counts = kind(slot_bytes).forward(source, route, calls.append, [0] * DROP_COUNTERS)
            done.append((counts, calls, [end.recv(slot_bytes) for _ in range(counts[1])]))
    assert done[0] == done[1]
    assert done[0][0][0] == count == done[0][0][1] + sum(isinstance(call, bytes) for call in done[0][1])


def test_slots_that_the_pool_has_not_are_refused() -> None:
    for sizes in ([87], [-1], [0, 0, 0], [1 << 40]):
        with pytest.raises(ValueError, match="slots"):
            compiled.received(bytearray(200), 100, sizes, 0, 0.0)
    with pytest.raises(ValueError, match="slots"):
        compiled.Receiver(109, 1).forward(0, None, None, None)
    with pytest.raises(TypeError):
        compiled.received(bytes(200), 100, [1], 0, 0.0)


@given(st.lists(st.binary(min_size=100, max_size=180), max_size=20), st.integers(0, 9), st.integers(0, 20))
def test_both_receive_and_find_samples_and_open_what_the_kernel_delivers(
    frames: list[bytes], at: int, count: int
) -> None:
    frames = [frame[:-1] + bytes([frame[-1] & 0xC1]) for frame in frames]  # every second one is a sample
    receiver = compiled.Receiver(200, 30)
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with one, other:
        assert len(receiver.receive(other.fileno(), 5)) == 0
        for frame in frames:
            one.send(bytes(range(14)) + frame)
        arrivals = receiver.receive(other.fileno(), 5)
        expected = [ReceivedFrame(5, bytes(range(6, 12)), frame) for frame in frames]
        assert list(arrivals) == expected == arrivals[:]
        assert (len(arrivals), arrivals[-3:], arrivals[1:9:2]) == (len(frames), expected[-3:], expected[1:9:2])
        found = slots.samples(expected, at, count)
        assert found == compiled.samples(arrivals, at, count) == compiled.samples(expected, at, count)
        assert found == slots.samples(frames, at, count) == compiled.samples(frames, at, count)
        one.send(bytes(14) + b"later")
        later = receiver.receive(other.fileno(), 5)  # what came before is still there
        assert (list(arrivals), [each.frame for each in later]) == (expected, [b"later"])
    for wrong in (len(frames), -len(frames) - 1, "0"):
        with pytest.raises((IndexError, TypeError)):
            arrivals[wrong]


def test_a_message_is_opened_from_the_slots_of_the_kernel() -> None:
    message, capacity = Random(1).randbytes(9_000), 150
    parts = parts_of(len(message), capacity, 0)
    frames = MessageCipher(KEY).seal(head_of(parts), 0, parts - 1, b"", message, capacity, 0, None)
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    receiver, cipher = compiled.Receiver(14 + len(frames[0]), 25), compiled.MessageCipher(KEY)
    plaintext, running, opened = compiled.Plaintext(len(message)), compiled.RunningDigest(b""), 0
    with one, other:
        while opened < len(frames):
            sent = compiled.send(one.fileno(), frames[: opened + 7], opened, bytes(14))
            arrivals = receiver.receive(other.fileno(), 0)
            assert len(arrivals) == sent == min(7, len(frames) - opened)
            run = head_of(parts), capacity + SEAL_BYTES, opened, 128, arrivals, 0
            opened += cipher.open_run(*run, running, plaintext)
    assert plaintext.collect() == message[: len(frames) * capacity]
    assert running.digest() == sha256(b"".join(frame[BODY_AT:] for frame in frames)).digest()


class _IdealSigner:
    """Signer and verifier without a random number, so that both twins sign the same."""

    def sign_digest(self, digest: bytes) -> bytes:
        return digest + digest[::-1]

    def verify_digest(self, signature: bytes, digest: bytes) -> None:
        if signature != digest + digest[::-1]:
            raise StatementError(DropReason.BAD_SIGNATURE)


def _message_by(twin: int, seed: int, *, is_signed: bool) -> tuple[object, ...]:
    """Return all that shows of messages sealed, disordered and reassembled by one twin."""
    chance, patch = Random(seed), pytest.MonkeyPatch()
    use(patch, twin)
    signer = _IdealSigner() if is_signed else None
    sealer = Sealer(
        secret=SECRET, epoch=1, context=KeyContext(Kind.DATA, SOURCE, INCARNATION, TOPIC), signer=signer,
        random_bytes=chance.randbytes,
    )  # fmt: skip
    try:
        frames: list[bytes] = []
        for number in range(1, 4):
            body, mtu, prefix = chance.randbytes(chance.randrange(9_000)), chance.choice([300, 1500]), number * b"8"
            sealed = sealer.seal(number, 2, body, mtu, prefix)
            assert sealed.message() == prefix + body
            at_once = chance.randint(1, 70)
            for begin in range(0, len(sealed), at_once):
                frames += sealed[begin : begin + at_once]
            assert sealer.seal(number + 10 * number, 2, sealed, 600).message() == sealed.message() == prefix + body
            sealer._last_number = number
        sent = list(frames)
        for _ in range(chance.randrange(min(6, len(frames)))):
            at = chance.randrange(len(frames))
            frames[at : at + 1] = chance.choice([[], [frames[at]] * 2, [frames[at][:-1] + b"?"]])
        budget = ReassemblyQuota(total_bytes=chance.choice([6_000, 1 << 20]))
        opener = Opener(SECRET, Kind.DATA, SOURCE, INCARNATION, TOPIC, is_signed=is_signed)
        to = Reassembler(SOURCE, lambda _: opener, signer, budget)
        joined, _ = take(to, frames, chance.randint(1, 64))
        state = [(number, to.missing(number, 9, to_end=True), to.progress(number)) for number in range(1, 4)]
        return sent, joined, to.drops, to.new_parts, to.highest, to.unfinished_bytes, budget.held_bytes, state
    finally:
        patch.undo()


@given(st.integers(0, 1 << 32), st.booleans())
def test_messages_drops_and_counters_are_the_same(seed: int, is_signed: bool) -> None:
    assert _message_by(0, seed, is_signed=is_signed) == _message_by(1, seed, is_signed=is_signed)


def test_both_do_the_same_with_the_corpus_of_the_fuzzers() -> None:
    for path in sorted([*(CORPUS / "envelope").iterdir(), *(CORPUS / "frame").iterdir()]):
        frame, outcomes = path.read_bytes(), list[object]()
        for twin in (0, 1):
            with pytest.MonkeyPatch.context() as patch:
                use(patch, twin)
                try:
                    outcomes.append(Opener(SECRET, Kind.DATA, SOURCE, INCARNATION, TOPIC).open(decode(frame), frame))
                except (EnvelopeError, FrameError) as error:
                    outcomes.append(error.reason)
        assert outcomes[0] == outcomes[1], path


def test_the_published_frames_open_by_the_compiled_twin() -> None:
    published = json.loads((CORPUS.parent / "vectors" / "envelope.json").read_text())
    for vector in published["messages"]:
        frames = [bytes.fromhex(each) for each in vector["frames"]]
        ends = [len(frame) for frame in frames]
        ends[-1] -= SIGNATURE_BYTES
        cipher = compiled.MessageCipher(bytes.fromhex(vector["message_key"]))
        plains = [cipher.open(frame, end)[0] for frame, end in zip(frames, ends, strict=True)]
        assert b"".join(plains) == bytes.fromhex(vector["message"])


def test_nothing_unverified_leaves_a_run() -> None:
    frames = MessageCipher(KEY).seal(head_of(9), 0, 7, b"", bytes(9 * 50), 50, 0, None)
    frames[3] = frames[3][:-1] + bytes([frames[3][-1] ^ 1])
    plaintext, running = compiled.Plaintext(9 * 50), compiled.RunningDigest(b"")
    run = head_of(9), 50 + SEAL_BYTES, 0, 7, arrivals_of(frames), 0
    assert compiled.MessageCipher(KEY).open_run(*run, running, plaintext) == 3
    assert plaintext.collect() == bytes(150)
    assert running.digest() == sha256(b"".join(frame[BODY_AT:] for frame in frames[:3])).digest()


@pytest.mark.parametrize(
    "arguments",
    [
        (b"short", 0, 1, b"", b"", 100, 0),
        (head_of(3), 2, 1, b"", b"", 100, 0),
        (head_of(3), -1, 1, b"", b"", 100, 0),
        (head_of(3), 0, 4, b"", b"", 100, 0),
        (head_of(3), 0, 1, b"", b"", 0, 0),
        (head_of(3), 0, 1, b"", b"", 1 << 16, 0),
        (head_of(3), 0, 1, b"", b"", 100, -1),
    ],
)
def test_wrong_arguments_of_ours_are_refused(arguments: tuple[bytes, int, int, bytes, bytes, int, int]) -> None:
    with pytest.raises(ValueError, match=r"a header|parts of"):
        compiled.MessageCipher(KEY).seal(*arguments, None)
    with pytest.raises(TypeError, match="RunningDigest"):
        compiled.MessageCipher(KEY).seal(head_of(3), 0, 1, b"", b"", 100, 0, sha256())
    for slot_bytes, count in ((13, 9), (1 << 17, 9), (200, 0), (200, 1 << 10)):
        with pytest.raises(ValueError, match="slots"):
            compiled.Receiver(slot_bytes, count)
    for at, header in ((0, bytes(13)), (-1, bytes(14))):
        with pytest.raises(ValueError, match="Ethernet header"):
            compiled.send(0, [b"frame"], at, header)


def test_what_are_no_received_frames_is_refused() -> None:
    cipher = compiled.MessageCipher(KEY)
    for wrong in (["text"], [(0, 0)], [(0, 0, "text")], 5):
        with pytest.raises((TypeError, IndexError)):
            cipher.open_run(head_of(3), 50, 0, 1, wrong, 0, None, compiled.Plaintext(9))
        with pytest.raises((TypeError, IndexError)):
            compiled.send(0, wrong, 0, bytes(14))
    with pytest.raises(TypeError, match="Plaintext"):
        cipher.open_run(head_of(3), 50, 0, 1, [], 0, None, Plaintext(9))
    for key in (b"", bytes(31), bytes(33)):
        with pytest.raises(ValueError, match="32 bytes"):
            compiled.MessageCipher(key)
    with pytest.raises(ValueError, match="end of a sealed part"):
        cipher.open(bytes(200), BODY_AT + TAG_BYTES - 1)


def test_a_cipher_in_use_by_another_thread_refuses_or_works() -> None:
    cipher, message = compiled.MessageCipher(KEY), bytes(100_000)
    right = MessageCipher(KEY).seal(head_of(100), 0, 98, b"", message, 1_000, 0, None)
    wrong: list[object] = []

    def work() -> None:
        for _ in range(50):
            try:
                if cipher.seal(head_of(100), 0, 98, b"", message, 1_000, 0, None) != right:
                    wrong.append("other frames")
            except RuntimeError as error:
                assert "another thread" in str(error)  # noqa: PT017

    threads = [threading.Thread(target=work) for _ in range(3)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert not wrong
