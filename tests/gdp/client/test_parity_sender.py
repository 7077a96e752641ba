"""Parity of one publisher: when there is any, how much, and when it leaves."""

from __future__ import annotations

import random
from os import urandom

import pytest

from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import KeyEpochs
from gdp.client.parity_sender import PARITY_BYTES, ParitySender, is_protected, is_useful, parity_for
from gdp.client.redundancy import CopyBudget, parity_budget
from gdp.crypto.envelope import fragment_capacity
from gdp.crypto.parity_seal import ParityOpener
from gdp.frame.codec import Flag, Kind, decode
from gdp.message import erasure
from gdp.message.parity import Parity
from gdp.names import Name
from tests.gdp.client.incarnation_ids import key_of, name_of, source_of

TOPIC = Name(b"t" * 32)
SECRET = bytes(range(32))
MTU = 1_500


def writer_identity() -> WriterIdentity:
    """Return the writer."""
    return source_of(name_of(b"writer"), 9, key_of(b"writer"))


def keys() -> KeyEpochs:
    """Return the keys of a topic."""
    return KeyEpochs(TOPIC, writer_identity(), {1: SECRET})


def sender(with_keys: KeyEpochs, *, budget: CopyBudget | None = None, is_enabled: bool = True) -> ParitySender:
    """Return the parity of one publisher."""
    return ParitySender(keys=with_keys, budget=budget or parity_budget(), is_enabled=is_enabled)


def sealed(with_keys: KeyEpochs, number: int, size: int = 40_000, flags: int = int(Flag.PARITY)) -> list[bytes]:
    """Return the frames of a message."""
    return with_keys.data.seal(number, flags, urandom(size), MTU - PARITY_BYTES)[:]


@pytest.mark.parametrize(
    ("loss", "rtt_s", "deadline_s", "useful"),
    [
        (None, 0.06, None, False),
        (0.0, 0.06, None, False),
        (0.0009, 0.06, None, False),
        (0.001, 0.06, None, True),
        (0.05, 0.06, None, True),
        (0.05, None, None, False),
        (0.05, 0.004, None, False),  # a repair takes no longer than the detection of a gap
        (0.05, 0.06, 0.1, True),
        (0.05, 0.06, 0.5, False),  # a repair is in time anyway
        (0.21, 0.06, None, False),  # congestion, or a path that no quarter of parity helps
    ],
)
def test_parity_is_for_measured_loss_on_paths_whose_repair_is_late(
    loss: float | None, rtt_s: float | None, deadline_s: float | None, useful: bool
) -> None:
    assert is_useful(loss, rtt_s, deadline_s) is useful


@pytest.mark.parametrize(
    ("k", "loss", "count"),
    [
        *((3, loss, 1) for loss in (0.01, 0.2)),
        *((28, 0.001, 1), (28, 0.01, 2), (28, 0.02, 3), (28, 0.05, 5), (28, 0.2, 7)),
        *((123, 0.01, 4), (123, 0.02, 7), (123, 0.05, 13), (128, 0.2, 32)),
    ],
)
def test_the_count_is_the_least_that_leaves_1_percent_for_repairs(k: int, loss: float, count: int) -> None:
    assert parity_for(k, loss, 0.01) == count


def test_the_chance_of_a_repair_is_as_small_as_stated() -> None:
    rng, k, loss = random.Random(1), 28, 0.05
    count = parity_for(k, loss, 0.01)
    failed = sum(sum(rng.random() < loss for _ in range(k + count)) > count for _ in range(20_000))
    assert failed <= 0.01 * 20_000


def test_a_margin_adds_frames_up_to_a_quarter() -> None:
    assert [parity_for(28, 0.01, 0.01, margin) for margin in (0.0, 0.9, 2.0, 16.0)] == [2, 2, 4, 7]


def test_a_message_of_two_fragments_has_copies_and_no_parity() -> None:
    capacity = fragment_capacity(MTU)
    assert not is_protected(2 * capacity - 64, MTU)
    assert is_protected(2 * capacity - 63, MTU)


def test_parity_follows_the_last_frame_and_restores_lost_ones() -> None:
    of = keys()
    made, frames = sender(of), sealed(of, 1)
    made.handle_sent(frames[:-1], 0.05, None, 0.0)
    assert made.poll_frames(100) == []
    made.handle_sent(frames[-1:], 0.05, None, 0.0)
    parity = made.poll_frames(100)
    assert len(parity) == made.sent == parity_for(len(frames), 0.05, 0.01)
    assert max(map(len, parity)) <= MTU
    identity = writer_identity()
    opener = ParityOpener(SECRET, identity.name, identity.incarnation, TOPIC)
    for at, frame in enumerate(parity):
        header = decode(frame)
        assert (header.kind, header.number, header.part, header.parts) == (Kind.PARITY, 1, at, len(frames))
        assert header.flags == int(Flag.PARITY)
        body = Parity.from_wire(opener.open(header, frame))
        assert (body.first, body.index, body.count) == (0, at, len(parity))


def test_frames_that_are_sent_again_make_no_parity() -> None:
    of = keys()
    made, frames = sender(of), sealed(of, 1)
    made.handle_sent(frames, 0.05, None, 0.0)
    count = len(made.poll_frames(100))
    made.handle_sent(frames, 0.05, None, 1.0)
    made.handle_sent(frames[3:5], 0.05, None, 1.0)
    assert made.poll_frames(100) == []
    assert made.sent == count


@pytest.mark.parametrize("loss", [None, 0.0, 0.3])
def test_without_loss_that_parity_fills_there_is_none(loss: float | None) -> None:
    of = keys()
    made = sender(of)
    made.handle_sent(sealed(of, 1), loss, None, 0.0)
    assert len(made.waiting) == 0
    assert not made.is_wanted(loss, 0.06, None)


def test_a_rule_switches_it_off() -> None:
    of = keys()
    made = sender(of, is_enabled=False)
    made.handle_sent(sealed(of, 1), 0.05, None, 0.0)
    assert len(made.waiting) == 0
    assert not made.is_wanted(0.05, 0.06, None)


def test_without_numpy_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(erasure, "is_available", lambda: False)
    made = sender(keys())
    assert not made.is_available
    assert not made.is_wanted(0.05, 0.06, None)


@pytest.mark.parametrize("path_bytes_s", [None, 1e6])
def test_parity_keeps_within_their_share_of_the_path(path_bytes_s: float | None) -> None:
    of, size, seconds = keys(), 0, 4
    made = sender(of)
    for number in range(100 * seconds):
        made.handle_sent(sealed(of, number + 1), 0.05, path_bytes_s, number / 100)
        size += sum(map(len, made.poll_frames(100)))
    share = 125_000 if path_bytes_s is None else 0.15 * path_bytes_s
    assert 0.8 * share * seconds < size <= 1.05 * share * (seconds + 1)


def test_a_few_parity_frames_leave_at_once_and_the_others_when_permitted() -> None:
    of = keys()
    made = sender(of, budget=CopyBudget(1.0, 1e9))
    made.handle_sent(sealed(of, 1, 250_000), 0.1, None, 0.0)
    waiting = len(made.waiting)
    assert waiting > 20
    assert [len(made.poll_frames(limit)) for limit in (0, 0, 5)] == [8, 0, 5]
    made.clear()
    assert len(made.waiting) == 0


def test_the_margin_grows_with_requests_and_decays() -> None:
    of = keys()
    made = sender(of, budget=CopyBudget(1.0, 1e9))
    for number in range(1, 4):
        made.handle_sent(sealed(of, number), 0.01, None, 0.0)
    made.handle_report([1, 2, 2, 77])
    made.handle_report([2])
    assert made.margin == 2.0
    for number in range(4, 200):
        made.handle_sent(sealed(of, number), 0.01, None, 0.0)
    assert 0.0 < made.margin < 0.4
