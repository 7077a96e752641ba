"""Parity between a publisher and a reader: what a holder of the topic's secret cannot do with it."""

from __future__ import annotations

from functools import partial
from random import Random

import pytest

from gdp.client.send_options import DEFAULT_OPTIONS
from gdp.crypto.parity_seal import ParitySealer
from gdp.errors import DropReason
from gdp.frame.codec import Flag, Kind, decode
from gdp.message.parity import OVERHEAD_BYTES, Parity
from tests.gdp.client.pipe import SECRETS, TOPIC, Pipe
from tests.gdp.client.test_late_repairs import joined

SIZE = 40_000


def warmed(loss: float = 0.02) -> Pipe:
    """Return a pipe whose publisher sends parity, since it has measured loss."""
    pipe, end = joined(options=DEFAULT_OPTIONS)
    end.loss = loss
    rng = Random(1)
    for _ in range(60):
        pipe.publish([rng.randbytes(SIZE)])
        pipe.run(0.1)
    assert pipe.publisher.protection.parity.sent
    assert end.writer_proxy.recovery.recovered
    return pipe


@pytest.mark.parametrize("when", ["before", "between"])
@pytest.mark.parametrize("size", [10, 700, 1_382])
def test_parity_forged_by_another_reader_delivers_nothing_wrong_and_holds_up_no_repair(when: str, size: int) -> None:
    pipe, rng, sent = warmed(), Random(size), []
    end = next(iter(pipe.ends.values()))
    sealer = ParitySealer(secret=SECRETS[1], epoch=1, source=b"p" * 32, incarnation=1, destination=TOPIC)
    end.delivered.clear()
    before = pipe.publisher.messages

    def forge(number: int) -> None:
        for index in range(8):
            wire = Parity(0, index, 8, rng.randbytes(size)).to_wire()
            frame = sealer.seal(number, index, 30, int(Flag.PARITY), wire)
            end.writer_proxy.receive(decode(frame), frame, pipe.now_s, 0.0)

    for _ in range(40):
        sent.append(rng.randbytes(SIZE))
        pipe.publish([sent[-1]])
        number = max(decode(frame).number for frame in pipe.seen if decode(frame).kind == Kind.DATA)
        if when == "before":
            forge(number)
        else:
            pipe.run(0.031)
            forge(number)
        pipe.run(0.25)
    pipe.run(1.0)
    assert pipe.publisher.messages == before + 40
    assert set(end.messages) <= set(sent)
    assert len(end.messages) >= 38
    assert end.budget.held_bytes == 0


def test_a_replay_of_all_frames_delivers_nothing_again_and_holds_no_memory() -> None:
    pipe = warmed()
    end = next(iter(pipe.ends.values()))
    delivered, recovered = len(end.delivered), end.writer_proxy.recovery.recovered
    old = [frame for frame in pipe.seen if decode(frame).kind in (Kind.DATA, Kind.PARITY)]
    unused = end.writer_proxy.drops[DropReason.UNUSED_PARITY]
    for frame in old:
        end.writer_proxy.receive(decode(frame), frame, pipe.now_s, 0.0)
    pipe.run(2.0)
    assert (len(end.delivered), end.writer_proxy.recovery.recovered) == (delivered, recovered)
    assert end.writer_proxy.drops[DropReason.UNUSED_PARITY] > unused
    assert end.budget.held_bytes == 0


def test_strangers_parity_is_dropped_with_its_reason() -> None:
    pipe = warmed()
    end = next(iter(pipe.ends.values()))
    sealer = ParitySealer(secret=b"x" * 32, epoch=1, source=b"p" * 32, incarnation=1, destination=TOPIC)
    seal = partial(sealer.seal, 1 << 20, 0, 30, int(Flag.PARITY))
    for body, epoch in ((bytes(100), 1), (bytes(OVERHEAD_BYTES), 1), (bytes(100), 9)):
        frame = seal(body)
        end.writer_proxy.receive(decode(frame)._replace(epoch=epoch), frame, pipe.now_s, 0.0)
    drops = end.writer_proxy.drops
    assert (drops[DropReason.BAD_TAG], drops[DropReason.UNKNOWN_EPOCH]) == (2, 1)
