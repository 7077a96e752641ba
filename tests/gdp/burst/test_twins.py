"""Burst core: the compiled twin and the one in Python return the same for the same bytes, refusals included."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from pathlib import Path
from random import Random
from types import ModuleType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp import burst
from gdp.burst import slots
from gdp.burst.cipher import BODY_AT, TAG_BYTES, MessageCipher
from gdp.crypto.envelope import SEAL_BYTES, SIGNATURE_BYTES, KeyContext, Opener, Sealer
from gdp.errors import DropReason, EnvelopeError, FrameError, StatementError
from gdp.frame.codec import HOPS_AT, Header, decode, encode
from gdp.frame.kinds import Kind
from gdp.message.reassembly import Reassembler
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.sansio import ReceivedFrame
from tests.gdp.message.sealed import INCARNATION, SECRET, SOURCE, TOPIC
from tests.gdp.message.test_run import take

compiled: ModuleType = pytest.importorskip("gdp.burst.core", reason="no compiler built the burst core here")
CIPHERS: tuple[type[MessageCipher], ...] = (MessageCipher, compiled.MessageCipher)
CORPUS = Path(__file__).parents[2] / "corpus"
KEY = bytes(range(32))


def head_of(parts: int, number: int = 7, flags: int = 2) -> bytes:
    """Return the head of a message."""
    return encode(Header(1, flags, 16, 3, 0, number, 0, parts, 9, b"d" * 32, b"s" * 32)) + b"the salt"


def parts_of(size: int, capacity: int, signature_bytes: int) -> int:
    """Return the parts of a message, as the envelope counts them."""
    return max(-(-(size + signature_bytes) // capacity), 1)


def arrivals_of(frames: Sequence[bytes]) -> list[ReceivedFrame]:
    """Return frames as they come."""
    return [ReceivedFrame(0, bytes(6), frame) for frame in frames]


@given(
    st.integers(0, 400),
    st.integers(65, 130),
    st.sampled_from([0, SIGNATURE_BYTES]),
    st.integers(0, (1 << 64) - 1),
    st.lists(st.integers(0, 9), max_size=4),
)
def test_both_seal_the_same_in_any_pieces(
    size: int, capacity: int, signature_bytes: int, number: int, pieces: list[int]
) -> None:
    message, parts = Random(size).randbytes(size), parts_of(size, capacity, signature_bytes)
    head = head_of(parts, number)
    whole = [each(KEY).seal(head, 0, parts, message, capacity, signature_bytes) for each in CIPHERS]
    assert whole[0] == whole[1]
    for each in CIPHERS:
        cipher, frames, payloads = each(KEY), list[bytes](), b""
        ends = sorted({min(end, parts) for end in pieces} | {parts})
        for first, end in zip([0, *ends], ends, strict=False):
            some, some_payloads = cipher.seal(head, first, end, message, capacity, signature_bytes)
            frames, payloads = frames + some, payloads + some_payloads
        assert (frames, payloads) == whole[0]


@given(st.data())
def test_both_open_the_same_run_of_damaged_frames(data: st.DataObject) -> None:
    chance = Random(data.draw(st.integers(0, 1 << 32)))
    capacity, parts = chance.randint(1, 90), chance.randint(3, 150)
    frames, _ = MessageCipher(KEY).seal(head_of(parts), 0, parts - 2, chance.randbytes(capacity * parts), capacity, 0)
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
    for wants in (False, True):
        given_ = head_of(parts), length, first, count, arrivals_of(frames), at, wants
        by_python, by_c = (each(KEY).open_run(*given_) for each in CIPHERS)
        assert by_python == by_c
        taken, plain, payloads = by_c
        assert len(plain) == taken * (length - SEAL_BYTES)
        assert len(payloads) == (taken * (length - SEAL_BYTES + TAG_BYTES) if wants else 0)


@given(st.binary(max_size=200), st.integers(0, 300), st.integers(0, 7))
def test_both_open_or_refuse_one_frame(message: bytes, at: int, bit: int) -> None:
    frames, _ = MessageCipher(KEY).seal(head_of(1), 0, 1, message, 300, 0)
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
def test_both_find_the_same_runs(seed: int, count: int) -> None:
    chance, slot_bytes = Random(seed), 300
    pool, sizes = bytearray(chance.randbytes(slot_bytes * (count + 1))), list[int]()
    for slot in range(count):
        length = chance.randint(0, 100)
        header = Header(
            chance.choice([1, 1, 1, 5, 0x80]), 0, chance.choice([16, 16, 16, 144, 1, 129]), 1, length, 7, 0, 1, 9,
            chance.choice([b"d", b"d", b"e"]) * 32, chance.choice([b"s", b"s", b"t"]) * 32,
        )  # fmt: skip
        frame = bytearray(encode(header) + chance.randbytes(length))
        frame[0] = chance.choice([1, 1, 1, 1, 2])
        pool[slot * slot_bytes + 14 : slot * slot_bytes + 14 + len(frame)] = frame
        sizes.append(max(len(frame) + chance.choice([0, 0, 0, 0, -1, 9, -100]), 0))
    by_python, by_c = slots.runs(pool, slot_bytes, sizes), compiled.runs(pool, slot_bytes, sizes)
    assert by_python == by_c
    assert [slot for first, each, *_ in by_c for slot in range(first, first + each)] == [*range(count)]


def test_slots_that_the_pool_has_not_are_refused() -> None:
    for sizes in ([87], [-1], [0, 0, 0], [1 << 40]):
        with pytest.raises(ValueError, match="slots"):
            compiled.received(bytearray(200), 100, sizes, 0, 0.0)
    for pool, slot_bytes, sizes in ((bytearray(200), 100, [1]), (bytearray(200), 110, [1, 1])):
        with pytest.raises(ValueError, match="slots"):
            compiled.runs(pool, slot_bytes, sizes)
    with pytest.raises(TypeError):
        compiled.received(bytes(200), 100, [1], 0, 0.0)


class _IdealSigner:
    """Signer and verifier without a random number, so that both twins sign the same."""

    def sign_digest(self, digest: bytes) -> bytes:
        return digest + digest[::-1]

    def verify_digest(self, signature: bytes, digest: bytes) -> None:
        if signature != digest + digest[::-1]:
            raise StatementError(DropReason.BAD_SIGNATURE)


def _message_by(twin: type[MessageCipher], seed: int, *, is_signed: bool) -> tuple[object, ...]:
    """Return all that shows of messages sealed, disordered and reassembled by one twin."""
    chance, patch = Random(seed), pytest.MonkeyPatch()
    patch.setattr(burst, "CIPHER", twin)
    signer = _IdealSigner() if is_signed else None
    sealer = Sealer(
        secret=SECRET, epoch=1, context=KeyContext(Kind.DATA, SOURCE, INCARNATION, TOPIC), signer=signer,
        random_bytes=chance.randbytes,
    )  # fmt: skip
    try:
        frames: list[bytes] = []
        for number in range(1, 4):
            sealed = sealer.seal(number, 2, chance.randbytes(chance.randrange(9_000)), chance.choice([300, 1500]))
            at_once = chance.randint(1, 70)
            for begin in range(0, len(sealed), at_once):
                frames += sealed[begin : begin + at_once]
            assert sealer.seal(number + 10 * number, 2, sealed, 600).message() == sealed.message()
            sealer._last_number = number
        sent = list(frames)
        for _ in range(chance.randrange(6)):
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
    assert _message_by(CIPHERS[0], seed, is_signed=is_signed) == _message_by(CIPHERS[1], seed, is_signed=is_signed)


def test_both_do_the_same_with_the_corpus_of_the_fuzzers() -> None:
    for path in sorted([*(CORPUS / "envelope").iterdir(), *(CORPUS / "frame").iterdir()]):
        frame, outcomes = path.read_bytes(), list[object]()
        for twin in CIPHERS:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(burst, "CIPHER", twin)
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
    frames, _ = MessageCipher(KEY).seal(head_of(9), 0, 7, bytes(9 * 50), 50, 0)
    frames[3] = frames[3][:-1] + bytes([frames[3][-1] ^ 1])
    opened = compiled.MessageCipher(KEY).open_run(head_of(9), 50 + SEAL_BYTES, 0, 7, arrivals_of(frames), 0, True)
    assert opened == (3, bytes(150), b"".join(frame[BODY_AT:] for frame in frames[:3]))


@pytest.mark.parametrize(
    "arguments",
    [
        (b"short", 0, 1, b"", 100, 0),
        (head_of(3), 2, 1, b"", 100, 0),
        (head_of(3), -1, 1, b"", 100, 0),
        (head_of(3), 0, 4, b"", 100, 0),
        (head_of(3), 0, 1, b"", 0, 0),
        (head_of(3), 0, 1, b"", 1 << 16, 0),
        (head_of(3), 0, 1, b"", 100, -1),
    ],
)
def test_wrong_arguments_of_ours_are_refused(arguments: tuple[bytes, int, int, bytes, int, int]) -> None:
    with pytest.raises(ValueError, match=r"a header|parts of"):
        compiled.MessageCipher(KEY).seal(*arguments)


def test_what_are_no_received_frames_is_refused() -> None:
    cipher = compiled.MessageCipher(KEY)
    for wrong in ([b"bytes"], [(0, 0)], [(0, 0, "text")], 5):
        with pytest.raises((TypeError, IndexError)):
            cipher.open_run(head_of(3), 50, 0, 1, wrong, 0, False)
    for key in (b"", bytes(31), bytes(33)):
        with pytest.raises(ValueError, match="32 bytes"):
            compiled.MessageCipher(key)
    with pytest.raises(ValueError, match="end of a sealed part"):
        cipher.open(bytes(200), BODY_AT + TAG_BYTES - 1)


def test_a_cipher_in_use_by_another_thread_refuses_or_works() -> None:
    cipher, message = compiled.MessageCipher(KEY), bytes(100_000)
    right = MessageCipher(KEY).seal(head_of(100), 0, 98, message, 1_000, 0)
    wrong: list[object] = []

    def work() -> None:
        for _ in range(50):
            try:
                if cipher.seal(head_of(100), 0, 98, message, 1_000, 0) != right:
                    wrong.append("other frames")
            except RuntimeError as error:
                assert "another thread" in str(error)  # noqa: PT017

    threads = [threading.Thread(target=work) for _ in range(3)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert not wrong
