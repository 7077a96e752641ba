"""Keepalives in the kernel, compared with ``gdp.control.keepalive`` by ``BPF_PROG_TEST_RUN``, without devices.

Test frames come in on the loopback device, whose index is 1 and whose address is zero.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gdp.control.keepalive import SUSPECT_AFTER, keepalive_header, open_keepalive, seal_keepalive
from gdp.control.link_quality import LinkReport
from gdp.errors import FrameError, LocalError
from gdp.frame.codec import ETHER_BYTES, HEADER_BYTES, NUMBER_AT, KeepaliveFlag, decode, encode, ethernet
from gdp.ports.kernel import syscall
from gdp.ports.kernel.keepalive_program import FRAME_BYTES
from gdp.ports.kernel.keepalives import KeepaliveSessions
from gdp.ports.kernel.program import DROP, UP
from gdp.ports.plane import Port
from gdp.sansio import KeepaliveOffer

NEIGHBOUR, OWN = b"\x11" * 32, b"\x22" * 32
IN_KEY, OUT_KEY = b"\x33" * 32, b"\x44" * 32
DIGEST = b"digest!!"
TO_US = ethernet(bytes(6), b"\x02far\x00\x00")
LOOPBACK = 1
HEARD = int(KeepaliveFlag.HEARD)
INTERVAL_S = 0.07


def received(
    number: int, flags: int = HEARD, multiplier: int = 3, digest: bytes = DIGEST, key: bytes = IN_KEY
) -> bytes:
    """Return a keepalive of the neighbour."""
    report = LinkReport(number + 1, number + 2, 3, 4)
    return TO_US + seal_keepalive(key, keepalive_header(NEIGHBOUR, 7, number), flags, multiplier, digest, report)


def offer(**changed: Any) -> KeepaliveOffer:
    now_s = time.monotonic()
    made = KeepaliveOffer(
        port=0, name=NEIGHBOUR, nonce=b"session!", mac=b"\x02far\x00\x00", in_key=IN_KEY, out_key=OUT_KEY,
        header=encode(keepalive_header(OWN, 8, 0)), head=bytes((HEARD, 5)) + DIGEST,
        expected=bytes((HEARD, 0)) + DIGEST, loss=9, sequence=100, sent=50, received=1_000, echo=500,
        heard_s=now_s, send_at_s=now_s,
        out_interval_s=INTERVAL_S, suspect_s=SUSPECT_AFTER * INTERVAL_S,
    )  # fmt: skip
    return made._replace(**changed)


PORTS = cast("dict[int, Port]", {0: SimpleNamespace(mac=b"\x02own\x00\x00")})


@pytest.fixture
def sessions() -> Iterator[KeepaliveSessions]:
    """Sessions on the loopback device, to which no program is attached."""
    try:
        made = KeepaliveSessions()
    except LocalError as error:
        pytest.skip(str(error).partition("\n")[0])
    made._links[0] = -1, LOOPBACK
    yield made
    made.detach(0)
    made.close()


def take(sessions: KeepaliveSessions, frame: bytes) -> int:
    return syscall.run(sessions._programs[0], frame).retval


def test_keepalives_that_bring_no_news_are_taken_and_reported(sessions: KeepaliveSessions) -> None:
    sessions.follow([offer()], PORTS)
    before_s = time.monotonic()
    assert [take(sessions, received(number)) for number in (1_001, 1_002, 1_005)] == [DROP] * 3
    (run,) = sessions.follow([], PORTS)
    assert (run.taken, run.received, run.report, run.multiplier) == (3, 1_005, (1_006, 1_007, 3, 4), 3)
    assert before_s <= run.heard_s <= time.monotonic()
    assert run.is_over
    assert take(sessions, received(1_006)) == UP


def test_a_recorded_keepalive_is_no_sign_of_life(sessions: KeepaliveSessions) -> None:
    sessions.follow([offer()], PORTS)
    assert [take(sessions, received(number)) for number in (1_000, 1_001, 1_001, 7)] == [DROP] * 4
    (run,) = sessions.follow([], PORTS)
    assert (run.taken, run.replays) == (1, 3)


@pytest.mark.parametrize(
    "news",
    [
        received(1_001, flags=HEARD | KeepaliveFlag.POLL),
        received(1_001, flags=HEARD | KeepaliveFlag.FINAL),
        received(1_001, flags=0),
        received(1_001, digest=b"another!"),
    ],
)
def test_news_go_up_with_all_that_follow_until_the_session_is_handed_over_again(
    sessions: KeepaliveSessions, news: bytes
) -> None:
    sessions.follow([offer()], PORTS)
    assert [take(sessions, news), take(sessions, received(1_002))] == [UP, UP]
    runs, _ = sessions.poll(time.monotonic())
    assert [(run.is_over, run.received) for run in runs] == [(True, 1_000)]


def test_a_frame_of_another_key_changes_nothing(sessions: KeepaliveSessions) -> None:
    sessions.follow([offer()], PORTS)
    assert take(sessions, received(1_001, flags=0, key=OUT_KEY)) == UP
    assert take(sessions, received(1_001)) == DROP


@settings(max_examples=150, deadline=None)
@given(
    number=st.integers(990, 1_020),
    at=st.none() | st.integers(ETHER_BYTES, FRAME_BYTES - 1),
    bits=st.integers(1, 255),
    cut=st.none() | st.integers(ETHER_BYTES, FRAME_BYTES - 1),
    padding=st.integers(0, 60),
)
def test_the_kernel_takes_what_the_node_would_accept_and_nothing_else(
    twin: KeepaliveSessions, number: int, at: int | None, bits: int, cut: int | None, padding: int
) -> None:
    frame = bytearray(received(number))
    if at is not None:
        frame[at] ^= bits
    given_frame = bytes(frame) + bytes(padding) if cut is None else bytes(frame[:cut])
    twin.follow([offer()], PORTS)
    retval = take(twin, given_frame)
    (run,) = twin.follow([], PORTS)
    try:
        header = decode(given_frame[ETHER_BYTES:])
        report = open_keepalive(IN_KEY, given_frame[ETHER_BYTES:])[3]
    except FrameError:
        assert run.taken == 0
        assert retval == UP or run.replays == 1
        return
    assert (retval, run.taken, run.replays) == ((DROP, 1, 0) if header.number > 1_000 else (DROP, 0, 1))
    if run.taken:
        assert run.report == report


@pytest.fixture(scope="module")
def twin() -> Iterator[KeepaliveSessions]:
    """Sessions for many examples."""
    try:
        made = KeepaliveSessions()
    except LocalError as error:
        pytest.skip(str(error).partition("\n")[0])
    made._links[0] = -1, LOOPBACK
    yield made
    made.detach(0)
    made.close()


@settings(max_examples=50, deadline=None)
@given(
    key=st.binary(min_size=32, max_size=32),
    sequence=st.integers(0, 2**63),
    sent=st.integers(0, 2**40),
    echo=st.integers(0, 2**40),
    multiplier=st.integers(1, 255),
    loss=st.integers(0, 255),
)
def test_the_kernel_sends_what_the_node_would_send(
    twin: KeepaliveSessions, key: bytes, sequence: int, sent: int, echo: int, multiplier: int, loss: int
) -> None:
    head = bytes((HEARD, multiplier)) + DIGEST
    given_offer = offer(out_key=key, sequence=sequence, sent=sent, echo=echo, head=head, loss=loss)
    twin.follow([given_offer], PORTS)
    slot = next(iter(twin._sessions.values())).slot
    twin._slots.put(bytes(4), slot.to_bytes(4, sys.byteorder))
    twin._listed = []
    frame = syscall.run(twin._programs[1], bytes(FRAME_BYTES)).frame
    twin.follow([], PORTS)
    assert frame[:ETHER_BYTES] == ethernet(given_offer.mac, PORTS[0].mac)
    assert decode(frame[ETHER_BYTES:]) == keepalive_header(OWN, 8, sequence + 1)
    flags, found, digest, report = open_keepalive(key, frame[ETHER_BYTES:])
    assert (flags, found, digest) == (HEARD, multiplier, DIGEST)
    assert (report.sent, report.echo, report.loss) == (sent + 1, echo, loss)
    assert report.held_us < 60_000_000


def test_what_is_due_leaves_in_one_tick_and_a_silent_neighbour_is_handed_back(sessions: KeepaliveSessions) -> None:
    late = offer(name=b"\x55" * 32, send_at_s=time.monotonic() + INTERVAL_S / 4)
    sessions.follow([offer(), late], PORTS)
    now_s = time.monotonic()
    assert sessions.due_s <= now_s
    calls, send = list[int](), sessions._run
    sessions._run = lambda repeat: calls.append(repeat) or send(repeat)  # type: ignore[assignment,func-returns-value]
    sessions.tick(now_s)
    assert calls == [2]
    assert [len(each.sent_s) for each in sessions._sessions.values()] == [1, 1]
    assert now_s < sessions.due_s <= now_s + INTERVAL_S
    silent_s = now_s + 2 * INTERVAL_S
    sessions.tick(silent_s)
    assert sessions.has_news
    runs, late_s = sessions.poll(silent_s)
    assert [each.is_over for each in runs] == [True, True]
    assert late_s > 0
    assert sessions.due_s == float("inf")


@pytest.mark.parametrize("neighbours", [1, 20])
def test_one_tick_in_an_interval_sends_all_and_finds_who_is_silent(
    sessions: KeepaliveSessions, neighbours: int
) -> None:
    begun_s = now_s = time.monotonic()
    offers = [offer(name=bytes([at]) * 32, heard_s=begun_s, send_at_s=begun_s) for at in range(neighbours)]
    sessions.follow(offers, PORTS)
    words = [0] * len(sessions._words)
    sessions._words = cast("memoryview[int]", words)
    sessions._run = lambda _count: None  # type: ignore[assignment]
    ticks = sends = 0
    intervals = 200
    while now_s < begun_s + intervals * INTERVAL_S:
        for at, session in enumerate(sessions._sessions.values()):
            heard_s = now_s - (now_s - begun_s - INTERVAL_S * at / neighbours) % INTERVAL_S
            words[session.slot * 10 + 3] = int(heard_s * 1e9)
        before = sessions._send_at_s
        sessions.tick(now_s)
        ticks, sends = ticks + 1, sends + (sessions._send_at_s > before)
        assert sessions.due_s - now_s > 0.7 * INTERVAL_S
        now_s = sessions.due_s
    assert sends == ticks < intervals / 0.7


def test_a_number_of_a_frame_is_where_the_program_expects_it() -> None:
    frame = received(0x0102030405060708)
    at = ETHER_BYTES + NUMBER_AT
    assert frame[at : at + 8] == bytes(range(1, 9))
    assert len(frame) == FRAME_BYTES > ETHER_BYTES + HEADER_BYTES
