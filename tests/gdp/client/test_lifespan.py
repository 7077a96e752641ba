"""Freshness of best-effort messages: those that would come too late are dropped whole, unsealed and counted."""

from __future__ import annotations

import pytest

from gdp.client.best_effort_queue import FRESH_S, BestEffortQueue, Carried
from gdp.client.send_options import SendOptions
from gdp.client.writer_proxy import WriterProxyState
from gdp.crypto.envelope import KeyContext, Sealed, Sealer
from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.message.loss import LossReason
from tests.gdp.client.pipe import WRITER, End, Pipe, publisher_of

LARGE = bytes(3_000)  # three frames
DEADLINE_S = 0.2


def sealed(number: int, size: int = len(LARGE)) -> Sealed:
    sealer = Sealer(
        secret=bytes(32),
        epoch=1,
        context=KeyContext(Kind.DATA, bytes(32), 1, bytes(32)),
        signer=WRITER,
        random_bytes=bytes,
    )
    return sealer.seal(number, 0, bytes(size), 1500)


def queue_of(*added_s: float | None, deadline_s: float | None = DEADLINE_S) -> BestEffortQueue:
    """Return a queue with a message for each of these times, numbered from 1."""
    queue = BestEffortQueue(deadline_s)
    for number, at_s in enumerate(added_s, 1):
        queue.add(sealed(number), Carried(number, number, 1, at_s))
    return queue


def dropped(queue: BestEffortQueue, now_s: float, bytes_s: float | None = None) -> list[int]:
    return [each.number for each in queue.drop_expired(now_s, bytes_s)]


def joined(**options: object) -> tuple[Pipe, End]:
    """Return a best-effort publisher with these options, and a live reader."""
    pipe = Pipe(publisher_of(reliable=False, options=SendOptions(**options)))  # type: ignore[arg-type]
    end = pipe.join(b"a")
    assert pipe.run(2.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    return pipe, end


def test_a_message_that_waited_longer_than_its_deadline_is_dropped() -> None:
    queue = queue_of(10.0, 10.1, 10.19)
    assert dropped(queue, 10.25) == [1]
    assert dropped(queue, 10.35) == [2]
    assert len(queue.waiting) == 1


def test_the_time_that_a_message_takes_to_leave_counts_against_its_deadline() -> None:
    size_bytes = sealed(1).size_bytes
    fits, too_slow = size_bytes / (DEADLINE_S - 0.01), size_bytes / (DEADLINE_S + 0.01)
    assert dropped(queue_of(10.0), 10.0, fits) == []
    assert dropped(queue_of(10.0), 10.0, too_slow) == [1]


@pytest.mark.parametrize("unknown", [None, 0.0])
def test_where_the_rate_is_unknown_only_the_time_of_waiting_counts(unknown: float | None) -> None:
    assert dropped(queue_of(10.0), 10.0 + DEADLINE_S - 0.01, unknown) == []


def test_a_message_that_has_begun_to_leave_is_never_dropped() -> None:
    queue = queue_of(10.0, 10.0)
    begun = queue.poll_frames(1)
    assert dropped(queue, 20.0) == [2]
    assert len(begun + queue.poll_frames(9)) == len(sealed(1))


def test_without_a_deadline_a_message_gives_way_to_a_newer_one() -> None:
    queue = queue_of(10.0, 10.0 + FRESH_S, 10.0 + 2 * FRESH_S, deadline_s=None)
    assert dropped(queue, 9.999 + FRESH_S) == []
    assert dropped(queue, 10.01 + 2 * FRESH_S) == [1, 2]


def test_without_a_deadline_the_newest_message_is_never_dropped() -> None:
    assert dropped(queue_of(10.0, deadline_s=None), 1_000.0) == []


def test_a_message_without_a_time_ages_from_the_next_poll_on() -> None:
    queue = queue_of(10.0, None)
    assert dropped(queue, 10.15) == []
    assert dropped(queue, 10.3) == [1]
    assert dropped(queue, 10.36) == [2]


def test_a_dropped_message_is_never_sealed(monkeypatch: pytest.MonkeyPatch) -> None:
    pipe, _ = joined(deadline_s=DEADLINE_S)
    ends: list[int] = []
    seal = Sealed._seal

    def record(frames: Sealed, begin: int, end: int) -> None:
        ends.append(end)
        seal(frames, begin, end)

    monkeypatch.setattr(Sealed, "_seal", record)
    pipe.publisher.publish(LARGE, pipe.now_s)
    pipe.now_s += 1.0
    assert pipe.publisher.queue.drop_expired(pipe.now_s)
    assert (ends, pipe.publisher.drops[DropReason.LIFESPAN]) == ([], 1)


@pytest.mark.parametrize("message", [LARGE, b"small"])
def test_readers_learn_how_many_messages_were_too_late(message: bytes) -> None:
    pipe, end = joined(deadline_s=DEADLINE_S)
    pipe.publish([message])
    for _ in range(5):
        pipe.publisher.publish(message, pipe.now_s)
    pipe.now_s += DEADLINE_S + 0.1
    pipe.publish([message])
    pipe.run(2.0)
    assert (len(end.delivered), end.writer_proxy.losses.counts) == (2, {LossReason.LIFESPAN: 5})
    assert (pipe.publisher.messages, pipe.publisher.losses.counts) == (7, {LossReason.LIFESPAN: 5})
    assert (pipe.publisher.drops[DropReason.LIFESPAN], pipe.publisher.acknowledgements.acknowledged) == (5, 2)


def test_small_messages_without_a_deadline_give_way_to_newer_ones() -> None:
    pipe, end = joined()
    for at in range(4):
        pipe.publisher.publish(b"%d" % at, pipe.now_s + at * FRESH_S)
    pipe.now_s += 3.5 * FRESH_S
    pipe.run(1.0)
    assert end.messages == [b"3"]
    assert end.writer_proxy.losses.counts == {LossReason.LIFESPAN: 3}


def test_a_rate_at_which_no_message_can_be_in_time_drops_all() -> None:
    queue = queue_of(10.0, 10.0, 10.0, deadline_s=DEADLINE_S)
    gone = queue.drop_expired(10.0, len(LARGE) / (2 * DEADLINE_S))
    assert [carried.number for carried in gone] == [1, 2, 3]


@pytest.mark.parametrize("kept", [{"reliable": True}, {"reliable": False, "depth": 4}])
def test_reliable_and_latched_messages_never_expire(kept: dict[str, bool | int]) -> None:
    pipe = Pipe(publisher_of(**kept, options=SendOptions(deadline_s=0.01)))  # type: ignore[arg-type]
    end = pipe.join(b"a")
    assert pipe.run(2.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    pipe.publisher.publish(LARGE, pipe.now_s)
    pipe.publisher.publish(LARGE, pipe.now_s)
    pipe.now_s += 1.0
    pipe.run(1.0)
    assert len(end.messages) == 2


def test_a_message_that_is_split_again_keeps_its_age() -> None:
    pipe, end = joined(deadline_s=DEADLINE_S)
    pipe.publisher.publish(LARGE, pipe.now_s)
    pipe.publisher.tree_stands(1_300)
    pipe.now_s += 2 * DEADLINE_S
    pipe.run(1.0)
    assert (end.messages, pipe.publisher.losses.counts) == ([], {LossReason.LIFESPAN: 1})
